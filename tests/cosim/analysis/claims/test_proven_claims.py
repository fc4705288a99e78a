"""The claims of a run about bounds that the checker has proven."""

import math

import numpy as np
import pytest

from cosim.analysis.claims.claim_evaluation import RunClaims
from cosim.analysis.claims.run_certificates import RUN_WORK, certificates_under
from cosim.analysis.summary.summary_model import Claim
from cosim.analysis.witnesses import find_statement
from cosim.record.run_record import Rows, RunRecord
from cosim.simulation.virtual_time import simulate
from netem.core.number_format import at_most
from noack.protocol.record_tables import PLANT_STEP
from noack.theory.certificates.conditions import allowed_conditions
from noack.theory.certificates.proven_bounds import ProvenBound, ProvenBounds
from tests.checker.proofs import BELT, use_stored
from tests.helpers.shipped import resolved

PROVEN = ProvenBounds(0.2, {"x": ProvenBound(7.0, 0.5)}, {}, 0.25, 0.125, is_quiet=True)


@pytest.fixture(autouse=True)
def proofs_are_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the scenario's plant and of its box, also with a late network; of a motor with a load."""
    use_stored(monkeypatch, "claims", "claims_box", "claims_late", "claims_box_late", "claims_belt")


@pytest.fixture(scope="module")
def record() -> RunRecord:
    return simulate(resolved("double_integrator", "horizon_s=4"))


def claims_of(record: RunRecord) -> dict[str, Claim]:
    claims = RunClaims(record, most_work=RUN_WORK).evaluate()
    assert {claim.verdict for claim in claims} <= {"held", "not applicable"}
    return {claim.what: claim for claim in claims if claim.source == "certificate"}


def test_the_claims_of_a_run_name_the_proven_bounds(record: RunRecord) -> None:
    claims = claims_of(record)
    bounds = find_statement(record.scenario, "own", "schedule", most_work=RUN_WORK).bounds
    assert bounds is not None
    x = bounds.bounds["x"]
    state = claims["the state is bounded"]
    assert state.bound == f"‖x‖ ≤ {at_most(x.decaying)} e^(−0.3t) + {at_most(x.constant)}"
    assert (state.origin, state.certified) == ("certificate (proved)", x.decaying)
    assert claims["the controller's error is bounded"].certified == bounds.bounds["e_c"].decaying
    assert claims["the sensor's error is bounded"].proved
    assert claims["minimum inter-event time"].certified == bounds.inter_event_s
    assert {claim.proved for claim in RunClaims(record).evaluate() if claim.source == "(I1)"} == {None}


def test_a_scenario_may_leave_the_search_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cosim.analysis.witnesses.find_witness", None)
    claims = claims_of(simulate(resolved("double_integrator", "horizon_s=1", "certificate.prove=false")))
    assert {claim.proved for claim in claims.values()} == {True}


def test_a_bound_of_the_input_is_compared_where_it_is_the_one_that_acts(record: RunRecord) -> None:
    """Between its arrival at the controller and the plant's next step an update has reset x_c only."""
    run = RunClaims(record).evidence
    reset_s, acts_s = run.observed.waiting
    assert len(reset_s)
    assert (reset_s < acts_s).all()
    between_s = (reset_s + acts_s)[np.isfinite(acts_s)] / 2
    assert not run.bounds_controller_error(between_s).any()
    assert run.bounds_controller_error(acts_s[:1]).all()


@pytest.mark.parametrize(
    ("proven", "apart_s", "exception"),
    [
        (PROVEN, [0.125, 0.25, 0.25], "except between the first two events"),
        (PROVEN._replace(first_event_s=None), [0.0, 0.25, 0.25], "except between the first two events"),
        (PROVEN._replace(first_event_s=0.25), [0.25, 0.25, 0.25], ""),
        (PROVEN._replace(is_quiet=False), [0.0, 0.0, 0.25], "after the first input"),
    ],
)
def test_the_time_between_the_first_events_may_be_unproven(
    proven: ProvenBounds, apart_s: list[float], exception: str
) -> None:
    assert proven.apart_s(np.array([0.0, 0.5, 1.0]), started_s=0.75).tolist() == apart_s
    assert proven.exception == exception


