"""The machines of a process: several loops, steps that fail, and refusals of wrong numbers."""

import re
import weakref
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller_node.controller import Controller
from netem.core.errors import CallerError
from noack.core.core_library import ffi, new_handle, pointer_to
from noack.core.linear_systems import Vector
from noack.core.references import Reference, ReferenceSegment
from noack.machines import loop_machines
from noack.machines.loop_machines import LoopMachines, row_layout, row_types
from noack.protocol.record_tables import LOOP, tables
from noack.protocol.roles import Record
from noack.protocol.wire_format import Flow, Message
from noack.scenario.parameter_changes import ParameterChange
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate
from noack.trigger_policies.trigger_rule import TriggerDecision
from plant_server.plant import Plant
from sensor_node.sensor import Sensor, sensors_of
from tests.helpers.approved import compare_lines
from tests.helpers.example_rules import TABLES
from tests.helpers.machine_parts import OneLoop, SteppedMachines, machine
from tests.noack.machines.any_machines import (
    MS,
    Inputs,
    Sizes,
    UserTrigger,
    controller,
    driven,
    observer,
    plain,
    plant,
    refusal_of,
    sensor,
    sizes,
    with_number,
)

Part = Plant | Sensor | Controller
COUNT = 80


def part_of(role: str, number: int, of: Sizes) -> Part:
    """The machine of a loop, with a period of its own."""
    period_ns = (1 + number % 4) * 5 * MS
    if role == "plant":
        return plant(number, of, period_ns=period_ns)
    if role == "sensor":
        return sensor(number, of, form=number)
    return controller(number, of, period_ns=period_ns)


def outputs_of(part: Part, seed: int, rows: int = 1024) -> list[list[Any]]:
    """All outputs of a machine."""
    stepped = SteppedMachines([part], rows=rows)
    return [outputs for *_, outputs in driven(stepped, Inputs(stepped, seed), COUNT)]


@given(sizes(), st.sampled_from(["plant", "sensor", "controller"]), st.integers(0, 1000))
def test_tables_that_are_full_after_each_row_change_nothing(of: Sizes, role: str, number: int) -> None:
    expected = outputs_of(part_of(role, number, of), number)
    assert outputs_of(part_of(role, number, of), number, rows=1) == expected


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
        for loop, machines in enumerate(alone)
        if (due_ns := machines.next_deadline_ns()) is not None
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
    other = content | {"trigger": {"policy": "absolute", "delta": 0.5}}
    together = sensors_of([resolve(validate(loop, "test")) for loop in (content, other)])
    with pytest.raises(CallerError, match="beta"):
        together.announce(ParameterChange(0, 50 * MS, {"trigger.beta": 0.5}), 0)
    assert [structure.machine.inputs for structure in together.machines] == [0, 0]
    assert not any(part.schedule.has_changes for part in together.parts if part.schedule)


def test_an_exception_of_users_code_leaves_the_step_undone() -> None:
    class Interrupted(UserTrigger):
        def test(self, t_ns: int, x: Vector, e_s: Vector) -> TriggerDecision:
            raise KeyboardInterrupt

    part = sensor(0, Sizes(1, 1), form=len(TABLES))
    part._trigger = Interrupted(1.0)
    own = SteppedMachines([part])
    with pytest.raises(KeyboardInterrupt):
        own.handle(Message(Flow.MEASUREMENT, 0, 0, np.zeros(1), 0), 0)
    assert own.machines[0].machine.inputs == 0


def test_machines_live_no_longer_than_they_are_used() -> None:
    own = machine(sensor(0, Sizes(1, 1), form=0))
    reference = weakref.ref(own)
    del own
    assert reference() is None


# --- wrong numbers --------------------------------------------------------------------------------

ROOM = Path(__file__).parents[3] / "native" / "loop"
NULL, FAR, HUGE = ffi.NULL, 2**60 + 1, 2**63 - 1
OF = Sizes(3, 2, 2, 2, 2, carries_model=True, acknowledged=True, disturbed=(True, True))
WRONG = Path(__file__).with_name("wrong_numbers.txt")
"""Machines of any numbers are in tests/native."""


def full_part(role: str) -> Any:
    """A machine with as many parts as one can have."""
    if role == "plant":
        return plant(next(_full_plants()), OF)
    if role == "controller":
        return controller(next(_with_point()), OF)
    rows, waves = [np.zeros((1, 5)), np.ones((2, 5)), np.zeros((1, 5))], np.ones((1, 5))
    segments = [
        ReferenceSegment(begin_ns, row, np.ones(1), waves, waves)
        for begin_ns, row in zip([0, 20 * MS, 30 * MS], rows, strict=True)
    ]
    part = sensor(0, OF, form=list(TABLES).index("dynamic"))
    return replace(
        part, observer=observer(next(_kalman()), 2, 3, 2, 2, 1.0), reference=Reference(segments, 3)
    )


