"""The live assumption monitor reports the same violations as the evaluation after the run."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller_node.controller import controller_of
from cosim.analysis.claims.assumption_monitor import AssumptionMonitor
from cosim.analysis.claims.claim import ClaimVerdict
from cosim.analysis.claims.claim_evaluation import ClaimEvaluation
from cosim.analysis.claims.condition_reader import ConditionReader, read_conditions
from cosim.analysis.claims.observed_conditions import (
    AssumptionViolation,
    ObservedConditions,
    SampledSeries,
)
from cosim.record.run_record import Rows, RunRecord
from cosim.simulation.virtual_time import simulate
from noack.config.scenario import Scenario
from noack.protocol.machine_interface import Start
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    OWNER,
    PLANT_ACTUATION,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)
from noack.protocol.topology import LOOP_ROLES
from noack.theory.run_conditions import allowed_conditions
from sensor_node.sensor import sensor_of
from tests.cosim.analysis.claims.conftest import Make, changed, network_of
from tests.cosim.live.outage import Deaf, Reborn, simulate_with, with_outage

Batches = Iterator[tuple[str, Rows] | None]
"""A table and some of its rows; None where the result so far is queried."""


def batches(record: RunRecord, seed: int) -> Batches:
    """The record as the processes send it: each in its own order, the processes in any order."""
    rng = np.random.default_rng(seed)
    taken = dict.fromkeys(record.tables, 0)
    while waiting := [table for table in taken if taken[table] < len(record[table])]:
        role = rng.choice([role for role in LOOP_ROLES if any(OWNER[t] == role for t in waiting)])
        own = [table for table in record.tables if OWNER[table] == role]
        first = min(int(record[t]["input"][taken[t]]) for t in own if t in waiting)
        until = first + int(rng.integers(1, 200))
        for table in own:
            end = int(np.searchsorted(record[table]["input"], until))
            yield table, record[table][taken[table] : end]
            taken[table] = end
            if rng.uniform() < 0.2:
                yield None
        if rng.uniform() < 0.5:
            yield None


def guarded(
    record: RunRecord, seed: int = 0
) -> tuple[AssumptionMonitor, list[AssumptionViolation]]:
    """A monitor that received the run in batches, and its reported violations."""
    guard, said = AssumptionMonitor(record.scenario), []
    for batch in batches(record, seed):
        if batch is None:
            said += guard.advance()
        else:
            guard.take(*batch)
    return guard, [*said, *guard.end()]


def hostile(seed: int) -> Any:
    rng = np.random.default_rng(seed)
    lost, late_ms, often = rng.uniform(0, 0.7), int(rng.choice([0, 10, 80, 400])), rng.uniform()

    def decide(number: int) -> int | None:
        if rng.uniform() < lost:
            return None
        return int(rng.integers(0, late_ms + 1)) if rng.uniform() < often else 0

    return network_of(decide)


@st.composite
def scenarios(draw: st.DrawFn, make: Make) -> Scenario:
    watchdog = {"policy": draw(st.sampled_from(["hold", "zero", "model"])), "timeout_s": 0.01}
    sync = draw(st.sampled_from(["first_packet", "known_state"]))
    rate_hz = draw(st.sampled_from([100.0, 200.0]))
    chosen = make().plant.model_dump(exclude_none=True)
    return make(
        horizon_s=1.0, trigger={"beta": draw(st.sampled_from([1e-6, 1e-3]))},
        plant=chosen | {"rate_hz": rate_hz, "watchdog": watchdog},
        controller={"phase": draw(st.sampled_from([0.0, 0.5])), "safe_input": [0.1]},
        network={"initial_sync": sync},
    )  # fmt: skip


def spoilt(record: RunRecord, seed: int) -> RunRecord:
    """A record with missing rows, or of a process that died."""
    rng = np.random.default_rng(seed)
    match int(rng.integers(0, 3)):
        case 1:
            role, end_ns = rng.choice(LOOP_ROLES), rng.uniform(0.2, 1) * 1e9
            own = [table for table in record.tables if OWNER[table] == role]
            return changed(record, **{t: record[t][record[t]["now_ns"] < end_ns] for t in own})
        case 2:
            table = str(rng.choice([CONTROLLER_DELIVERY, SENSOR_MEASUREMENT, PLANT_ACTUATION]))
            kept = rng.uniform(size=len(record[table])) > 0.1
            return changed(record, **{table: record[table][kept]})
    return record


def test_batches_in_any_order_show_what_the_whole_record_shows(make: Make) -> None:
    seen: set[str] = set()

    @settings(max_examples=120)
    @given(scenarios(make), st.integers(0, 2**32))
    def check(resolved: Scenario, seed: int) -> None:
        record = spoilt(simulate(resolved, hostile(seed)), seed)
        observer, parts = ConditionReader(resolved), []
        for batch in batches(record, seed):
            if batch is None:
                parts.append(observer.observed())
            else:
                observer.take(*batch)
        whole, found = read_conditions(record), joined([*parts, observer.end()])
        for one, other in zip(found[1:4], whole[1:4], strict=True):
            np.testing.assert_array_equal(one, other)
        np.testing.assert_array_equal(found.losses, whole.losses)
        np.testing.assert_array_equal(found.watchdog, whole.watchdog)
        np.testing.assert_array_equal(found.safe_input, whole.safe_input)
        assert found.start_s == whole.start_s
        assert all(part.start_s <= whole.start_s for part in parts)
        guard, said = guarded(record, seed)
        expected = whole.violations(allowed_conditions(resolved))
        assert guard.void_from == whole.first_violation(allowed_conditions(resolved))
        assert {one[:2] for one in said} == {one[:2] for one in expected}
        seen.update(one.cause for one in said)

    check()
    assert seen == {"dropouts", "sampling", "delay", "hold", "start", "watchdog", "safe input"}


SERIES = ("sampling", "delay", "hold", "watchdog", "safe_input", "restarts")


def joined(parts: list[ObservedConditions]) -> ObservedConditions:
    def series(name: str) -> SampledSeries:
        found = [getattr(part, name) for part in parts]
        return SampledSeries(*(np.concatenate([one[i] for one in found]) for i in range(2)))

    losses = [part.losses for part in parts]
    return parts[-1]._replace(
        losses=type(losses[0])(*(np.concatenate([one[i] for one in losses]) for i in range(2))),
        **{name: series(name) for name in SERIES},
    )


# --- violation of each condition: the live report, and the evaluation after the run ---------------


def event_s(record: RunRecord, number: int) -> float:
    rows = record[SENSOR_MEASUREMENT]
    return float(rows["t_ns"][rows["event"] == number][0] * 1e-9)


def watched(policy: str, make: Make, **more: Any) -> Scenario:
    """An input may be 35 ms old; the watchdog acts after 20 ms."""
    plant = make().plant.model_dump(exclude_none=True)
    plant["watchdog"] = {"policy": policy, "timeout_s": 0.02}
    return make(plant=plant, certificate={"late_periods": 2}, **more)


def lost_at_the_controller(make: Make) -> tuple[RunRecord, float]:
    record = simulate_with(
        make(), "controller", lambda one: Deaf(one, lambda n: not 10 <= n < 14),
        network_of(lambda n: 0),
    )  # fmt: skip
    return record, event_s(record, 12)


def lost_before_the_network(make: Make) -> tuple[RunRecord, float]:
    lost_before = network_of(lambda n: 0)
    record = simulate_with(
        make(), "network", lambda one: Deaf(one, lambda n: not 10 <= n < 14), lost_before
    )
    return record, event_s(record, 12)


def late_update(make: Make) -> tuple[RunRecord, float]:
    record = simulate(make(), network_of(lambda n: 33 if n == 7 else 0))
    return record, event_s(record, 7)


def no_measurement(make: Make) -> tuple[RunRecord, float]:
    return simulate_with(
        make(), "sensor", lambda one: Deaf(one, lambda n: not 100 <= n < 103)
    ), 0.99


def slow_controller(make: Make) -> tuple[RunRecord, float]:
    return with_outage(make(), 2.0, 2.3), 2.01


def late_start(make: Make) -> tuple[RunRecord, float]:
    return simulate(make(), network_of(lambda n: 500 if n < 3 else 0)), 0.0


def zero_input(make: Make) -> tuple[RunRecord, float]:
    return with_outage(watched("zero", make), 2.0, 2.3), 2.02


def model_input(make: Make) -> tuple[RunRecord, float]:
    return with_outage(watched("model", make), 2.0, 2.3), 2.02


def safe_input(make: Make) -> tuple[RunRecord, float]:
    """The start may take as long as the network's delay, and there must be no input until then."""
    late = {"kind": "delay", "delay_s": 0.1}
    resolved = make(controller={"rate_hz": 100.0, "safe_input": [0.5]})
    network = resolved.network.model_dump() | {"impairments": [late]}
    return simulate(make(controller={"safe_input": [0.5]}, network=network)), 0.01


