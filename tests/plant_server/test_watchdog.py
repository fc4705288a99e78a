"""The input that the plant applies when the last actuation is too old."""

from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from noack.config.resolution import resolve
from noack.config.scenario_file import validate
from noack.protocol.machine_interface import Notice, Record
from noack.protocol.record_tables import PLANT_ACTUATION, PLANT_STEP, tables
from noack.protocol.wire_format import Flow, Message
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


@pytest.mark.parametrize("policy", ["hold", "zero", "model"])
def test_the_watchdog_reports_each_trip_once_with_its_duration(policy: str) -> None:
    driven = Driven(plant_of(scenario(policy)))
    carried = (2.0, 0.0, 0.0)[: 3 if policy == "model" else 1]
    driven.until(10 * MS)
    driven.take(0, 5 * MS, *carried)
    driven.until(120 * MS)
    driven.take(1, 115 * MS, *carried)
    driven.until(300 * MS)
    assert [(notice.t_ns, notice.level) for notice in driven.notices] == [
        (60 * MS, "watchdog"), (130 * MS, "watchdog"), (170 * MS, "watchdog"),
    ]  # fmt: skip
    trip, end, _ = (notice.text for notice in driven.notices)
    assert trip.startswith("the newest actuation is too old: 0.055 s, 0.05 s allowed; ")
    assert end == "actuations arrive again; there was none in time for 0.07 s"
    # the newest actuation, even if it is not applied
    assert driven.steps[80 * MS]["actuation"] == 0
    assert driven.u(50 * MS) == driven.u(130 * MS) == 2.0


def test_the_model_policy_applies_the_input_that_the_controller_would_send() -> None:
    """u = K e^{Ht} x_c at every step, from actuations of any age, including one that is too old."""
    driven = Driven(plant_of(scenario("model")))
    closed = np.array([[0.0, 1.0], [1.0, 0.5]]) + np.array([[0.0], [1.0]]) @ K
    x_c = np.array([0.7, -0.2])
    driven.take(0, 3 * MS, *(K @ x_c), *x_c)
    driven.until(200 * MS)
    for t_ns in range(60 * MS, 210 * MS, 10 * MS):
        expected = K @ expm(closed * (t_ns - 3 * MS) * 1e-9) @ x_c
        assert driven.u(t_ns) == pytest.approx(expected.item(), rel=1e-12)
    late = np.array([-1.0, 0.5])
    driven.take(1, 120 * MS, *(K @ late), *late)
    driven.until(210 * MS)
    expected = K @ expm(closed * 0.09) @ late
    assert driven.u(210 * MS) == pytest.approx(expected.item(), rel=1e-12)
    assert len(driven.notices) == 1  # it was too old on arrival


def test_the_model_policy_with_a_hold_model_holds_the_input() -> None:
    driven = Driven(plant_of(scenario("model", mode="zoh")))
    driven.take(0, 3 * MS, 0.1, 0.3, -0.7)
    driven.until(300 * MS)
    assert {driven.u(t_ns) for t_ns in range(10 * MS, 310 * MS, 10 * MS)} == {0.1}


def test_the_safe_input_is_continued_if_the_controller_had_no_state() -> None:
    driven = Driven(plant_of(scenario("model")))
    driven.take(0, 5 * MS, 0.25, 0.0, 0.0)
    driven.until(200 * MS)
    assert driven.u(200 * MS) == 0.25


def test_the_state_carried_by_an_actuation_is_recorded() -> None:
    plant = plant_of(scenario("model"))
    message = Message(Flow.ACTUATION, 4, 5 * MS, np.array([0.5, 1.0, 2.0]))
    (record,) = plant.handle(message, 6 * MS)
    assert isinstance(record, Record)
    row = np.array([record.row], tables(2, 1, predictive=True)[PLANT_ACTUATION])[0]
    assert row["u"].tolist() == [0.5]
    assert row["x_c"].tolist() == [1.0, 2.0]