def _full_plants() -> Any:
    for seed in range(100):
        part = plant(seed, OF)
        assert part.measurement is not None
        if part.measurement.is_noisy and part.measurement.C is not None:
            yield seed


def _kalman() -> Any:
    for seed in range(100):
        candidate = observer(np.random.default_rng(seed), 2, 3, 2, 2, 1.0)
        if candidate.settings.kind == "kalman":
            yield np.random.default_rng(seed)


def _with_point() -> Any:
    return (seed for seed in range(100) if controller(seed, OF).reference is not None)


def test_each_wrong_number_is_refused_with_the_approved_text() -> None:
    def refusal(line: str) -> list[str]:
        field, _, value = line.partition(" = ")
        role, _, path = field.partition(" ")
        assert refusal_of(full_part(role)) is None
        given_value = eval(value, {"NULL": NULL, "FAR": FAR, "HUGE": HUGE})
        return [str(refusal_of(with_number(full_part(role), path, given_value)))]

    compare_lines(WRONG, refusal)


def test_every_text_of_the_constructors_is_in_the_approved_file() -> None:
    sources = "".join(file.read_text() for file in ROOM.glob("*.c"))
    texts = re.findall(r'"((?:an?|the) [a-z][^"]+)"', sources)
    approved = [line.partition(": ")[2] for line in WRONG.read_text().splitlines() if line.startswith("    ")]
    assert {*texts} - {*approved} == ELSEWHERE
    assert len(ELSEWHERE) + len({*approved}) == len({*texts})


ELSEWHERE = {
    "a process has no role, no loops or nobody to ask",
    "the rows of a table do not have the size that the machines write",
    "a model needs 1 to 64 states",
    "a model has no matrix",
}
"""Texts about what no machine has in its settings: tested below."""


def test_a_phase_out_of_range_is_refused() -> None:
    for phase_ns in (-1, FAR):
        with pytest.raises(ValueError, match="phase"):
            LoopMachines([controller(1, Sizes(1, 1))], [phase_ns])


def test_models_of_wrong_sizes_are_refused() -> None:
    for n, H, text in ((0, np.eye(1), "1 to 64"), (65, np.eye(65), "1 to 64"), (2, None, "no matrix")):
        with pytest.raises(ValueError, match=text):
            new_handle("transitions", n, ffi.NULL if H is None else pointer_to(H, "double *"))


def test_processes_of_wrong_numbers_are_refused() -> None:
    own = LoopMachines([controller(1, Sizes(1, 1)), controller(2, Sizes(3, 1))])
    machines = ffi.new("noack_machine *[]", [ffi.addressof(handle.machine) for handle in own.machines])

    def process(*, role: int = 2, loops: int = 2, ask: Any = own._ask, **of_table: Any) -> Any:
        tables = ffi.new("noack_table[]", [own.core.tables[number] for number in range(3)])
        for name, value in of_table.items():
            setattr(tables[0], name, value)
        return new_handle("process", role, loops, machines, ask, tables)

    process()
    for numbers in ({"role": 3}, {"role": -1}, {"loops": 0}, {"loops": 65536}, {"ask": ffi.NULL}):
        with pytest.raises(ValueError, match="no role, no loops or nobody"):
            process(**numbers)  # type: ignore[arg-type]
    row_bytes = own.core.tables[0].row_bytes
    for of_table in (
        {"rows": ffi.NULL}, {"places": 0}, {"places": HUGE}, {"row_bytes": HUGE}, {"row_bytes": -1},
        {"row_bytes": row_bytes + 1}, {"row_bytes": row_bytes - 8}, {"layouts": ffi.NULL},
        {"kind_of": ffi.NULL}, {"kinds": 1}, {"kinds": -1},
    ):  # fmt: skip
        with pytest.raises(ValueError, match="rows of a table"):
            process(**of_table)


@pytest.mark.parametrize("word", [-3, 11])
def test_a_layout_with_a_word_that_the_machine_does_not_write_is_refused(
    word: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def layout(*of: Any) -> Any:
        words = row_layout(*of)
        words[4] = word
        return words

    monkeypatch.setattr(loop_machines, "row_layout", layout)
    with pytest.raises(ValueError, match="rows of a table"):
        LoopMachines([controller(1, Sizes(1, 1)), controller(2, Sizes(3, 1))])


def test_a_machine_that_the_core_refuses_raises_its_text() -> None:
    with pytest.raises(ValueError, match=r"^controller: an actuation has more than 64 entries$"):
        LoopMachines([controller(1, OF._replace(predictions=31))])
