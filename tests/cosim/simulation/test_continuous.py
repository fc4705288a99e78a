"""Exact event times against closed forms, and the output of `noack simulate --trigger continuous`."""

import itertools
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from cosim.simulation.continuous import (
    ContinuousLoop,
    ContinuousRun,
    TooManyEventsError,
    network_fates,
    simulate_continuous,
)
from cosim.simulation.virtual_time import simulate
from netem.core.errors import CallerError
from netem.core.packet_rows import NETEM_PACKET, Fate
from noack.core.linear_systems import Matrix, Vector
from noack.scenario.resolution import LoopMatrices, resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from noack.trigger_policies.trigger_rule import TriggerRule
from tests.helpers.example_rules import decaying_rule


def loop_with(
    A: Matrix, B: Matrix, K: Matrix, H: Matrix, x0: Vector, weight: Matrix | None = None
) -> LoopMatrices:
    """A loop of given matrices; the simulator uses only H, not its factors."""
    names = tuple(f"x_{i}" for i in range(len(A)))
    return LoopMatrices(A, B, K, H, A, B, x0, weight, names, names[: B.shape[1]])


class Case(NamedTuple):
    loop: LoopMatrices
    trigger: TriggerRule
    lost: list[bool]
    known: bool
    horizon_s: float

    def delivered(self, event: int) -> bool:
        return (event == 0 and not self.known) or not self.lost[event % len(self.lost)]

    def run(self) -> ContinuousRun:
        return simulate_continuous(
            ContinuousLoop(self.loop, self.trigger),
            horizon_s=self.horizon_s,
            delivered=self.delivered,
            known_start=self.known,
        )


