"""The maps of the time-triggered loop against simulated runs, and the margin against patterns."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from cosim.simulation.virtual_time import simulate
from noack.core.linear_systems import Matrix, Vector, discretise
from noack.impairments.loss_guarantee import (
    DeliveriesBetweenBursts,
    LongestBurst,
    LossesInWindow,
    LossGuarantee,
    LossHistory,
)
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from noack.theory.margins.loss_margin import LossMargin
from noack.theory.margins.time_triggered_loop import TimeTriggeredLoop
from tests.approved import compare_lines, lines_of_error

ROOT = Path(__file__).parents[3]
PERIODIC = 'trigger={policy="periodic", period_s=0.0997}'
DWELL = '{policy="dwell", interval_s=0.11, rule={policy="absolute", delta=1}}'
DEADLINE = f'{{policy="deadline", interval_s=0.3, rule={DWELL}}}'
DELAYED = 'network.impairments=[{kind="delay", delay_s=0.0333}]'


def scenario(name: str, *settings: str) -> Scenario:
    settings = (PERIODIC, "network.mansd=20", *settings)
    return resolve(load(ROOT / "scenarios" / f"{name}.toml", settings))


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("double_integrator", ()),
        ("double_integrator", ("mode=zoh",)),
        ("double_integrator", (DELAYED,)),
        ("double_integrator", ("controller.rate_hz=10", DELAYED.replace("333", "99"))),
        ("double_integrator", ("controller.rate_hz=40", "controller.phase=0.3")),
        ("double_integrator", ("plant.measure_every=7", "controller.phase=0")),
        ("lane_following", ("controller.phase=0", "controller.rate_hz=125", DELAYED)),
    ],
)
def test_maps_are_those_of_a_simulated_run(name: str, settings: Sequence[str]) -> None:
    resolved = scenario(name, "horizon_s=6", *settings)
    margin, loop = LossMargin(resolved), loop_of(resolved)
    delay_ns = margin.loop.times.delay_ns
    fates = np.random.default_rng(1).random(1000) < 0.5
    fates[0] = True
    numbers = iter(range(1000))
    run = simulate(resolved, lambda data, now_ns: delay_ns if fates[next(numbers)] else None)

    steps, tested = run["plant_step"], run["sensor_measurement"]
    sent_ns = tested["t_ns"][tested["event"] >= 0]
    assert set(np.diff(sent_ns)) == {margin.longest_ns}
    delivered = np.flatnonzero(fates[: len(sent_ns)])
    assert len(delivered) > 15

    def state(number: int, before: int) -> Vector:
        step = steps[np.searchsorted(steps["t_ns"], sent_ns[number])]
        if not delay_ns:
            return np.concatenate([step["x"], step["u"]])
        older = steps[np.searchsorted(steps["t_ns"], sent_ns[before])]
        x_c = expm(loop.H * (sent_ns[number] - sent_ns[before]) * 1e-9) @ older["x"]
        return np.concatenate([step["x"], x_c, step["u"]])[: margin.loop.dimension]

    slots = margin.loop.times.slots
    for before, one, following in zip(delivered[1:], delivered[2:], delivered[3:], strict=False):
        map_ = margin.loop.map(int(one % slots), int(following - one - 1)).middle
        expected = state(following, one)
        np.testing.assert_allclose(
            map_ @ state(one, before), expected, rtol=0, atol=1e-11 * np.abs(expected).max()
        )


def held_loop(resolved: Scenario, pattern: Sequence[bool], intervals_s: Sequence[float] = ()) -> Matrix:
    """The map of (x, x_c, u) over a pattern, with the controller's ticks half a step later.

    It is computed step by step, without :mod:`noack.theory`. By default the updates are 0.1 s
    apart.
    """
    loop, h_ns = loop_of(resolved), resolved.timing.plant_period_ns
    n, m = loop.n, loop.m
    Ad, Bd = discretise(loop.A, loop.B, h_ns)
    half = expm(loop.H * h_ns / 2 * 1e-9)
    eye = np.eye(2 * n + m)
    x, x_c, u = eye[:n], eye[n : 2 * n], eye[2 * n :]
    for delivered, interval_s in zip(pattern, intervals_s or [0.1] * len(pattern), strict=True):
        x_c = x if delivered else x_c
        for _ in range(round(interval_s * 1e9 / h_ns)):
            x_c = half @ x_c
            x, u = Ad @ x + Bd @ u, loop.K @ x_c
            x_c = half @ x_c
    return np.vstack([x, x_c, u])


GUARANTEES = [
    LossGuarantee((LongestBurst(3),)),
    LossGuarantee((LossesInWindow(2, 5),)),
    LossGuarantee((LongestBurst(3), DeliveriesBetweenBursts(2))),
]


def admissible(guarantee: LossGuarantee, pattern: Sequence[bool]) -> bool:
    history = LossHistory(guarantee.rules)
    return not any(history.add(not delivered) for delivered in (*pattern,) * 12)


@pytest.mark.parametrize("guarantee", GUARANTEES, ids=lambda one: one.meaning)
def test_no_pattern_grows_faster_than_the_upper_bound(guarantee: LossGuarantee) -> None:
    resolved = scenario("unstable_pendulum", "mode=zoh", "plant.rate_hz=100", "controller.rate_hz=100")
    found = LossMargin(resolved).stability(guarantee)
    fastest = 0.0
    for length in range(1, 8):
        for pattern in product((True, False), repeat=length):
            if pattern[0] and admissible(guarantee, pattern):
                radius = np.abs(np.linalg.eigvals(held_loop(resolved, pattern))).max()
                fastest = max(fastest, float(radius) ** (1 / length))
    assert admissible(guarantee, found.pattern)
    if len(found.pattern) <= 7:
        assert fastest == pytest.approx(found.lower, rel=1e-9)
    assert fastest <= found.upper <= found.lower * (1 + 1e-3)
    worse = LossGuarantee(tuple(
        replace(rule, limit=rule.limit + 1) if isinstance(rule, LongestBurst | LossesInWindow)
        else rule for rule in guarantee.rules
    ))  # fmt: skip
    assert LossMargin(resolved).stability(worse).lower > found.upper


@pytest.mark.parametrize("losses", [1, 2])
def test_a_pattern_repeated_from_the_first_update_grows_as_claimed(losses: int) -> None:
    """A controller with 80 ms, updates every 0.5 or 0.3 s: in other slots it grows less."""
    resolved = scenario(
        "unstable_pendulum", "plant.rate_hz=100", "controller.rate_hz=12.5",
        f'trigger={{policy="periodic", period_s={0.5 if losses == 1 else 0.3}}}',
    )  # fmt: skip
    margin = LossMargin(resolved)
    guarantee = LossGuarantee((LongestBurst(1) if losses == 1 else LossesInWindow(2, 4),))
    found, slots = margin.stability(guarantee, 3e-2), margin.loop.times.slots

    def growth(slot: int) -> float:
        fates = np.roll(found.pattern * (3 * slots), slot)
        places = np.flatnonzero(fates)
        maps = [
            margin.maps(int(one % slots), int(following - one - 1)).middle
            for one, following in pairwise([*places, places[0] + len(fates)])
        ]
        radius = np.abs(np.linalg.eigvals(np.linalg.multi_dot(maps[::-1]))).max()
        return float(radius ** (1 / len(fates)))

    assert growth(0) == pytest.approx(found.lower, rel=1e-9)
    assert min(growth(slot) for slot in range(1, slots)) < 0.95 * found.lower


def test_the_margin_does_not_depend_on_the_unit_of_the_input() -> None:
    resolved = scenario("unstable_pendulum", "mode=zoh")
    loop, margin, guarantee = loop_of(resolved), LossMargin(resolved), GUARANTEES[0]
    expected = margin.stability(guarantee)
    for unit in (2.0**40, 1e-12):
        margin.loop = TimeTriggeredLoop(loop.A, loop.B * unit, loop.K / unit, loop.H, margin.loop.times)
        margin.maps = margin.loop.map  # type: ignore[assignment]
        found = margin.stability(guarantee)
        assert found.pattern == expected.pattern
        assert found.lower == pytest.approx(expected.lower, rel=1e-9)
        assert found.upper == pytest.approx(expected.upper, rel=1e-3)


@pytest.mark.parametrize("mode", ["model", "zoh"])
def test_no_events_of_any_times_grow_faster_than_the_upper_bound(mode: str) -> None:
    resolved = scenario(
        "unstable_pendulum", f"mode={mode}", "plant.rate_hz=50", "controller.rate_hz=50",
        f"trigger={DEADLINE}",
    )  # fmt: skip
    margin, guarantee = LossMargin(resolved), LossGuarantee((LongestBurst(2),))
    assert (margin.shortest_ns, margin.longest_ns) == (120_000_000, 300_000_000)
    found, rng = margin.stability(guarantee), np.random.default_rng(0)

    def growth(pattern: Sequence[bool], intervals_s: Sequence[float]) -> float:
        radius = np.abs(np.linalg.eigvals(held_loop(resolved, pattern, intervals_s))).max()
        return float(radius) ** (0.3 / sum(intervals_s))

    assert admissible(guarantee, found.pattern)
    assert all(0.1199 < one < 0.3001 for one in found.intervals_s)
    assert growth(found.pattern, found.intervals_s) == pytest.approx(found.lower, rel=1e-9)
    fastest = 0.0
    for _ in range(400):
        pattern = (True, *(rng.random(rng.integers(1, 8)) < 0.4))
        intervals_s = rng.choice([0.12, 0.2, 0.28, 0.3], len(pattern)).tolist()
        if admissible(guarantee, pattern):
            fastest = max(fastest, growth(pattern, intervals_s))
    assert 0.8 * found.lower < fastest <= found.upper <= found.lower * 1.05
    one_more = growth((True, False, False, False), [0.3] * 4)
    assert one_more > found.upper


def test_what_is_not_covered_is_refused_with_the_approved_line() -> None:
    def margin(settings: str) -> object:
        return LossMargin(scenario("double_integrator", *settings.split(" & "))).stability()

    compare_lines(
        Path(__file__).with_name("margin_refusals.txt"),
        lambda settings: lines_of_error(lambda: margin(settings)),
    )
