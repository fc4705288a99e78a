"""Loops whose clocks differ: a claim that is not void is not violated (docs/derivations.md).

The true time is the plant's. The controller and the network read clocks that are off by tens of
milliseconds and drift, and nobody corrects them. So all that a run's record shows of it are delays
and ages.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import pytest

from cosim.analysis.claims.claim_evaluation import RunClaims
from cosim.analysis.claims.condition_reader import read_conditions
from cosim.analysis.replay import replay
from cosim.analysis.summary.summary_model import Claim, ClaimCause, ClaimKind, ClaimVerdict
from cosim.record.run_record import RunRecord
from noack.runtime.control_messages import ClockError
from noack.runtime.host_clocks import CHRONY, CLOCK_NOTICE, RECEIVED, CausalityCheck
from noack.scenario.scenario import Scenario
from tests.cosim.analysis.claims.conftest import Make
from tests.cosim.record.changed_records import changed
from tests.cosim.simulation.event_scheduler import record_of_run
from tests.helpers.machine_parts import Machine

MS = 1_000_000
PPB = 10**9


class OtherClock:
    """A machine that reads a clock with an offset and a drift; the loop goes on in true time."""

    def __init__(self, machine: Machine[Any], offset_ns: int, drift_ppb: int) -> None:
        self._machine, self._offset_ns, self._drift_ppb = machine, offset_ns, drift_ppb

    def _own_ns(self, true_ns: int) -> int:
        return true_ns + self._offset_ns + self._drift_ppb * true_ns // PPB

    def next_deadline_ns(self) -> int | None:
        due_ns = self._machine.next_deadline_ns()
        if due_ns is None:
            return None
        true_ns = (due_ns - self._offset_ns) * PPB // (PPB + self._drift_ppb)
        while self._own_ns(true_ns) < due_ns:
            true_ns += 1
        return max(true_ns, 0)  # the run begins at the true time 0

    def handle(self, message: Any, now_ns: int) -> Sequence[Any]:
        return self._machine.handle(message, self._own_ns(now_ns))

    def on_timer(self, now_ns: int) -> Sequence[Any]:
        return self._machine.on_timer(self._own_ns(now_ns))


def simulated(scenario: Scenario, clocks: dict[str, tuple[int, int]]) -> RunRecord:
    """Simulate with the offset in ns and the drift in ppb of the clock of each role."""
    wraps = {
        role: partial(OtherClock, offset_ns=offset_ns, drift_ppb=drift_ppb)
        for role, (offset_ns, drift_ppb) in clocks.items()
    }
    return record_of_run(scenario, wraps=wraps)


@pytest.mark.parametrize("delay_s", [0.0, 0.01])
def test_every_claim_holds_whatever_the_clocks(make: Make, delay_s: float) -> None:
    """Offsets of up to 50 ms, drifts of up to 100 ppm; late runs have a certificate for that."""
    impairments = [{"kind": "delay", "delay_s": delay_s}] if delay_s else []
    rng, seen = np.random.default_rng(5), set()
    for number in range(5):
        scenario = make(
            horizon_s=3.0, certificate={"late_periods": number % 2 * 3},
            network={"impairments": impairments},
        )  # fmt: skip
        most_ns = int(rng.choice([5, 50])) * MS
        clocks = {
            name: (int(rng.integers(-most_ns, most_ns)), int(rng.integers(-100_000, 100_000)))
            for name in ("controller", "netem", "sensor")
        }
        record = simulated(scenario, clocks)
        claims = RunClaims(record)
        verdicts = {claim.verdict for claim in claims.evaluate() if claim.source == "certificate"}
        assert verdicts == {ClaimVerdict.HELD}, clocks
        seen.add(claims.certified_for is not None)
        assert replay(record).bit_exact
    assert seen == {True, False}


# --- causality -----------------------------------------------------------------------------------


ERROR_NS = 500_000


def across_hosts(record: RunRecord, **errors_ns: int) -> RunRecord:
    """The record of a run whose processes had hosts of their own, with the reported errors of clocks."""
    reports = {}
    for role in ("plant", "sensor", "netem", "controller"):
        error_ns = errors_ns.get(role, ERROR_NS)
        clock = ClockError(clock=role, error_ns=error_ns, source=CHRONY).fields()
        reports[role] = {**record.reports.get(role, {"ended": "horizon", "rows": {}}), "clock": clock}
    return changed(record, reports=reports)


def judged(record: RunRecord) -> list[Claim]:
    return RunClaims(record).evaluate()


def test_clocks_within_their_bounds_change_no_verdict(make: Make) -> None:
    alone = simulated(make(clocks={}), {"controller": (ERROR_NS, 0), "sensor": (-ERROR_NS, 0)})
    apart = across_hosts(alone)
    assert judged(apart) == judged(alone)
    assert ClaimVerdict.HELD in {claim.verdict for claim in judged(apart)}
    assert read_conditions(apart).summary()["clock_error_s"] == ERROR_NS * 1e-9
    assert read_conditions(alone).summary()["clock_error_s"] is None


@pytest.mark.parametrize(
    ("clocks", "receiver", "lead_s"),
    [
        ({"controller": (20 * MS, 0)}, "plant", 0.02),
        ({"controller": (-20 * MS, 0)}, "controller", 0.02),
        ({"sensor": (-20 * MS, 0)}, "sensor", 0.02),
    ],
)
def test_all_claims_end_where_a_message_came_before_it_was_sent(
    make: Make, clocks: dict[str, tuple[int, int]], receiver: str, lead_s: float
) -> None:
    record = across_hosts(simulated(make(clocks={}), clocks))
    (end,) = {claim.since_s for claim in judged(record) if claim.source == "(I1)"}
    assert end is not None
    assert {claim.detail for claim in judged(record) if claim.cause is ClaimCause.CLOCK} == {receiver}
    assert read_conditions(record).early_messages[receiver].largest() == pytest.approx(lead_s)
    held = {claim.kind for claim in judged(record) if claim.verdict is ClaimVerdict.HELD}
    assert held == {ClaimKind.GUARANTEE}  # it counts updates, without a clock
    # The same is reported during the run.
    check = CausalityCheck(receiver, record.clocks, 1.0)
    table, _ = RECEIVED[receiver]
    notice = check.check(table, record[table])
    assert notice is not None
    assert notice.level == CLOCK_NOTICE
    assert notice.t_ns * 1e-9 == pytest.approx(end, abs=1e-9)
    assert check.check(table, record[table]) is None


def test_a_larger_error_that_was_reported_explains_it(make: Make) -> None:
    record = simulated(make(clocks={}), {"controller": (20 * MS, 0)})
    claims = judged(across_hosts(record, controller=25 * MS))
    assert ClaimCause.CLOCK not in {claim.cause for claim in claims}


def test_without_a_report_the_scenario_states_the_error(make: Make) -> None:
    record = simulated(make(clocks={"largest_error_us": 7.0}), {})
    known = across_hosts(record).reports
    partly = changed(record, reports={"sensor": known["sensor"]})
    assert {role: clock.error_ns for role, clock in partly.clocks.items()} == {
        "plant": 7000,
        "sensor": ERROR_NS,
        "netem": 7000,
        "controller": 7000,
    }
