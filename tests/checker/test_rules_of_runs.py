"""The rule that the checker reads from a scenario is the one that the sensor tests, along simulated runs."""

import json
from typing import Any

import numpy as np
import pytest

from cosim.simulation.virtual_time import simulate
from noack.proof.elaborate.scenario import read_loop
from noack.protocol.record_tables import SENSOR_MEASUREMENT
from noack.scenario.resolution import resolve
from tests.checker.runs import floats
from tests.helpers.resolved_tables import resolved_tables
from tests.helpers.shipped import shipped

_FORM = [[-0.1, 0.0, 0.0, 0.2], [0.0, -0.2, 0.0, 0.0], [0.0, 0.0, 3.0, 0.5], [0.2, 0.0, 0.5, 2.0]]
RULES: dict[str, dict[str, Any]] = {
    "decaying": {"policy": "decaying", "beta": 0.3, "alpha_per_s": 0.4, "floor": 0.02},
    "weighted": {"policy": "absolute", "delta": 0.1, "weight": [[2.0, 0.5], [0.0, 1.0]]},
    "relative": {"policy": "relative", "sigma": 0.3},
    "mixed": {"policy": "mixed", "sigma": 0.2, "epsilon": 0.05},
    "quadratic": {"policy": "quadratic", "Q": _FORM, "epsilon": 0.01, "period_s": 0.01, "heartbeat": 0},
    "heartbeat": {"policy": "quadratic", "Q": _FORM, "epsilon": 0.3, "period_s": 0.01, "heartbeat": 30},
    "dynamic": {"policy": "dynamic", "sigma": 0.5, "theta_s": 0.5, "decay_per_s": 0.5, "eta_0": 0.1},
    "dwell": {"policy": "dwell", "interval_s": 0.211, "rule": {"policy": "absolute", "delta": 0.05}},
    "deadline": {"policy": "deadline", "interval_s": 0.3, "rule": {"policy": "relative", "sigma": 0.9}},
    "late deadline of a dwell time": {
        "policy": "deadline", "interval_s": 0.4,
        "rule": {"policy": "dwell", "interval_s": 0.1, "rule": {"policy": "absolute", "delta": 0.2}},
    },
}  # fmt: skip
POINTS = {"at 0": (), "at a set-point": ("controller.setpoint=[0.7,0.0]",)}


@pytest.mark.parametrize("point", POINTS)
@pytest.mark.parametrize("name", RULES)
def test_the_sensor_tests_the_rule_that_is_read(name: str, point: str) -> None:
    text = json.dumps(RULES[name]).replace('": ', '" = ')
    settings = (f"trigger={text}", "network.mansd=2", 'mode="zoh"', "horizon_s=4.0", *POINTS[point])
    loop = read_loop(resolved_tables("double_integrator", *settings), box=False, ideal=False)
    rows = simulate(resolve(shipped("double_integrator", *settings)))[SENSOR_MEASUREMENT]
    x_r = np.array([0.7, 0.0]) if POINTS[point] else np.zeros(2)
    P, N, K, rule = floats(loop.rule.positive), floats(loop.rule.negative), floats(loop.gain), loop.rule
    tests = rows[rows["t_ns"] % round(float(loop.times.sampling.p) / float(loop.times.sampling.q) * 1e9) == 0]
    since_ns, eta, rate, before_ns = 0, 0.0 if rule.memory is None else float(rule.memory.start), 0.0, 0
    events = 0
    for row in tests:
        t_ns, x, e = row["t_ns"], row["x"] - x_r, row["x_s"] - row["x"]
        seen = np.concatenate([x, K @ e if rule.of_input else e])
        if rule.memory is not None and t_ns:
            decay, step_s = float(rule.memory.decay), (t_ns - before_ns) * 1e-9
            eta = np.exp(-decay * step_s) * eta - np.expm1(-decay * step_s) / decay * rate
        threshold = max(float(rule.level) * np.exp(-float(rule.rate) * t_ns * 1e-9), float(rule.floor))
        right = np.hypot(threshold, np.linalg.norm(N @ seen)) ** 2 + max(eta, 0.0)
        left = np.linalg.norm(P @ seen) ** 2
        difference = row["compared"] ** 2 - row["threshold"] ** 2
        assert left - right == pytest.approx(difference, rel=1e-9, abs=1e-12)
        dwell_s, is_event = float(loop.times.dwell.p) / float(loop.times.dwell.q), row["event"] >= 0
        if t_ns:
            dwells = (t_ns - since_ns) * 1e-9 < dwell_s - 1e-10
            fires = left > right and not dwells
            assert is_event >= fires
            assert rule.always or is_event == fires
            assert not (is_event and dwells)
        if is_event:
            events, since_ns, seen = events + 1, t_ns, np.concatenate([x, np.zeros(len(seen) - 2)])
        if rule.memory is not None:
            rate = float(seen @ floats(rule.memory.gain) @ seen)
        before_ns = t_ns
    assert events > 3