@st.composite
def cases(draw: st.DrawFn) -> Case:
    n = draw(st.integers(1, 8))
    m = draw(st.integers(1, 3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    A, B, K = (rng.uniform(-1, 1, shape) * 2 / math.sqrt(n) for shape in ((n, n), (n, m), (m, n)))
    H = A + B @ K + draw(st.sampled_from([0.05, 0.5])) * rng.uniform(-1, 1, (n, n))
    if draw(st.booleans()):
        H = np.zeros((n, n))
    W = np.eye(n) + 0.5 * rng.uniform(-1, 1, (n, n)) if draw(st.booleans()) else None
    floor = draw(st.sampled_from([0.0, 0.1]))
    return Case(
        loop_with(A, B, K, H, rng.uniform(-1, 1, n), W),
        decaying_rule(0.3, draw(st.sampled_from([0.1, 1.0])), floor, W, n),
        draw(st.lists(st.booleans(), min_size=1, max_size=6)),
        draw(st.booleans()),
        horizon_s=2.0,
    )


@given(cases())
@settings(max_examples=15)
def test_the_threshold_is_reached_at_events_only_and_i1_holds_between_them(case: Case) -> None:
    """The threshold is never exceeded, and reached at each event; (I1) gives x_c − x_s."""
    run, H = case.run(), case.loop.H
    t_s = np.linspace(0, run.reached_s, 101)
    samples = run.at(t_s)
    levels = np.array([run.system.trigger.threshold(1e9 * t) for t in t_s])
    assert (run.e_s_norm(samples) <= levels * (1 + 1e-12)).all()
    for state in run.before[0 if case.known else 1 :]:
        norm = run.system.norms(state.e_s[None])[0]
        assert norm == pytest.approx(run.system.trigger.threshold(1e9 * state.t_s), rel=1e-12)
    received = -1
    for i, t in enumerate(t_s):
        happened = int(np.searchsorted(run.event_s, t, side="right"))
        received = max([received, *np.flatnonzero(run.delivered[:happened])])
        missed_errors = [
            expm(H * (t - event.t_s)) @ event.e_s for event in run.before[received + 1 : happened]
        ]
        if received < 0 and not case.known:
            continue
        expected = np.sum([np.zeros(case.loop.n), *missed_errors], axis=0)
        scale = max(np.abs(samples.x[: i + 1]).max(), 1.0)
        difference = samples.x_c[i] - samples.x_s[i]
        np.testing.assert_allclose(difference, expected, rtol=0, atol=1e-12 * scale)


@pytest.mark.parametrize("floored", [False, True])
@pytest.mark.parametrize("lost", [(False,), (False, True, True), (True, False)])
def test_a_scalar_loop_has_closed_form_events(floored: bool, lost: tuple[bool, ...]) -> None:
    """ẋ = a x + b K x_c with x_s and x_c held: e_s = −(v/a)(e^{aτ} − 1), v = ẋ(t_i), τ = t − t_i.

    With a constant threshold ε: e^{aτ} = 1 + aε/|v|. With βe^{−αt} and α = a, w = e^{aτ} solves
    w² − w = aβe^{−αt_i}/|v|.
    """
    a, b, k, beta = 0.7, 1.0, -2.0, 0.3
    trigger = decaying_rule(1e-9 if floored else beta, a, beta if floored else 0.0, n=1)
    loop = loop_with(np.array([[a]]), np.array([[b]]), np.array([[k]]), np.zeros((1, 1)), np.array([2.0]))
    case = Case(loop, trigger, list(lost), True, horizon_s=4.0)
    x, x_c, t_s, expected = 2.0, 2.0, 0.0, []
    for event in itertools.count():
        v = a * x + b * k * x_c
        if floored:
            grown = 1 + a * beta / abs(v)
        else:
            grown = (1 + math.sqrt(1 + 4 * a * beta * math.exp(-a * t_s) / abs(v))) / 2
        t_s += math.log(grown) / a
        if t_s > case.horizon_s:
            break
        x += v / a * (grown - 1)
        if case.delivered(event):
            x_c = x
        expected.append((t_s, x))
    run = case.run()
    assert len(expected) > 5
    np.testing.assert_allclose(run.event_s, [t for t, _ in expected], rtol=1e-12)
    np.testing.assert_allclose([s.x[0] for s in run.before], [x for _, x in expected], rtol=1e-11)


def turning(depth: float, omega: float, floored: bool) -> Case:
    """‖e_s‖ over the threshold is sin(ωt/2)/(1 − depth): it exceeds 1 briefly around t = π/ω.

    x rotates, x_s does not, and both decay like the threshold unless there is a floor.
    """
    alpha = 0.0 if floored else 0.8
    turn = np.array([[0.0, omega], [-omega, 0.0]])
    A, B, K = turn - alpha * np.eye(2), np.ones((2, 1)), np.zeros((1, 2))
    peak = 2.0 * math.hypot(0.3, 0.4)
    level = peak * (1 - depth)
    trigger = decaying_rule(level * 1e-3, 0.8, level) if floored else decaying_rule(level, 0.8)
    loop = loop_with(A, B, K, -alpha * np.eye(2), np.array([0.3, 0.4]))
    return Case(loop, trigger, [False], True, horizon_s=1.5 * math.pi / omega)


@pytest.mark.parametrize("floored", [False, True])
@pytest.mark.parametrize("omega", [0.3, 200.0])
@pytest.mark.parametrize("depth", [1e-2, 1e-12])
def test_very_short_crossings_are_found(depth: float, omega: float, floored: bool) -> None:
    case = turning(depth, omega, floored)
    run = case.run()
    first_s = 2 / omega * math.asin(1 - depth)
    excursion_s = 2 * (math.pi / omega - first_s)
    assert excursion_s < 3 * math.sqrt(2 * depth) * 2 / omega
    # The time is as accurate as rounding of 1e-15 over the slope √(2 depth) permits.
    tolerance_s = 5e-15 / math.sqrt(depth) / omega + 1e-12 * first_s
    assert run.event_s[0] == pytest.approx(first_s, abs=tolerance_s)
    assert turning(-depth, omega, floored).run().event_s.size == 0


def test_samples_at_the_time_of_an_event_are_those_after_it() -> None:
    case = turning(0.3, 7.0, False)
    run = case.run()
    assert len(run.before) >= 1
    samples = run.at(run.event_s)
    assert not samples.e_s.any()
    np.testing.assert_allclose(samples.x, [state.x for state in run.after], rtol=1e-14)
    just_before = run.at(np.nextafter(run.event_s, 0))
    np.testing.assert_allclose(just_before.e_s, [state.e_s for state in run.before], atol=1e-12)
    assert run.at([]).x.shape == (0, 2)
    for outside_s in (-1e-9, run.reached_s + 1e-9):
        with pytest.raises(ValueError, match="lie in"):
            run.at([outside_s])
    with pytest.raises(ValueError, match="order"):
        run.at([1e-3, 0.0])


def test_a_loop_that_cannot_be_simulated_to_the_end_is_reported() -> None:
    """ẋ = 100 x, equal to the model: no event; e^{100t} = 1e100 · 0.5 e^{−0.25t} at the end."""
    unit = np.ones((1, 1))
    loop = loop_with(100 * unit, unit, 0 * unit, 100 * unit, np.ones(1))
    run = Case(loop, decaying_rule(0.5, 0.25, n=1), [False], True, 50.0).run()
    assert run.diverged_at_s == pytest.approx(math.log(0.5e100) / 100.25, rel=1e-12)
    assert run.event_s.size == 0
    assert np.isfinite(run.at([0.0, run.reached_s]).x).all()
    growing = loop_with(unit, unit, 0 * unit, 0 * unit, np.ones(1))
    with pytest.raises(TooManyEventsError, match="accumulate"):
        simulate_continuous(
            ContinuousLoop(growing, decaying_rule(0.5, 1.0, n=1)), horizon_s=1e6, delivered=[],
            known_start=True, max_events=50,
        )  # fmt: skip
    decaying = loop_with(-unit, unit, 0 * unit, -unit, np.ones(1))
    with pytest.raises(CallerError, match="floor"):  # the threshold vanishes
        Case(decaying, decaying_rule(0.5, 1.0, n=1), [False], True, 1e4).run()
    floored = Case(decaying, decaying_rule(0.5, 1.0, 1e-9, n=1), [False], True, 1e4)
    assert floored.run().event_s.size == 0


# --- the output of noack simulate --trigger continuous --------------------------------------------


SCENARIOS = Path(__file__).parents[3] / "scenarios"


@pytest.fixture(scope="module")
def resolved() -> Scenario:
    return resolve(load(SCENARIOS / "lane_following.toml", ["plant.rate_hz=50", "horizon_s=10"]))


def test_the_fates_are_those_of_the_simulated_network(resolved: Scenario) -> None:
    packets = simulate(resolved)[NETEM_PACKET]
    fates = network_fates(resolved)
    later_first = [fates(i) for i in reversed(range(len(packets)))][::-1]
    assert later_first == (packets["fate"] != Fate.DROPPED).tolist()
    assert fates(0)
