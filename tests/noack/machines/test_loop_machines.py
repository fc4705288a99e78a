"""The machines of a process: several loops, what interrupts a step, announcements, restarts."""

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import noack.core.core_library
import sensor_node.sensor
from controller_node.controller import Controller
from noack.controllers.linear_feedback import LinearFeedback
from noack.core.errors import CallerError
from noack.core.linear_systems import discretise
from noack.impairments.loss_guarantee import LongestBurst, LossGuarantee
from noack.machines.loop_machines import row_types
from noack.plants.linear import LinearSystem
from noack.protocol.machine_interface import GENERATION, Notice, Record, Start
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    LOOP,
    NO_SEQUENCE,
    SENSOR_MEASUREMENT,
    SENSOR_SETTING,
    tables,
)
from noack.protocol.wire_format import Flow, Message
from noack.scenario.parameter_changes import LATE, ParameterChange
from noack.scenario.resolution import resolve, tables_of
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from noack.trigger.trigger_rule import CodedPolicy
from plant_server.plant import BLOCK, Plant
from sensor_node.sensor import Sensor, sensors_of
from tests.machine_parts import OneLoop, SteppedMachines, controller_of, machine, sensor_of
from tests.noack.machines.any_machines import (
    MS,
    Inputs,
    Sizes,
    UserLaw,
    UserSystem,
    UserTrigger,
    controller,
    driven,
    matrix,
    observer,
    plain,
    plant,
    sensor,
    sizes,
)
from tests.trigger_rules import absolute_rule
from tests.wire_decoder import NO_VECTOR

Part = Plant | Sensor | Controller
COUNT = 120


def part_of(role: str, number: int, of: Sizes) -> Part:
    """The machine of a loop, with a period of its own."""
    period_ns = (1 + number % 4) * 5 * MS
    if role == "plant":
        return plant(number, of, period_ns=period_ns)
    if role == "sensor":
        return sensor(number, of, form=number)
    return controller(number, of, period_ns=period_ns)


def outputs_of(part: Part, seed: int = 1, rows: int = 1024, ask: Callable[..., None] | None = None):
    """All outputs of a machine; ``ask`` is called before each input, and may provoke a question."""
    one = SteppedMachines([part], rows=rows)
    inputs, found = Inputs(one, seed), []
    while len(found) < COUNT:
        if ask is not None:
            ask(one.machines[0])
        found += [outputs for *_, outputs in driven(one, inputs, 1)]
    return found


@given(sizes(), st.sampled_from(["plant", "sensor", "controller"]), st.integers(0, 1000))
def test_tables_that_are_full_after_each_row_change_nothing(
    of: Sizes, role: str, number: int
) -> None:
    expected = outputs_of(part_of(role, number, of), number)
    assert outputs_of(part_of(role, number, of), number, rows=1) == expected


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("acknowledged", [False, True])
@pytest.mark.parametrize("outputs", [0, 1])
def test_a_users_trigger_that_asks_at_each_input_decides_as_the_rule(
    monkeypatch: pytest.MonkeyPatch, outputs: int, acknowledged: bool, known: bool
) -> None:
    """There is room for one row and, at first, for one update: inputs have several questions."""
    H, timeout_ns = matrix(np.random.default_rng(3), 1.0, 2, 2), 20 * MS

    def own(policy: Any) -> Sensor:
        observing = observer(np.random.default_rng(4), 1, 2, 1, 1, 1.0) if outputs else None
        x0 = np.ones(2) if known else None
        return Sensor(H, policy, x0, timeout_ns=timeout_ns if acknowledged else None,
                      observer=observing)  # fmt: skip

    expected = outputs_of(own(absolute_rule(0.7)))
    user = UserTrigger(0.7)
    monkeypatch.setattr(sensor_node.sensor, "_SENT_PLACES", 1)
    found = outputs_of(own(CodedPolicy(None, lambda: user, "it is code")), rows=1)
    assert found == expected
    sent = sum(len(one) > 1 for one in expected)
    assert 10 < sent < COUNT
    # Asked once for each input, whatever else interrupts it; begun again at events.
    measured = sum(one[-1][0] == SENSOR_MEASUREMENT for one in expected)
    assert user.calls.count("test") == measured
    restarts = user.calls.count("restart")
    assert (restarts > 5) == acknowledged
    assert user.calls.count("start") == (1 if acknowledged else sent + 1)


