"""The compiled machines of many loops against the single machines, bit for bit."""

import random
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from controller_node.controller import controller_of
from controller_node.controller_arrays import CONTROLLER_FLEET
from noack.config.fleet_layout import FleetRole
from noack.config.loops import phases_ns
from noack.config.parameter_changes import ParameterChange
from noack.config.resolution import resolved_loops, run_tables
from noack.config.scenario import Scenario
from noack.config.scenario_file import validate
from noack.core.errors import CallerError
from noack.protocol.fleet import Fleet
from noack.protocol.machine_interface import Machine, Notice, Output, Record
from noack.protocol.record_tables import (
    CONTROLLER_SETTING,
    LOOP,
    PLANT_ACTUATION,
    SENSOR_SETTING,
)
from noack.protocol.wire_format import Flow, Message
from noack.runtime.fleet import fleet_memory
from noack.runtime.fleet.compiled_driver import compiled_driver, compiled_replay
from noack.runtime.fleet.compiled_fleet import CompiledFleet
from noack.runtime.fleet.fleet_choice import may_be_compiled
from noack.runtime.fleet.fleet_replay import FleetReplay, replay_arguments
from plant_server.plant import plant_of
from plant_server.plant_arrays import PLANT_FLEET
from sensor_node.sensor import sensor_of
from sensor_node.sensor_arrays import SENSOR_FLEET

Content = dict[str, Any]
ROLES: dict[str, tuple[FleetRole, Callable[[Scenario], Machine[Message]]]] = {
    "plant": (PLANT_FLEET, plant_of),
    "sensor": (SENSOR_FLEET, sensor_of),
    "controller": (CONTROLLER_FLEET, controller_of),
}
RUN_ID, KEY = 2**63 + 5, bytes(range(32))
POLICIES: list[Content] = [
    {"policy": "decaying", "beta": 0.05, "alpha_per_s": 0.25},
    {"policy": "decaying", "beta": 0.2, "alpha_per_s": 2.0, "floor": 0.01,
     "weight": [[2.0, 0.3], [0.0, 1.0]]},
    {"policy": "mixed", "sigma": 0.1, "epsilon": 0.01},
    {"policy": "relative", "sigma": 0.2},
    {"policy": "absolute", "delta": 0.03},
    {"policy": "periodic", "period_s": 0.05},
    {"policy": "dwell", "interval_s": 0.04, "rule": {"policy": "lyapunov", "rate_per_s": 0.3}},
]  # fmt: skip


def compiled(name: str, run: Scenario) -> CompiledFleet:
    role, loops = ROLES[name][0], resolved_loops(run)
    parts = role.parts_of(loops)
    assert parts is not None
    return CompiledFleet(name, role, parts, run, loops, RUN_ID, KEY)


class Pair:
    """The machines of a role, single and compiled, which get the same inputs."""

    def __init__(self, name: str, run: Scenario) -> None:
        role, machine_of = ROLES[name]
        loops = resolved_loops(run)
        self._tables = run_tables(run)
        self._single = Fleet([*map(machine_of, loops)], phases_ns(run))
        self._compiled = compiled(name, run)
        self._compiled.use(compiled_driver(role, self._compiled.arguments))
        self._rows: dict[str, list[Any]] = {}
        self.sent: list[tuple[int, int, list[float]]] = []
        """Number, time and vector of each message."""
        self.notices: list[str] = []

    def announce(self, change: ParameterChange, now_ns: int) -> None:
        self._compare(
            self._single.announce(change, now_ns), self._compiled.announce(change, now_ns)
        )

    def due_ns(self) -> int | None:
        due_ns = self._single.next_deadline_ns()
        assert self._compiled.next_deadline_ns() == due_ns
        return due_ns

    def on_timer(self, now_ns: int) -> list[Message]:
        single: list[Output] = []
        while (due_ns := self._single.next_deadline_ns()) is not None and due_ns <= now_ns:
            single += self._single.on_timer(now_ns)
        return self._compare(single, self._compiled.on_timer(now_ns))

    def handle(self, message: Message, now_ns: int) -> list[Message]:
        return self._compare(
            self._single.handle(message, now_ns), self._compiled.handle(message, now_ns)
        )

    def _compare(self, single: Sequence[Output], compiled: Sequence[Output]) -> list[Message]:
        assert sorted(map(self._bits, single)) == sorted(map(self._bits, compiled))
        for output in single:
            if isinstance(output, Record):
                self._rows.setdefault(output.table, []).append(output.row)
            elif isinstance(output, Notice):
                self.notices.append(output.text)
        messages = [one for one in single if isinstance(one, Message)]
        self.sent += [(one.sequence, one.t_ns, one.vector.tolist()) for one in messages]
        return messages

    @property
    def rows(self) -> dict[str, Any]:
        """The rows of the single machines."""
        return {table: np.array(rows, self._tables[table]) for table, rows in self._rows.items()}

    def _bits(self, output: Output) -> str:
        if isinstance(output, Message):
            return str((*output._replace(vector=np.zeros(0)), output.vector.tobytes()))
        if isinstance(output, Record):
            row = np.zeros(1, self._tables[output.table])
            row[0] = output.row
            return f"{output.table} {row.tobytes().hex()}"
        return str(output)


