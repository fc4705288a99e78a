"""Send-on-area: live against an independent quadrature, exact and batch against scipy."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cosim.simulation.batch import run_batch, run_events
from cosim.simulation.continuous import ContinuousRun
from cosim.simulation.exact_simulation import OK
from tests.cosim.simulation.batch.exact import one, random_population, random_setting, reference
from tests.noack.trigger.core_trigger import CoreTrigger
from tests.trigger_rules import area_rule, with_dwell_time

MS = 1_000_000
W = np.array([[2.0, 0.5], [0.0, 1.0]])


def test_a_live_sensor_sums_trapezoids_and_restarts_at_an_event() -> None:
    trigger, x = CoreTrigger(area_rule(0.1, W), 2), np.ones(2)
    trigger.start(0, x)
    since_ms, area, last, events = 0, 0.0, 0.0, []
    for t_ms in range(2, 2000, 2):
        e_s = 0.1 * (t_ms - since_ms) / 1000 * np.array([math.cos(t_ms / 300), 1.0])
        size = float(np.linalg.norm(W @ e_s))
        area, last = area + 0.002 * (last + size) / 2, size
        found = trigger.test(t_ms * MS, x, e_s)
        assert found.left == pytest.approx(area, rel=1e-12)
        assert found.right == 0.1
        assert found.event == (area > 0.1)
        if found.event:
            events.append(t_ms)
            trigger.start(t_ms * MS, x)
            since_ms, area, last = t_ms, 0.0, 0.0
    assert len(events) >= 1


def integrated(run: ContinuousRun, weight: np.ndarray | None) -> np.ndarray:
    """∫‖W e_s‖ dt from each start to the next event, by an integrator."""
    areas = []
    for start, end_s in zip((run.start, *run.after), (*run.event_s, run.horizon_s), strict=True):
        z0 = np.concatenate([*start[1:], [0.0]])
        n = len(start.x)

        def flow(t: float, y: np.ndarray, n: int = n) -> np.ndarray:
            e_s = y[n : 2 * n]
            size = np.linalg.norm(e_s if weight is None else weight @ e_s)
            return np.append(run.system.generator @ y[:-1], size)

        if end_s > start.t_s:
            found = solve_ivp(
                flow, (start.t_s, end_s), z0, method="DOP853", rtol=1e-11, atol=1e-14
            )  # fmt: skip
            areas.append(float(found.y[-1, -1]))
    return np.array(areas)


def test_exact_events_agree_with_an_integrator() -> None:
    events = 0
    for seed in range(8):
        setting, draw = drawn(seed, 0.01)
        run = reference(setting, draw, 3000)
        areas = integrated(run, setting.trigger.weight)
        first = 0 if setting.known_start else 1  # with an unknown start, event 0 is at t = 0
        between = areas[: len(run.event_s) - first]
        np.testing.assert_allclose(between, 0.01, rtol=1e-8)
        assert (areas[len(between) :] <= 0.01 * (1 + 1e-8)).all()
        events += len(between)
    assert events > 20


@pytest.mark.parametrize("dwell", [False, True])
def test_a_batch_has_the_events_of_the_exact_simulator(dwell: bool) -> None:
    events = 0
    for seed in range(6):
        setting, draw = drawn(seed, 0.01)
        if dwell:
            setting = replace(setting, trigger=with_dwell_time(setting.trigger, 120 * MS))
        run, found = reference(setting, draw, 3000), run_events(setting, draw)
        np.testing.assert_allclose(found.event_s, run.event_s, rtol=0, atol=1e-9)
        assert found.delivered.tolist() == run.delivered.tolist()
        (row,) = run_batch(setting, draw)
        assert row["status"] == OK
        events += len(found.event_s)
    assert events > 20


def drawn(seed: int, delta_s: float):
    rng = np.random.default_rng([seed, 7])
    setting = random_setting(rng, 2, 1)
    trigger = area_rule(delta_s, setting.trigger.weight)
    setting = replace(setting, trigger=trigger, most_events=3000)
    return setting, one(random_population(rng, setting, 1), 0)
