"""The input that the plant applies when the last actuation is too old."""

from typing import Any

import numpy as np

from noack.protocol.machine_interface import Notice, Record
from noack.protocol.record_tables import PLANT_STEP, tables
from noack.protocol.wire_format import Flow, Message
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate
from tests.machine_parts import OneLoop, plant_of

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


def test_the_default_timeout_is_50_controller_periods() -> None:
    plant = {"initial_state": [1.0, 0.0], "rate_hz": 100.0}
    default = scenario("hold", plant=plant, controller={"rate_hz": 200.0})
    assert default.timing.actuation_timeout_ns == 250 * MS
    assert default.plant.watchdog.policy == "hold"


def test_before_the_first_actuation_its_age_counts_from_the_start() -> None:
    driven = Driven(plant_of(scenario("hold")))
    driven.until(50 * MS)
    assert driven.notices == []
    driven.until(60 * MS)
    assert driven.notices == [
        Notice(
            60 * MS, "watchdog",
            "no actuation for 0.06 s, 0.05 s allowed; the input is held",
        )
    ]  # fmt: skip
    assert driven.u(60 * MS) == 0.0