def drive(
    run: Scenario,
    seed: int,
    *,
    loss: float,
    delay_ns: int,
    announced: Sequence[tuple[int, ParameterChange]] = (),
) -> dict[str, Pair]:
    """Run all loops with late timers, and with datagrams that are lost and delayed at random."""
    chance = random.Random(seed)
    pairs = {name: Pair(name, run) for name in ROLES}
    newest: dict[tuple[str, int], int] = {}
    flying: list[tuple[int, int, str, Message]] = []
    to = {Flow.MEASUREMENT: "sensor", Flow.UPDATE: "controller", Flow.ACTUATION: "plant"}
    count, waiting = 0, [*announced]
    while True:
        dues = [(due, name) for name, pair in pairs.items() if (due := pair.due_ns()) is not None]
        if not dues and not flying:
            return pairs
        flying.sort(key=lambda one: one[:2])
        next_ns = min([due for due, _ in dues] + [one[0] for one in flying])
        while waiting and waiting[0][0] <= next_ns:
            now_ns, change = waiting.pop(0)
            for name in ("sensor", "controller"):
                pairs[name].announce(change, now_ns)
        if flying and (not dues or flying[0][0] < min(dues)[0]):
            now_ns, _, name, message = flying.pop(0)
            if message.sequence <= newest.get((name, message.loop), -1):
                continue  # a decoder accepts newer messages only
            newest[name, message.loop] = message.sequence
            sent = pairs[name].handle(message, now_ns)
        else:
            due_ns, name = min(dues)
            now_ns = due_ns + chance.randrange(2_000_000)
            sent = pairs[name].on_timer(now_ns)
        for message in sent:
            crosses = message.flow is Flow.UPDATE
            if chance.random() < (loss if crosses else 0.02):
                continue
            count += 1
            after_ns = chance.randrange(1, delay_ns if crosses else 1_000_000)
            flying.append((now_ns + after_ns, count, to[message.flow], message))


@pytest.fixture
def loops(content: Content) -> Content:
    content["horizon_s"] = 1.5
    content["plant"] |= {
        "rate_hz": 100.0, "draw": "uniform", "uncertainty_A": [[0.0, 0.0], [0.5, 0.5]],
        "initial_state_halfwidth": [0.5, 0.5],
    }  # fmt: skip
    content["controller"] = {"rate_hz": 100.0}
    content["loops"] = [
        {"name": f"loop-{number}", "count": 2, "trigger": policy}
        for number, policy in enumerate(POLICIES)
    ]
    return content


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize(
    "change",
    [
        {},
        {"mode": "zoh"},
        {"controller": {"rate_hz": 100.0, "setpoint": [0.1, 0.0]}},
        {
            "network": {
                "initial_sync": "first_packet",
                "constraints": [{"kind": "at_most", "losses": 3, "window": 10}],
            }
        },
        {"plant": {"measure_every": 2, "watchdog": {"policy": "zero", "timeout_s": 0.04}}},
    ],
    ids=["model", "held", "set point", "first event", "watchdog"],
)
def test_compiled_machines_have_the_bits_of_the_single_ones(
    loops: Content, change: Content, seed: int
) -> None:
    for key, value in change.items():
        loops[key] = loops[key] | value if isinstance(value, dict) else value
    run = validate(loops, "here")
    pairs = drive(run, seed, loss=0.5, delay_ns=60_000_000)
    assert all(sum(map(len, pair.rows.values())) > 500 for pair in pairs.values())