def started_anew(make: Make) -> tuple[RunRecord, float]:
    """A controller that is restarted at once without a known state, in steps of 10 ms."""
    resolved, at_ns = make(network={"initial_sync": "known_state"}), 2_000_000_000
    successor = controller_of(resolved, Start(1, at_ns))
    record = simulate_with(resolved, "controller", lambda one: Reborn(one, successor, at_ns))
    knows_ns = record[CONTROLLER_DELIVERY]["model_t_ns"]
    assert (knows_ns >= at_ns + 10_000_000).any()
    assert not ((knows_ns >= at_ns) & (knows_ns < at_ns + 10_000_000)).any()
    return record, 2.01


def sensor_anew(make: Make) -> tuple[RunRecord, float]:
    """A sensor that is restarted between two measurements, soon after an event."""
    resolved, at_ns = make(), 50_000_000
    successor = sensor_of(resolved, Start(1, at_ns))
    record = simulate_with(resolved, "sensor", lambda one: Reborn(one, successor, at_ns))
    assert (
        np.diff(record[SENSOR_MEASUREMENT]["t_ns"]) == resolved.timing.measurement_period_ns
    ).all()
    return record, 0.05


@pytest.mark.parametrize(
    ("leave", "why"),
    [
        (lost_at_the_controller, "4 consecutive updates lost, 2 allowed"),
        (lost_before_the_network, "4 consecutive updates lost, 2 allowed"),
        (late_update, "an update took effect after 0.04 s, 0.01 s allowed"),
        (no_measurement, "no measurement for 0.04 s, 0.01 s allowed"),
        (slow_controller, "an input was 0.315 s old, 0.015 s allowed"),
        (late_start, "the plant applied no input until "),
        (zero_input, "the watchdog replaced the input: the newest actuation was "),
        (model_input, "the watchdog replaced the input: the newest actuation was "),
        (safe_input, "the controller had no state and sent its safe input, largest entry 0.5"),
        (started_anew, "the controller had no state and sent its safe input, largest entry 0"),
        (sensor_anew, "the sensor was restarted"),
    ],
)
def test_claims_are_void_from_the_time_and_for_the_reason_that_the_monitor_reports(
    leave: Callable[[Make], tuple[RunRecord, float]], why: str, make: Make
) -> None:
    record, when_s = leave(make)
    judged = [claim for claim in ClaimEvaluation(record).judge() if claim.source == "certificate"]
    assert {claim.verdict for claim in judged} == {ClaimVerdict.VOID}
    # Nothing is recorded of ‖e_c‖ while there is no controller.
    claims = [claim for claim in judged if "e_c" not in claim.bound]
    assert claims
    for claim in claims:
        assert claim.since_s == pytest.approx(when_s)
        assert claim.why.startswith(why)
    guard, said = guarded(record)
    assert guard.void_from == (pytest.approx(when_s), claims[0].why)
    assert len({one.cause for one in said}) == len(said)
    first = min(said)
    assert first.t_s == pytest.approx(when_s)


