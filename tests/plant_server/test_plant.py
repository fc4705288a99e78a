"""The plant: late steps, shared descriptions, and the watchdog of the last actuation."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from noack.protocol.machine_interface import Notice, Record
from noack.protocol.record_tables import PLANT_STEP, tables
from noack.protocol.wire_format import Flow, Message
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate
from tests.machine_parts import OneLoop, linear_plant, plant_of

H_NS = 2_000_000
A = np.array([[0.0, 1.0], [-3.0, 0.4]])
B = np.array([[0.0, 1.0], [2.0, -1.0]])


def new_plant(horizon_ns: int = 10**9, measure_every: int = 1) -> OneLoop:
    x0 = np.array([1.0, -0.5])
    return linear_plant(A, B, x0, H_NS, horizon_ns=horizon_ns, measure_every=measure_every)


def actuation(sequence: int, u: Sequence[float]) -> Message:
    return Message(Flow.ACTUATION, sequence, sequence, np.array(u, dtype=float))


def measured(outputs: Sequence[object]) -> list[Message]:
    return [output for output in outputs if isinstance(output, Message)]


def rows(outputs: Sequence[object], table: str) -> Any:
    """The table's rows in the form that is recorded."""
    found = [out.row for out in outputs if isinstance(out, Record) and out.table == table]
    return np.array(found, tables(2, 2)[table])


def test_late_steps_keep_their_length_and_are_caught_up() -> None:
    on_time, late = new_plant(), new_plant()
    expected, found = [], []
    for plant in (on_time, late):
        plant.handle(actuation(0, [1.0, -1.0]), 0)
    for step in range(20):
        expected += on_time.on_timer(step * H_NS)
    now_ns = 0
    for step in range(20):
        assert late.next_deadline_ns() == step * H_NS  # the grid does not shift
        # Stopped for a quarter of the run, then every step at once.
        now_ns = max(now_ns, step * H_NS) if step != 5 else 10 * H_NS + 123
        found += late.on_timer(now_ns)
    for one, other in zip(measured(expected), measured(found), strict=True):
        assert (one.sequence, one.t_ns) == (other.sequence, other.t_ns)
        assert one.vector.tobytes() == other.vector.tobytes()
    steps = rows(found, PLANT_STEP)
    assert steps["t_ns"].tolist() == [step * H_NS for step in range(20)]
    late_ns = steps["now_ns"] - steps["t_ns"]
    assert late_ns.tolist() == [(10 - k) * H_NS + 123 if 5 <= k <= 10 else 0 for k in range(20)]


MS = 1_000_000
K = np.array([[-3.0, -1.5]])


def scenario(policy: str, **changes: Any) -> Any:
    content: dict[str, Any] = {
        "name": "watched", "horizon_s": 1.0,
        "model": {"A": [[0.0, 1.0], [1.0, 0.5]], "B": [[0.0], [1.0]], "gain": K.tolist()},
        "plant": {
            "initial_state": [1.0, 0.0], "rate_hz": 100.0,
            "watchdog": {"policy": policy, "timeout_s": 0.05},
        },
        "controller": {"rate_hz": 100.0},
        "trigger": {"beta": 0.1, "alpha_per_s": 0.1},
        "network": {"mansd": 2, "loss": {"model": "lossless"}},
    }  # fmt: skip
    return resolve(validate(content | changes, "here"))


class Driven:
    """A plant that executes every step on time."""

    def __init__(self, plant: OneLoop) -> None:
        self.plant = plant
        self.steps: dict[int, Any] = {}
        self.notices: list[Notice] = []

    def until(self, t_ns: int) -> None:
        """Execute every step up to ``t_ns``."""
        while (due_ns := self.plant.next_deadline_ns()) is not None and due_ns <= t_ns:
            for out in self.plant.on_timer(due_ns):
                if isinstance(out, Notice):
                    self.notices.append(out)
                elif isinstance(out, Record):
                    self.steps[due_ns] = np.array([out.row], tables(2, 1)[PLANT_STEP])[0]

    def u(self, t_ns: int) -> float:
        return float(self.steps[t_ns]["u"].item())

    def take(self, sequence: int, t_ns: int, *entries: float) -> None:
        self.plant.handle(Message(Flow.ACTUATION, sequence, t_ns, np.array(entries)), t_ns)


def test_the_watchdog_trips_when_the_actuation_is_older_than_the_timeout() -> None:
    for policy, then in (("hold", 2.0), ("zero", 0.0)):
        for sent_ns, u, trips in ((10 * MS, 2.0, False), (10 * MS - 1, then, True)):
            driven = Driven(plant_of(scenario(policy)))
            driven.take(0, sent_ns, 2.0)
            driven.until(60 * MS)
            assert (driven.u(50 * MS), driven.u(60 * MS)) == (2.0, u)
            expected = [(60 * MS, "watchdog")] if trips else []
            assert [(notice.t_ns, notice.level) for notice in driven.notices] == expected