def test_all_plants_report_missing_actuations_at_once(
    loops: Content, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet_memory, "_NOTES", 2)
    loops["plant"]["watchdog"] = {"policy": "zero", "timeout_s": 0.04}
    pair = Pair("plant", validate(loops, "here"))
    while (due_ns := pair.due_ns()) is not None:
        pair.on_timer(due_ns)
    assert len(pair.notices) == 2 * len(POLICIES)
    assert all("the input is 0" in text for text in pair.notices)


def test_a_replay_finds_every_row_again_and_one_changed_bit(loops: Content) -> None:
    run = validate(loops, "here")
    for name, pair in drive(run, 3, loss=0.3, delay_ns=60_000_000).items():
        rows = pair.rows
        code = compiled_replay(ROLES[name][0], replay_arguments(compiled(name, run)))
        of_loops, inputs = (
            np.concatenate([found[column] for found in rows.values()]) for column in (LOOP, "input")
        )
        order = np.lexsort((inputs, of_loops))
        sent = FleetReplay(compiled(name, run), code).take(rows, order)
        assert sent is not None
        assert sorted(zip(*(one.tolist() for one in sent), strict=True)) == sorted(pair.sent)
        for table, recorded in rows.items():
            if table == PLANT_ACTUATION:
                continue  # it has inputs only
            changed = recorded.copy()
            changed.view(np.uint8).reshape(len(recorded), -1)[len(recorded) // 2, -9] ^= 1
            other = rows | {table: changed}
            assert FleetReplay(compiled(name, run), code).take(other, order) is None


def test_changes_of_the_network_have_the_rows_and_notices_of_the_single_machines(
    loops: Content,
) -> None:
    loops["network"] |= {"mansd": 8, "initial_sync": "first_packet"}
    run = validate(loops, "here")
    announced: list[tuple[int, ParameterChange]] = [
        (0, ParameterChange(0, 0, {"network.loss.probability": 0.5})),
        (300_000_000, ParameterChange(1, 500_000_000, {"network.mansd": 1})),
        (1_210_000_000, ParameterChange(2, 1_200_000_000, {"network.mansd": 3})),  # too late
    ]  # fmt: skip
    pairs = drive(run, 4, loss=0.6, delay_ns=60_000_000, announced=announced)
    for name, table in (("sensor", SENSOR_SETTING), ("controller", CONTROLLER_SETTING)):
        assert len(pairs[name].rows[table]) == len(announced) * len(resolved_loops(run))
        assert any("too late" in text for text in pairs[name].notices)
    texts = " ".join(pairs["controller"].notices)
    assert "at most 1 assumed" in texts
    assert "at most 3 assumed" in texts


def test_machines_whose_own_settings_change_are_not_compiled(loops: Content) -> None:
    assert may_be_compiled(validate(loops, "here"))
    loops["changes"] = [{"at_s": 0.5, "set": {"network.mansd": 1}}]
    assert may_be_compiled(validate(loops, "here"))
    loops["changes"] = [{"at_s": 0.5, "set": {"controller.setpoint": [0, 0]}}]
    assert not may_be_compiled(validate(loops, "here"))
    fleet = compiled("sensor", validate(loops, "here"))
    with pytest.raises(CallerError, match="keep their settings"):
        fleet.announce(ParameterChange(0, 0, {"controller.setpoint": [0, 0]}), 0)
    del loops["changes"]
    loops["loops"] = loops["loops"][:1]
    assert not may_be_compiled(validate(loops, "here"))