def test_a_non_finite_value_is_not_a_measurement(make: Make) -> None:
    """At 2000 /s the state is finite for 0.36 s; its norm and that of an error overflow earlier."""
    record = simulate(
        make(
            horizon_s=1.0, model={"A": [[-1.0]], "B": [[1.0]], "gain": [[0.0]]},
            plant={"initial_state": [1.0], "A": [[2000.0]], "B": [[1.0]]},
        )
    )  # fmt: skip
    last_s = float(record[SENSOR_MEASUREMENT]["t_ns"][-1] * 1e-9)
    assert last_s == pytest.approx(0.35)
    guard, said = guarded(record)
    assert ("sampling", pytest.approx(last_s)) in [(one.cause, one.t_s) for one in said]
    with np.errstate(all="ignore"):
        judged = [claim for claim in ClaimEvaluation(record).judge() if claim.source == "(I1)"]
    assert guard.void_from is not None
    for claim in judged:
        assert claim.verdict is ClaimVerdict.VOID
        assert claim.since_s is not None
        assert claim.since_s <= last_s


def test_no_violation_is_reported_in_a_run_that_meets_its_conditions(run: RunRecord) -> None:
    guard, said = guarded(run)
    assert (said, guard.void_from, guard.stopped) == ([], None, None)


def test_only_assumptions_of_existing_claims_are_reported(make: Make) -> None:
    """With another trigger, only (I1) and its consequences are claimed; with acks, nothing."""
    network = network_of(lambda n: None if 10 <= n < 20 else 33)
    for resolved in (make(network={"protocol": "ack"}), _absolute(make)):
        assert guarded(simulate(resolved, network))[1] == []
    gap = simulate_with(
        _absolute(make), "sensor", lambda one: Deaf(one, lambda n: not 100 <= n < 103)
    )
    assert [one.cause for one in guarded(gap)[1]] == ["sampling"]


