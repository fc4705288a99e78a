"""Tries to break box certificates with plants anywhere in the box, at its corners, and switching.

The same check must detect broken copies of the bounds.
"""

from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from noack.core.linear_systems import Matrix
from noack.theory.bounds.box import BoxGains
from noack.theory.bounds.enclosure import NotDecayingError
from noack.theory.bounds.terms import Constants, NetworkConditions, NoCertificateError, TriggerBound
from noack.theory.certificates.solution import solve
from tests.oracles.lossy_loops import (
    RUNS,
    SEARCH,
    STEPS,
    Plants,
    System,
    Trace,
    certified_or_skipped,
    networks,
    seeds,
    simulate,
    systems,
)

POOL = 10


class Case(NamedTuple):
    """A loop in which plant and model are equal, and the distance of the true plant from them."""

    system: System
    halfwidth_A: Matrix
    halfwidth_B: Matrix

    def certify(
        self, conditions: NetworkConditions | None = None, box: type[BoxGains] = BoxGains
    ) -> Constants:
        own = self.system.gains()
        plant = box(own.error, own.A, own.B, own.start, own.alpha_per_s, *self[1:])
        return self.system.certify(conditions, plant)

    def constants(self, box: type[BoxGains] = BoxGains) -> Constants | None:
        try:
            return self.certify(box=box)
        except (NoCertificateError, NotDecayingError):
            return None

    def simulate(self, seed: int) -> Trace:
        """Runs with constant plants, fast switching and rare switching between plants."""
        rng = np.random.default_rng(seed)
        rate = rng.uniform(size=(RUNS, 1)) ** 3
        rate[: RUNS // 3] = 0.0
        changes = rng.uniform(size=(RUNS, STEPS)) < rate
        last = np.maximum.accumulate(np.where(changes, np.arange(STEPS), 0), axis=1)
        which = np.take_along_axis(rng.integers(0, POOL, (RUNS, STEPS)), last, axis=1)
        pool = []
        for number in range(POOL):
            shares = [rng.uniform(-1, 1, half.shape) for half in self[1:]]
            if number < POOL - 2:  # a corner
                shares = [np.sign(share) for share in shares]
            (A, B), system = shares, self.system
            pool.append((system.A + A * self.halfwidth_A, system.B + B * self.halfwidth_B))
        return simulate(self.system, *networks(seed, self.system), plants=Plants(pool, which))


@st.composite
def cases(draw: st.DrawFn, size: float | None = None, **fixed: Any) -> Case:
    system = draw(systems(mismatch=0.0, **fixed))
    rng = np.random.default_rng(draw(seeds))
    n, m = system.B.shape
    size = draw(st.sampled_from([0.01, 0.05, 0.2])) if size is None else size
    uncertain = rng.uniform(size=(n, n + m)) < draw(st.sampled_from([0.3, 1.0]))
    halfwidths = size * rng.uniform(0, 1, (n, n + m)) * uncertain
    return Case(system, halfwidths[:, :n], halfwidths[:, n:])


@settings(SEARCH, max_examples=8)
@given(cases(), seeds)
def test_no_plant_in_the_box_exceeds_a_bound(case: Case, seed: int) -> None:
    certified = case.constants()
    assume(certified is not None)
    assert certified is not None
    assert case.simulate(seed).exceeded(case.system, certified) == []


@settings(SEARCH, max_examples=3)
@given(systems(mismatch=0.0, hold_steps=0, delay_steps=0, step_share=0.01))
def test_an_empty_box_has_the_bounds_of_the_model(system: System) -> None:
    """Without the windows of the guarantee, which a box does not use."""
    certified_or_skipped(system)
    plant, level = system.gains(), TriggerBound(system.beta, system.beta)
    try:
        own = solve(plant.error, plant, system.conditions, level, structured=False)
    except NoCertificateError:
        assume(False)
    box = Case(system, np.zeros_like(system.A), np.zeros_like(system.B)).certify()
    assert tuple(box) == pytest.approx(tuple(own), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("alpha", [0.1, 1.0])
@pytest.mark.parametrize("share_of_A", [0.0, 0.3, 1.0])
def test_a_scalar_box_is_as_large_as_it_can_be(alpha: float, share_of_A: float) -> None:
    """ẋ = (a + bk)x + bp with rate λ: certified while the worst corner, λ − |ã| − |b̃k|, exceeds α.

    There, x is bounded by x₀ and |b|π over the worst rate's margin, exactly.
    """
    rate, k, beta, x0 = 2.0, -3.0, 0.1, 0.7
    whole = rate - alpha
    system = System(
        A=np.array([[1.0]]), B=np.array([[1.0]]), K=np.array([[k]]), H=np.array([[-rate]]),
        weight=np.eye(1), x0=np.array([x0]), alpha=alpha, beta=beta, known_start=True, mansd=2,
        step_s=0.01, sample_steps=1, delay_steps=0, hold_steps=0, lag_steps=0,
    )  # fmt: skip

    def case(size: float) -> Case:
        half_A, half_B = size * whole * share_of_A, size * whole * (1 - share_of_A) / -k
        return Case(system, np.array([[half_A]]), np.array([[half_B]]))

    with pytest.raises(NotDecayingError, match="box is too large"):
        case(1.005).certify(NetworkConditions(2))
    for size in (0.1, 0.5, 0.95):
        found = case(size)
        certified = found.certify(NetworkConditions(2))
        margin = whole * (1 - size)
        forced = (1.0 + found.halfwidth_B.item()) * certified.input_error
        start = x0 * whole / margin  # bound for a state that does not decay
        # The enclosures' 0.5 %, and the separate bounds of start and input error.
        assert certified.state == pytest.approx(start + forced / margin, rel=0.15)
        assert certified.state >= (start + forced / margin) * (1 - 1e-9)
        # w of the state and of the corresponding input.
        state, p = certified.state, certified.input_error
        w = found.halfwidth_A.item() * state + found.halfwidth_B.item() * (-k * state + p)
        assert certified.mismatch == pytest.approx(w, rel=1e-3)