@pytest.mark.parametrize("setpoint", [None, (np.ones(2), np.array([0.3]))])
def test_a_users_law_that_is_asked_at_each_input_acts_as_the_linear_one(setpoint: Any) -> None:
    K, H = np.array([[0.3, -1.7]]), matrix(np.random.default_rng(3), 1.0, 2, 2)

    def own(law: Any) -> Controller:
        return Controller(H, law, 1, 10 * MS, 0, 10**12, LossGuarantee((LongestBurst(3),)),
                          setpoint=setpoint)  # fmt: skip

    assert outputs_of(own(UserLaw(K)), rows=1) == outputs_of(own(LinearFeedback(K)))


@pytest.mark.parametrize("disturbed", [(False, False), (True, True)])
def test_a_users_system_that_is_asked_at_each_step_moves_as_the_linear_one(
    disturbed: tuple[bool, bool],
) -> None:
    of = Sizes(2, 1, disturbed=disturbed)
    built_in, asked = plant(5, of), plant(5, of)
    system = built_in.system
    assert isinstance(system, LinearSystem)
    Ad, Bd = discretise(system.A, system.B, asked.period_ns)
    asked.system = UserSystem(Ad, Bd, system.x, system.z, 10**15)
    assert outputs_of(asked, rows=1) == outputs_of(built_in)


def test_signals_that_are_missing_at_each_step_are_the_same_signals() -> None:
    def forget(own: Any) -> None:
        for signal in (own.at_input, own.at_state, own.noise):
            signal.first = -BLOCK

    of = Sizes(2, 1, 1, 3, disturbed=(True, True))
    assert plant(1, of).measuring.is_noisy  # type: ignore[union-attr]
    assert outputs_of(plant(1, of), ask=forget) == outputs_of(plant(1, of))


@pytest.mark.parametrize("places", [4, 8])
def test_matrices_that_are_computed_again_have_the_same_bits(
    monkeypatch: pytest.MonkeyPatch, places: int
) -> None:
    """Steps of 300 lengths, three times, in fewer places; other lengths come between."""
    H, rng = matrix(np.random.default_rng(1), 3.0, 3, 3), np.random.default_rng(2)
    gaps = np.tile(rng.permutation(np.arange(1, 301)), 3) * (MS + 1)
    found = []
    for most in (1024, places):
        monkeypatch.setattr(noack.core.core_library, "_MOST_PLACES", most)
        one = machine(Sensor(H, absolute_rule(1.0, n=3)))
        assert one.machines[0].model.transitions.places == most
        rows = [
            one.handle(Message(Flow.MEASUREMENT, k, int(t_ns), np.sin(k + np.arange(3.0))), 0)
            for k, t_ns in enumerate(np.cumsum(gaps))
        ]
        found.append([output for outputs in rows for output in outputs])
    assert repr(found[0]) == repr(found[1])
    assert len({*gaps.tolist()}) == 300


@given(
    st.lists(
        st.tuples(sizes(), st.integers(0, 1000), st.sampled_from([0, 3, 5, 40])),
        min_size=2, max_size=5,
    ),
    st.sampled_from(["plant", "sensor", "controller"]),
    st.integers(0, 1000),
)  # fmt: skip
def test_several_loops_do_what_each_does_alone(
    loops: list[tuple[Sizes, int, int]], role: str, seed: int
) -> None:
    """Loops of different sizes, periods and phases; only the numbers of the loops are added."""
    phases_ns = [phase_ms * MS for *_, phase_ms in loops]
    together = SteppedMachines([part_of(role, number, of) for of, number, _ in loops], phases_ns)
    alone = [machine(part_of(role, number, of)) for of, number, _ in loops]
    inputs = Inputs(together, seed)
    for _ in range(COUNT):
        message, now_ns = inputs.next()
        loop = next_tick(alone, phases_ns) if message is None else message.loop
        own_ns = now_ns - phases_ns[loop]
        if message is None:
            outputs, expected = together.on_timer(now_ns), alone[loop].on_timer(own_ns)
        else:
            outputs = together.handle(message, now_ns)
            expected = alone[loop].handle(message._replace(loop=0), own_ns)
        inputs.sent[loop] += [output for output in outputs if isinstance(output, Message)]
        for written, own in zip(outputs, expected, strict=True):
            assert (written.row[0] if isinstance(written, Record) else written.loop) == loop
            if isinstance(own, Record):
                compare_rows(together, loop, written, own)
            else:
                assert plain([written], numbered=False) == plain([own], numbered=False)


