"""The observed conditions of a run: from complete and from damaged records."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.analysis.claims.condition_reader import read_conditions
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    NO_SEQUENCE,
    PLANT_ACTUATION,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)
from noack.scenario.scenario import Scenario
from noack.theory.bounds.terms import NetworkConditions
from noack.theory.certificates.conditions import nominal_conditions
from tests.cosim.analysis.claims.conftest import (
    Make,
    event_s,
    network_of,
    without,
)
from tests.cosim.record.changed_records import changed

PERIODS_NS = [1_000_000, 2_000_000, 3_000_000, 5_000_000, 7_000_000, 2_020_000, 13_370_000]


def allowed(record: RunRecord) -> NetworkConditions:
    return nominal_conditions(record.scenario, 0)


def violation_of(record: RunRecord) -> tuple[float, str]:
    found = read_conditions(record).first_violation(allowed(record))
    assert found is not None
    return found


def busy(
    step_ns: int, tick_ns: int, every: int, phase: float, sync: str, horizon_s: float, make: Make
) -> Scenario:
    """Almost every measurement is an event."""
    return make(
        horizon_s=horizon_s,
        plant={"rate_hz": 1e9 / step_ns, "measure_every": every},
        controller={"rate_hz": 1e9 / tick_ns, "phase": phase},
        trigger={"beta": 1e-12},
        network={"initial_sync": sync},
    )


def test_a_simulated_run_keeps_to_its_own_schedule_whatever_the_rates(make: Make) -> None:
    @settings(max_examples=20)
    @given(
        st.sampled_from(PERIODS_NS), st.sampled_from(PERIODS_NS), st.integers(1, 4),
        st.sampled_from([0.0, 0.1, 0.5, 0.99]) | st.floats(0, 0.999),
        st.sampled_from(["first_packet", "known_state"]),
    )  # fmt: skip
    def check(step_ns: int, tick_ns: int, every: int, phase: float, sync: str) -> None:
        resolved = busy(step_ns, tick_ns, every, phase, sync, 0.3, make)
        record = simulate(resolved)
        assert read_conditions(record).first_violation(nominal_conditions(resolved, 0)) is None

    check()


@pytest.mark.parametrize(
    ("step_ns", "tick_ns", "every", "phase"),
    [
        (2_000_000, 2_000_000, 1, 0.5),  # the demo's rates
        (2_000_000, 3_000_000, 1, 0.0),
        (5_000_000, 7_000_000, 3, 0.5),
        (4_000_000, 5_000_000, 2, 0.0168),
        (7_000_000, 2_000_000, 1, 0.9),
        (2_000_000, 2_020_000, 1, 0.3),
    ],
)
def test_the_worst_case_of_a_schedule_occurs(
    step_ns: int, tick_ns: int, every: int, phase: float, make: Make
) -> None:
    """The assumed delays and ages occur exactly, to the nanosecond."""
    resolved = busy(step_ns, tick_ns, every, phase, "first_packet", 0.6, make)
    seen, assumed = read_conditions(simulate(resolved)).summary(), nominal_conditions(resolved, 0)
    for name in ("sampling_s", "delay_s", "hold_s", "start_s"):
        assert seen[name] == pytest.approx(getattr(assumed, name), abs=1e-12), name


# --- violation of each condition, reported with the right time ------------------------------------


@pytest.mark.parametrize(
    ("delays_ms", "number", "why"),
    [
        (dict.fromkeys((4, 5, 8, 9, 10, 11), None), 10, "4 consecutive updates lost, 2 allowed"),
        (dict.fromkeys((7, 8, 9), 2000), 9, "3 consecutive updates lost, 2 allowed"),
        # 33 ms later, at the next tick, and at the plant's step after that tick.
        ({7: 33}, 7, "an update took effect after 0.04 s, 0.01 s allowed"),
        (dict.fromkeys(range(20, 100), None), 22, " consecutive updates lost, 2 allowed"),
    ],
    ids=["too many", "stale", "late", "up to the end"],
)
def test_lost_and_late_updates_are_reported_at_their_events(
    delays_ms: dict[int, int | None], number: int, why: str, make: Make
) -> None:
    record = simulate(make(), network_of(lambda n: delays_ms.get(n, 0)))
    when_s, found = violation_of(record)
    assert when_s == pytest.approx(event_s(record, number))
    assert found.endswith(why)


@pytest.mark.parametrize(
    ("gone", "when_s", "gap_s"),
    [(slice(100, 103), 0.99, 0.04), (slice(5), 0.0, 0.05), (slice(300, None), 2.99, 3.01)],
)
def test_missing_measurements_are_reported_at_the_last_measurement_before_them(
    run: RunRecord, gone: slice, when_s: float, gap_s: float
) -> None:
    rows = np.delete(run[SENSOR_MEASUREMENT], gone)
    found = violation_of(changed(run, {SENSOR_MEASUREMENT: rows}))
    assert found == (pytest.approx(when_s), f"no measurement for {gap_s} s, 0.01 s allowed")


def test_a_stale_update_is_not_lost_if_the_newer_one_arrived_in_time(make: Make) -> None:
    """The delay of every other update is just long enough for the next update to arrive first."""
    resolved = make()
    allowance_s = 0.4
    record = simulate(resolved, network_of(lambda n: 500 if n % 2 else 0))
    observed = read_conditions(record)
    taken = set(record[CONTROLLER_DELIVERY]["sequence"].tolist())
    delivered_out_of_order = [n for n in range(len(observed.losses.t_s) - 2) if n not in taken]
    assert delivered_out_of_order
    assert observed.losses.consecutive(0.0).largest() == 1
    assert observed.losses.consecutive(allowance_s).largest() == 0


def held(run: RunRecord, first: int, last: int, by: int) -> RunRecord:
    """Steps ``first`` to ``last`` − 1 apply inputs that are older by ``by`` steps."""
    steps = run[PLANT_STEP].copy()
    steps["actuation"][first:last] -= by
    return changed(run, {PLANT_STEP: steps})


def test_an_old_input_is_reported_when_it_exceeds_the_maximum_age(run: RunRecord) -> None:
    assert read_conditions(run).summary()["hold_s"] == pytest.approx(0.015)
    assert violation_of(held(run, 200, 210, 3)) == (
        pytest.approx(2.0), "an input was 0.045 s old, 0.015 s allowed",
    )  # fmt: skip


def test_an_input_from_the_future_violates_the_maximum_age(run: RunRecord) -> None:
    """A plant that is 3.5 steps late latches an input computed for a later time."""
    assert read_conditions(held(run, 200, 203, -2)).first_violation(allowed(run)) is None
    assert violation_of(held(run, 200, 203, -4)) == (
        pytest.approx(2.0), "an input was 0.035 s old, 0.015 s allowed",
    )  # fmt: skip


def test_an_update_late_at_the_model_is_late_even_if_the_plant_was_later(
    run: RunRecord,
) -> None:
    deliveries = run[CONTROLLER_DELIVERY].copy()
    deliveries["model_t_ns"][5] += 30_000_000
    when_s, why = violation_of(changed(run, {CONTROLLER_DELIVERY: deliveries}))
    assert when_s == pytest.approx(deliveries["t_ns"][5] * 1e-9)
    assert why == "an update took effect after 0.03 s, 0.01 s allowed"


def test_the_start_is_late_unless_the_initial_state_is_known(make: Make) -> None:
    network = network_of(lambda n: 500 if n < 3 else 0)
    known = simulate(make(network={"initial_sync": "known_state"}), network)
    assert read_conditions(known).start_s == pytest.approx(0.01)
    when_s, why = violation_of(simulate(make(), network))
    assert when_s == 0.0
    assert why.startswith("the plant applied no input until")


def test_a_plant_without_any_input_has_no_time_of_the_first(make: Make) -> None:
    run = simulate(make())
    steps = run[PLANT_STEP].copy()
    steps["actuation"] = NO_SEQUENCE
    _, why = violation_of(changed(run, {PLANT_STEP: steps}))
    assert why.startswith("the plant applied no input at all, the first within 0.0")


# --- incomplete records ---------------------------------------------------------------------------


def test_losses_are_derived_from_the_controller_without_network_rows(
    run: RunRecord,
) -> None:
    whole, blind = read_conditions(run), read_conditions(without(run, "netem"))
    assert blind.losses.consecutive(0.0).largest() == whole.losses.consecutive(0.0).largest() == 2
    assert blind.hold.largest() == whole.hold.largest()


def until(run: RunRecord, end_s: float, *names: str) -> RunRecord:
    cut = {name: run[name][run[name]["now_ns"] < end_s * 1e9] for name in names}
    return changed(run, cut)


def test_inputs_of_unrecorded_ticks_have_the_largest_possible_age(run: RunRecord) -> None:
    ticks, inputs = run[CONTROLLER_STEP], run[PLANT_ACTUATION]
    gap = slice(300, 310)
    record = changed(run, {CONTROLLER_STEP: np.delete(ticks, gap)})
    # The plant's record has the times of the missing ticks.
    assert read_conditions(record).hold.largest() == pytest.approx(0.015)
    record = changed(record, {PLANT_ACTUATION: np.delete(inputs, gap)})
    when_s, why = violation_of(record)
    assert when_s == pytest.approx(3.01)
    assert "an input was" in why


def test_every_table_may_be_empty(run: RunRecord) -> None:
    empty = without(run, "plant", "sensor", "netem", "controller")
    found = read_conditions(empty)
    assert set(found.summary().values()) == {None}
    assert found.first_violation(allowed(run)) is not None
    step = np.zeros(1, run[PLANT_STEP].dtype)
    step["actuation"] = NO_SEQUENCE
    assert read_conditions(changed(empty, {PLANT_STEP: step})).start_s == np.inf


def test_a_stale_update_at_the_end_of_the_run_is_not_lost(make: Make) -> None:
    """The controller has the newer update, but no plant step is left that could apply it."""
    busy = make(trigger={"beta": 1e-6}, horizon_s=1.0)
    events = simulate(busy, network_of(lambda n: 0))[SENSOR_MEASUREMENT]["event"]
    late = int(events.max()) - 1
    assert (events[-2:] == [late, late + 1]).all()  # an event at each of the last measurements
    record = simulate(busy, network_of(lambda n: 18 if n == late else 0))
    assert late not in record[CONTROLLER_DELIVERY]["sequence"]
    assert late + 1 in record[CONTROLLER_DELIVERY]["sequence"]
    assert read_conditions(record).losses.consecutive(0.02).largest() == 0
