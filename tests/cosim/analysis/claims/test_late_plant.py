"""A plant whose steps are late applies inputs that were computed for a later time than the step's."""

import math

import numpy as np
import pytest

from cosim.analysis.claims.claim_evaluation import RunClaims
from cosim.analysis.claims.run_certificates import RUN_WORK, scheduled_certificates
from cosim.analysis.conformance.run_conformance import conformance
from cosim.analysis.conformance.verdicts import Failed
from cosim.analysis.summary.summary_model import Claim, ClaimCause, ClaimVerdict
from noack.protocol.record_tables import PLANT_STEP
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from noack.theory.certificates.conditions import allowed_conditions
from tests.cosim.simulation.late_plant import CASE, STEP_S, late_run

LATE = 4
"""Steps by which a step is late, at most."""


def worst_lateness(steps: int, alpha: float) -> list[int]:
    """Return the lateness of each step that pushes x away, and lets each update act in time.

    The loop is integrated here. A step that is an event has to be on time, for its update to act soon.
    """
    a, k, beta = 20.0, 24.0, 0.01
    flow = math.exp(a * STEP_S)
    gain, found, updates, w_before = (flow - 1) / a, list[int](), [(0.0, 0.0, 1.0)], -1.0
    x = x_s = 1.0

    def applied(w: float) -> float:
        tick = math.floor(w / STEP_S - 0.5 + 1e-9)
        if tick < 0:
            return 0.0
        tau = (tick + 0.5) * STEP_S
        _, sent, state = [update for update in updates if update[0] <= tau + 1e-12][-1]
        return -k * math.exp((a - k) * (tau - sent)) * state

    for step in range(steps):
        t = step * STEP_S
        x_s *= math.exp((a - k) * STEP_S) if step else 1.0
        is_event = abs(x_s - x) > beta * math.exp(-alpha * t)
        w = max(t + (2 if is_event else LATE) * STEP_S, w_before)
        if is_event:
            updates.append((w, t, x))
            x_s = x
        x_next = flow * x + gain * applied(w)
        error = x_s * math.exp((a - k) * STEP_S) - x_next
        if not is_event and abs(error) > beta * math.exp(-alpha * (t + STEP_S)):
            w = max(min(w, t + 3 * STEP_S), w_before)
            x_next = flow * x + gain * applied(w)
        w_before, x = w, x_next
        found.append(round((w - t) / STEP_S))
    return found


def certified(claims: RunClaims) -> list[Claim]:
    return [claim for claim in claims.evaluate() if claim.source == "certificate"]


def test_inputs_of_later_times_exceed_a_bound_that_does_not_cover_them_and_another_one_holds() -> None:
    late = worst_lateness(4005, 3.7)
    record = late_run(late.__getitem__, "horizon_s=8.0", "trigger.alpha_per_s=3.7")
    claims = RunClaims(record)
    observed = claims.largest_observed
    assert observed["hold_s"] == pytest.approx(0.003)
    assert observed["lead_s"] == pytest.approx(0.007)
    # The bound of the schedule, which has no such inputs, is exceeded; that of the run's lead is not.
    ((schedule, document, _),) = scheduled_certificates(record.scenario, RUN_WORK)
    t_s, x = record[PLANT_STEP]["t_ns"] * 1e-9, np.abs(record[PLANT_STEP]["x"][:, 0])
    assert (x > 1.5 * schedule.state(t_s)).any()
    assert document is not None
    failure = conformance(record, document).failure
    assert failure is not None
    assert (failure.kind, failure.t_s) == (Failed.INPUT, 0.0)
    assert claims.certified_for is not None
    assert claims.certified_for.lead_s == pytest.approx(0.007)
    assert {claim.verdict for claim in certified(claims)} == {ClaimVerdict.HELD}


def test_claims_end_at_the_first_such_input_if_no_bound_covers_it() -> None:
    """A step that is 0.2 s late: no certificate covers such ages, and none of the steps before."""
    record = late_run(lambda step: 100 if step == 500 else 0, "horizon_s=2.0")
    claims = RunClaims(record)
    assert claims.certified_for is None
    for claim in certified(claims):
        assert (claim.verdict, claim.cause) == (ClaimVerdict.ENDED, ClaimCause.CONFORMANCE)
        assert claim.since_s == pytest.approx(1.0, abs=0.01)
    (part,) = claims.conformance()
    assert part.failure is not None
    assert part.failure.kind in {Failed.INPUT, Failed.LIMIT}


def test_no_schedule_has_inputs_of_later_times() -> None:
    resolved = resolve(load(CASE))
    assert resolved.certificate.late_periods == 2
    assert allowed_conditions(resolved).lead_s == 0.0
    claims = RunClaims(late_run(lambda step: 0, "horizon_s=1.0"))
    assert claims.largest_observed["lead_s"] == 0.0
    assert [part.failure for part in claims.conformance()] == [None]