def next_tick(alone: list[OneLoop], phases_ns: list[int]) -> int:
    """Return the loop whose tick is due first; at the same time, that of the smaller number."""
    dues_ns = [
        (due_ns + phases_ns[loop], loop)
        for loop, one in enumerate(alone)
        if (due_ns := one.next_deadline_ns()) is not None
    ]
    return min(dues_ns)[1]


def compare_rows(together: SteppedMachines, loop: int, written: Any, own: Record) -> None:
    """A loop's vector is the beginning of the table's; the rest is NaN; other columns are 0."""
    assert written.table == own.table
    types = row_types([part.shape for part in together.parts])[own.table]
    names = tables(**asdict(together.parts[loop].shape))[own.table].names or ()
    row = dict(zip(types.names or (), written.row, strict=True))
    for name, value in zip(names, own.row, strict=True):
        given_value = np.atleast_1d(row[name])
        size = np.size(value)
        assert given_value[:size].tobytes() == np.atleast_1d(value).tobytes()
        assert np.isnan(given_value[size:]).all()
    missing = [row[name] for name in row if name not in (LOOP, *names)]
    assert not any(np.any(value) for value in missing)


def test_a_change_that_a_later_loop_refuses_changes_no_loop(content: dict[str, Any]) -> None:
    """The second loop's trigger has no β."""
    first = scenario(content)
    second = scenario(content | {"trigger": {"policy": "absolute", "delta": 0.5}})
    together = sensors_of((first, second))
    with pytest.raises(CallerError, match="beta"):
        together.announce(ParameterChange(0, 50 * MS, {"trigger.beta": 0.5}), 0)
    assert [structure.machine.inputs for structure in together.machines] == [0, 0]
    assert not any(part.schedule.has_changes for part in together.parts if part.schedule)


def scenario(content: dict[str, Any], **changes: Any) -> Scenario:
    return resolve(validate({**content, **changes}, "test"))


def measured(sensor: SteppedMachines, k: int, loop: int = 0, phase_ns: int = 0) -> Any:
    """The row of a measurement, every 10 ms of its loop's time."""
    vector = np.array([np.sin(k), 0.1 * k])
    message = Message(Flow.MEASUREMENT, k, k * 10 * MS, vector, loop)
    outputs = sensor.handle(message, k * 10 * MS + phase_ns)
    (row,) = [one.row for one in outputs if isinstance(one, Record)]
    return row


def test_a_change_that_is_announced_late_applies_from_the_next_time_on(
    content: dict[str, Any],
) -> None:
    """The second loop begins 25 ms after the first; both are at 50 ms of their own time."""
    content["trigger"] = {"policy": "absolute", "delta": 0.5}
    one = scenario(content)
    together = SteppedMachines(sensors_of((one, one)).parts, [0, 25 * MS])
    names = tables_of(one)[SENSOR_MEASUREMENT].names
    assert names is not None

    def thresholds(k: int) -> list[float]:
        rows = [measured(together, k, loop, loop * 25 * MS) for loop in (0, 1)]
        return [row[1 + names.index("threshold")] for row in rows]

    assert [thresholds(k) for k in range(6)] == [[0.5, 0.5]] * 6
    # In time for the second loop alone: T is 35 + 25 ms of the run.
    outputs = together.announce(ParameterChange(0, 75 * MS, {"trigger.delta": 0.1}), 70 * MS)
    assert [one.row[:6] for one in outputs if isinstance(one, Record)] == [
        (0, 6, 0, 75 * MS, 70 * MS, 75 * MS), (1, 6, 0, 50 * MS, 45 * MS, 50 * MS + 1),
    ]  # fmt: skip
    assert {one.table for one in outputs if isinstance(one, Record)} == {SENSOR_SETTING}
    (notice,) = [one for one in outputs if isinstance(one, Notice)]
    assert (notice.loop, notice.t_ns, notice.level) == (1, 50 * MS + 1, LATE)
    assert [thresholds(k) for k in range(6, 9)] == [[0.5, 0.1], [0.5, 0.1], [0.1, 0.1]]


