"""Disturbances and measurement noise: their distributions, independence, order and seeds."""

from typing import Any

import numpy as np
import pytest
from scipy.stats import kstest

from noack.protocol.roles import Record
from noack.protocol.wire_format import Flow, Message
from noack.scenario.resolution import resolve, tables_of
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from plant_server.plant import BLOCK, MeasurementModel, disturbance_of
from tests.helpers.machine_parts import OneLoop, plant_of

STEPS = 4000


@pytest.fixture
def disturbed(content: dict[str, Any]) -> dict[str, Any]:
    content["horizon_s"] = 2.0
    content["plant"] |= {
        "rate_hz": 100.0,
        "disturbances": [
            {"kind": "gaussian", "std": [0.3]},
            {"kind": "uniform", "at": "state", "bound": [0.2, 0.0]},
            {"kind": "sine", "at": "state", "amplitude": [0.0, 1.5], "hz": 0.7, "phase_rad": 0.4},
            {"kind": "step", "amplitude": [2.0], "from_s": 0.5, "until_s": 1.0},
        ],
        "measurement": {"noise_std": [0.1, 0.0], "noise_bound": [0.0, 0.05]},
    }
    return content


def scenario_of(content: dict[str, Any]) -> Scenario:
    return resolve(validate(content, "test"))


def steps_of(plant: OneLoop, scenario: Scenario, count: int) -> tuple[Any, list[Message]]:
    rows, sent = [], []
    for k in range(count):
        plant.handle(Message(Flow.ACTUATION, k, 0, np.array([np.sin(0.1 * k)])), 0)
        for out in plant.on_timer(k * scenario.timing.plant_period_ns):
            if isinstance(out, Record):
                rows.append(out.row)
            elif isinstance(out, Message):
                sent.append(out)
    return np.array(rows, tables_of(scenario)["plant_step"]), sent


def test_disturbances_have_their_distributions_and_are_independent(
    disturbed: dict[str, Any],
) -> None:
    disturbance = disturbance_of(scenario_of(disturbed))
    assert disturbance is not None
    d, w = disturbance.values(range(STEPS))
    d = d[:, 0]
    t_s = np.arange(STEPS) * 0.01
    there = (t_s >= 0.5) & (t_s < 1.0)
    normal = (d - 2.0 * there) / 0.3
    assert kstest(normal, "norm").pvalue > 1e-3
    assert kstest(w[:, 0], "uniform", (-0.2, 0.4)).pvalue > 1e-3
    np.testing.assert_allclose(w[:, 1], 1.5 * np.sin(2 * np.pi * 0.7 * t_s + 0.4), atol=1e-12)
    model = MeasurementModel(np.eye(2), np.array([0.5, 0.0]), np.array([0.0, 0.2]), seed=7)
    noise = model.noise(0, STEPS)
    assert kstest(noise[:, 0] / 0.5, "norm").pvalue > 1e-3
    assert kstest(noise[:, 1], "uniform", (-0.2, 0.4)).pvalue > 1e-3
    # White and mutually independent: correlations of 4,000 samples are within 4/√4000.
    for signal, other in ((normal[1:], normal[:-1]), (w[1:, 0], w[:-1, 0]), (normal, w[:, 0])):
        assert abs(np.corrcoef(signal, other)[0, 1]) < 4 / np.sqrt(STEPS)


def test_a_disturbance_does_not_depend_on_the_order_of_the_steps(disturbed: dict[str, Any]) -> None:
    disturbance, other = disturbance_of(scenario_of(disturbed)), disturbance_of(scenario_of(disturbed))
    assert disturbance is not None
    assert other is not None
    d, w = disturbance.values(range(BLOCK, 3 * BLOCK))
    for first in (2 * BLOCK, BLOCK):
        rows = slice(first - BLOCK, first)
        again = other.values(range(first, first + BLOCK))
        assert tuple(v.tobytes() for v in again) == (d[rows].tobytes(), w[rows].tobytes())


def test_a_seed_changes_only_its_own_disturbance(disturbed: dict[str, Any]) -> None:
    base = scenario_of(disturbed)
    rows, sent = steps_of(plant_of(base), base, 20)
    noise = base.model_copy(update={"seeds": base.seeds.model_copy(update={"noise": 1})})
    other, received = steps_of(plant_of(noise), noise, 20)
    assert rows.tobytes() == other.tobytes()
    assert all(a.vector.tobytes() != b.vector.tobytes() for a, b in zip(sent, received, strict=True))
    gusts = base.model_copy(update={"seeds": base.seeds.model_copy(update={"disturbance": 1})})
    rows_2, sent_2 = steps_of(plant_of(gusts), gusts, 20)
    assert (rows_2["d"] != rows["d"]).all()
    v, v_2 = (
        np.array([m.vector for m in messages]) - some["x"]
        for messages, some in ((sent, rows), (sent_2, rows_2))
    )
    np.testing.assert_allclose(v, v_2, atol=1e-12)