def _absolute(make: Make) -> Scenario:
    from noack.trigger.absolute import AbsoluteSettings

    return make().model_copy(update={"trigger": AbsoluteSettings(policy="absolute", delta=0.02)})


# --- reports are timely and cost little memory ----------------------------------------------------


def test_an_input_that_is_too_old_is_reported_during_the_outage(make: Make) -> None:
    """The report does not need the controller's own rows."""
    record = with_outage(make(), 2.0, 3.0)
    guard, said = AssumptionMonitor(record.scenario), []
    for table in record.tables:
        of_controller = OWNER[table] == "controller"
        rows = record[table]
        guard.take(table, rows[rows["now_ns"] < (2e9 if of_controller else 2.1e9)])
    said = guard.advance()
    assert [(one.t_s, one.cause) for one in said] == [(pytest.approx(2.01), "hold")]


def test_losses_are_reported_once_the_networks_rows_arrive(make: Make) -> None:
    record = simulate(make(), network_of(lambda n: None if n >= 10 else 0))
    guard = AssumptionMonitor(record.scenario)
    until_ns = event_s(record, 13) * 1e9
    for table in record.tables:
        guard.take(table, record[table][record[table]["now_ns"] < until_ns])
    (one,) = guard.advance()
    assert (one.cause, one.t_s) == ("dropouts", pytest.approx(event_s(record, 12)))


def test_only_rows_that_are_still_needed_are_stored(make: Make) -> None:
    """The memory does not grow with the run; here all processes send every 0.5 s."""
    record = simulate(make(horizon_s=30.0, trigger={"beta": 1e-9}), hostile(1))
    guard, waiting = AssumptionMonitor(record.scenario), []
    for end_ns in range(500_000_000, 30_500_000_000, 500_000_000):
        for table in record.tables:
            t_ns = record[table]["now_ns"]
            guard.take(table, record[table][(t_ns >= end_ns - 500_000_000) & (t_ns < end_ns)])
        guard.advance()
        waiting.append(guard.waiting)
    assert max(waiting) < 150


def test_the_monitor_stops_instead_of_storing_everything(make: Make) -> None:
    """No rows of the controller arrive for a quarter of an hour."""
    record = simulate(make(trigger={"beta": 1e-9}, network={"initial_sync": "known_state"}))
    guard, sensor = AssumptionMonitor(record.scenario), record[SENSOR_MEASUREMENT].copy()
    sensor["event"] = np.arange(len(sensor))
    for number in range(200):
        rows = sensor.copy()
        rows["t_ns"] += number * 6_010_000_000
        rows["event"] += number * len(sensor)
        guard.take(SENSOR_MEASUREMENT, rows)
        guard.advance()
        if guard.stopped is not None:
            break
    assert guard.stopped == "a process has sent no rows for too long"
    assert guard.end() == []


def test_a_claim_violated_before_it_is_void_stays_violated(make: Make) -> None:
    record, _ = slow_controller(make)
    rows = record[SENSOR_MEASUREMENT].copy()
    rows["e_s_norm"][100] = 5.0
    judged = ClaimEvaluation(changed(record, **{SENSOR_MEASUREMENT: rows})).judge()
    claims = {c.what: c for c in judged if c.source == "certificate"}  # fmt: skip
    violated = claims["the sensor's error is bounded"]
    assert (violated.verdict, violated.since_s) == (ClaimVerdict.VIOLATED, pytest.approx(1.0))
    assert claims["the controller's error is bounded"].verdict is ClaimVerdict.VOID
    assert len(record[PLANT_STEP]) == 601