def test_a_late_change_of_the_set_point_moves_model_and_law_from_then_on(
    content: dict[str, Any],
) -> None:
    content["network"]["initial_sync"] = "known_state"
    content["controller"] = {"rate_hz": 100.0, "phase": 0.0}
    one = controller_of(scenario(content))
    before = [one.on_timer(k * 10 * MS)[0] for k in range(6)]
    change = ParameterChange(0, 20 * MS, {"controller.setpoint": [2.0, 0.0]})
    _, notice = one.announce(change, 55 * MS)
    assert isinstance(notice, Notice)
    assert notice.t_ns == 50 * MS + 1
    after, *_ = one.on_timer(60 * MS)
    assert isinstance(before[-1], Message)
    assert isinstance(after, Message)
    # u = -(x - 2) - 1.5 v jumps by 2; x has hardly moved within 10 ms.
    assert after.vector[0] - before[-1].vector[0] == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("generation", [1, 3])
def test_a_restarted_machine_continues_its_grid_under_other_numbers(
    content: dict[str, Any], generation: int
) -> None:
    content["network"] |= {"initial_sync": "known_state", "mansd": 2}
    content["controller"] = {"rate_hz": 100.0, "phase": 0.0, "safe_input": [0.25]}
    one, first = scenario(content), generation * GENERATION
    restarted = controller_of(one, Start(generation, 33 * MS))
    assert restarted.next_deadline_ns() == 40 * MS
    message, record = restarted.on_timer(41 * MS)
    assert isinstance(message, Message)
    assert isinstance(record, Record)
    assert (message.sequence, message.t_ns, message.vector.tolist()) == (first + 4, 40 * MS, [0.25])
    assert (record.table, record.row[:4]) == (CONTROLLER_STEP, (first, first + 4, 40 * MS, 41 * MS))
    # Losses before its first update are unknown, later ones are counted; a restarted sensor numbers
    # its updates from another generation on.
    dropouts = []
    for sequence in (7, 8, 11, first + GENERATION, first + GENERATION + 4):
        outputs = restarted.handle(Message(Flow.UPDATE, sequence, 45 * MS, np.ones(2)), 45 * MS)
        (row,) = [output.row for output in outputs if isinstance(output, Record)]
        dropouts.append(row[-1])
        violations = [output for output in outputs if isinstance(output, Notice)]
        assert bool(violations) == (row[-1] > 2)
    assert dropouts == [0, 0, 2, 0, 3]
    assert {output.table for output in outputs if isinstance(output, Record)} == {
        CONTROLLER_DELIVERY
    }
    again = sensor_of(one, Start(generation, 33 * MS))
    rows = [measured(again, k) for k in (4, 5)]
    assert [row[0] for row in rows] == [first, first + 1]
    assert rows[0][-1] == first  # its first measurement is an event
    assert rows[1][-1] in (first + 1, NO_SEQUENCE)


def test_acknowledgements_of_updates_before_a_restart_change_nothing() -> None:
    again = machine(
        Sensor(
            np.zeros((1, 1)), absolute_rule(0.1, n=1), first_number=GENERATION, timeout_ns=10 * MS
        )
    )
    again.handle(Message(Flow.MEASUREMENT, 5, 50 * MS, np.ones(1)), 50 * MS)
    (record,) = again.handle(Message(Flow.ACKNOWLEDGEMENT, 7, 30 * MS, NO_VECTOR), 51 * MS)
    assert isinstance(record, Record)
    assert record.row[-2].tolist() == record.row[-1].tolist() == [0.0]
    (record,) = again.handle(Message(Flow.ACKNOWLEDGEMENT, GENERATION, 50 * MS, NO_VECTOR), 52 * MS)
    assert isinstance(record, Record)
    assert record.row[-1].tolist() == [1.0]