def test_a_proof_is_for_the_times_that_occurred() -> None:
    """A witness for the schedule proves nothing about a run that was later."""
    scenario = resolved("double_integrator")
    allowed = allowed_conditions(scenario)
    longer = allowed._replace(delay_s=2 * allowed.delay_s)
    usual, late = (
        certificates_under(conditions, scenario, most_work=RUN_WORK)[0].certificate
        for conditions in (allowed, longer)
    )
    assert usual.proven is not None
    assert late.proven is not None
    assert late.proven.bounds["x"].decaying > usual.proven.bounds["x"].decaying


def test_many_loops_use_what_was_found_before_or_gains(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cosim.analysis.witnesses.find_witness", None)
    scenario = resolved("double_integrator", "trigger.beta=0.0501")
    certificate = certificates_under(allowed_conditions(scenario), scenario)[0].certificate
    assert certificate.proven is not None
    assert 2.0 < certificate.proven.bounds["x"].decaying < 4.0


def test_outputs_are_claimed_with_their_bounds_and_allowed_errors() -> None:
    """From ln(D₁/(a − D₂))/r on D₁e^(−rt) + D₂ is at most a."""
    outputs = 'outputs=[{name="position", unit="m", allowed=0.05, row=[1.0, 0.0]}]'
    run = simulate(resolved("double_integrator", "horizon_s=20", outputs))
    bounds = find_statement(run.scenario, "own", "schedule", most_work=RUN_WORK).bounds
    assert bounds is not None
    decaying, constant = bounds.bounds["y[0]"]
    settles_s = math.log(decaying / (0.05 - constant)) / bounds.rate_per_s
    claims = claims_of(run)
    bound = claims["position is bounded"]
    assert bound.bound == f"|position| ≤ {at_most(decaying)} e^(−0.3t) + {at_most(constant)} m"
    stays = claims[f"position stays within 0.05 m of its set-point from {at_most(settles_s, 3)} s on"]
    late = run["plant_step"]["t_ns"] * 1e-9 >= settles_s
    assert stays.observed == pytest.approx(np.abs(run["plant_step"]["x"][late, 0]).max())
    assert (stays.output, stays.origin) == ("position", "certificate (proved)")


def test_bounds_of_a_loop_with_a_load_are_checked_about_its_rest() -> None:
    record = simulate(resolved("dc_motor_load", *BELT))
    claims = claims_of(record)
    (settles,) = [what for what in claims if what.startswith("speed stays within 2 of its rest under")]
    assert any(what.startswith("shaft_angle stays within 0.1 of its set-point from") for what in claims)
    assert {claim.proved for claim in claims.values()} == {True}
    steps = record[PLANT_STEP]
    later = steps["t_ns"] * 1e-9 >= float(settles.split(" from ")[1].split(" s on")[0])
    assert claims[settles].observed == pytest.approx(np.abs(steps["x"][later, 1] + 0.2).max(), rel=1e-6)
    state, distance = claims["the state is bounded"], np.hypot(steps["x"][:, 0], steps["x"][:, 1] + 0.2)
    _, rate_text = state.bound.split(" e^(−")
    limit = state.certified * np.exp(-steps["t_ns"] * 1e-9) + float(rate_text.split("+ ")[1])
    assert state.ratio == pytest.approx((distance / limit).max(), rel=1e-3)


def test_they_hold_until_the_load_changes() -> None:
    record = simulate(resolved("dc_motor_load", *BELT, "plant.load_changes=[{at_s=3.5,load=[-0.4]}]"))
    claims = claims_of(record)
    assert claims["the state is bounded"].until_s == pytest.approx(3.5, abs=0.002)
    assert claims["the state is bounded"].proved


def test_a_run_whose_states_do_not_follow_from_each_other_is_none_of_the_document() -> None:
    record = simulate(resolved("dc_motor_load", *BELT))
    far = record.derived(
        record.scenario, lambda table, rows: _with_x(rows, 3.0) if table == PLANT_STEP else rows
    )
    verdicts = {claim.what: claim.verdict for claim in RunClaims(far, most_work=RUN_WORK).evaluate()}
    assert verdicts["shaft_angle is bounded"] == verdicts["the state is bounded"] == "ended"


def _with_x(rows: Rows, angle: float) -> Rows:
    moved = rows.copy()
    moved["x"][:, 0] = angle
    return moved
