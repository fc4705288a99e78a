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
from cosim.analysis.summary.summary_model import Claim, ClaimVerdict
from cosim.record.align import aligned_parts
from cosim.record.record_source import rows_by_loop
from cosim.record.run_record import Rows, RunRecord
from cosim.simulation.virtual_time import simulate
from noack.protocol.record_tables import CLOCK_TABLES, LOST_NS, OWNER, tables
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
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


def test_nothing_is_claimed_of_an_older_x_c_than_that_of_the_input() -> None:
    """A controller that is ahead resets x_c at a later model time than an update acts on the plant.

    The open loop decays faster than the models, so the older x_c exceeds the bound by 24 %.
    """
    content = {
        "name": "ahead", "horizon_s": 6.0,
        "model": {"A": [[-5.0]], "B": [[1.0]], "gain": [[4.95]]},
        "plant": {"draw": "given", "A": [[-5.2]], "B": [[1.0]], "initial_state": [1.0], "rate_hz": 100.0},
        "controller": {"rate_hz": 100.0},
        "trigger": {"policy": "periodic", "period_s": 0.5},
        "network": {"mansd": 0, "loss": {"model": "lossless"}, "initial_sync": "known_state"},
        "certificate": {"late_periods": 0},
    }  # fmt: skip
    scenario = resolve(validate(content, "test"))
    record = simulated(scenario, {"controller": (150 * MS, 0)})
    claims = RunClaims(record)
    verdicts = {claim.verdict for claim in claims.evaluate() if claim.source == "certificate"}
    assert verdicts == {ClaimVerdict.HELD}
    (certificate,), (part,) = claims.certified_evidence.certificates, aligned_parts(record)
    t_s = np.asarray(part.aligned.t_ns * 1e-9)
    largest = float((part.aligned.e_c_norm / certificate.controller_error(t_s)).max())
    assert largest == pytest.approx(1.245, abs=0.01)


# --- bounds of the clocks' errors that a run has recorded -----------------------------------------


GOOD_NS, WIDE_NS = 20_000, 3 * MS
Errors = dict[tuple[str, int], int]
"""The bounds that differ, by table and number of the row."""


@pytest.fixture(scope="module")
def clocked(make: Make) -> RunRecord:
    """A run whose processes recorded the bounds of their clocks' errors every 50 ms."""
    record = simulate(make(clocks={"largest_error_us": 1000.0}))
    return changed(record, {table: clock_rows(record, table) for table in CLOCK_TABLES})


def clock_rows(record: RunRecord, table: str) -> Rows:
    ends_ns = np.arange(0, 6001, 50) * MS
    rows = np.zeros(len(ends_ns), record.tables[table])
    rows["input"] = np.arange(len(ends_ns))
    rows["now_ns"], rows["t_ns"] = ends_ns, ends_ns - 50 * MS
    rows["error_ns"] = 0 if OWNER[table] == "plant" else GOOD_NS
    return rows


def with_errors(record: RunRecord, errors: Errors, **t_ns: int) -> RunRecord:
    rows = {table: record[table].copy() for table in CLOCK_TABLES}
    for (table, number), error_ns in errors.items():
        rows[table]["error_ns"][number] = error_ns
        rows[table]["t_ns"][number] = t_ns.get(table, rows[table]["t_ns"][number])
    return changed(record, rows)


def judged(record: RunRecord) -> list[Claim]:
    return RunClaims(record).evaluate()


def test_small_bounds_change_no_verdict(make: Make, clocked: RunRecord) -> None:
    without = judged(simulate(make()))
    assert judged(clocked) == without
    assert {claim.source for claim in without} >= {"certificate", "(I1)"}
    assert ClaimVerdict.HELD in {claim.verdict for claim in without}
    assert read_conditions(clocked).summary()["clock_error_s"] == pytest.approx(GOOD_NS * 1e-9)


LOST = "the bound of the error of sensor's clock was lost"


@pytest.mark.parametrize(
    ("errors", "t_ns", "since_s", "reason"),
    [
        (
            {("netem_clock", 40): WIDE_NS}, {}, 1.95,
            "the clock of netem may have been off by 0.003 s, 0.001 s allowed",
        ),
        ({("sensor_clock", 40): LOST_NS}, {}, 1.95, LOST),
        ({("sensor_clock", 60): LOST_NS}, {"sensor_clock": 777 * MS}, 0.777, LOST),
        ({("sensor_clock", 0): LOST_NS}, {"sensor_clock": -5 * MS}, 0.0, LOST),
        ({("sensor_clock", 40): LOST_NS, ("sensor_clock", 60): LOST_NS},
         {"sensor_clock": 777 * MS}, 0.777, LOST),
    ],
)  # fmt: skip
def test_all_claims_are_void_from_then_on_for_that_reason(
    clocked: RunRecord, errors: Errors, t_ns: dict[str, int], since_s: float, reason: str
) -> None:
    record = with_errors(clocked, errors, **t_ns)
    for claim in judged(record):
        assert claim.verdict is not ClaimVerdict.HELD
        if claim.verdict is ClaimVerdict.VOID and claim.since_s != 0:
            assert claim.since_s == pytest.approx(since_s)
            assert reason in claim.why
    assert ClaimVerdict.VOID in {claim.verdict for claim in judged(record)}
    first = min(RunClaims(record).violations())
    assert (first.t_s, first.text) == (pytest.approx(since_s), reason)


def test_each_of_several_loops_has_the_rows_in_its_own_time() -> None:
    table, phases_ns = CLOCK_TABLES[0], (0, 7)
    rows = np.zeros(2, tables(1, 1, clocks=True)[table])
    rows["t_ns"] = 10, 20
    by_loop = dict(rows_by_loop(table, rows, phases_ns, [{table: rows.dtype}] * 2))
    assert [loop_rows["t_ns"].tolist() for loop_rows in by_loop.values()] == [[10, 20], [3, 13]]


def test_the_claims_of_a_stopped_run_end_with_it(clocked: RunRecord) -> None:
    """What a clock does after the common end is not part of the claims."""
    reports = {
        role: {"ended": "stopped", "reached_ns": 3000 * MS, "rows": {}}
        for role in ("plant", "sensor", "netem", "controller")
    }
    late = changed(with_errors(clocked, {("sensor_clock", 100): LOST_NS}), reports=reports)
    assert RunClaims(late).violations() == []
    early = changed(with_errors(clocked, {("sensor_clock", 50): LOST_NS}), reports=reports)
    (violation,) = RunClaims(early).violations()
    assert violation.cause == "sensor clock lost"
