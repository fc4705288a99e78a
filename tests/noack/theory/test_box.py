"""Tries to break box certificates with plants anywhere in the box, at its corners, and switching.

The same check must detect broken copies of the bounds.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, assume, find, given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from noack.core.linear_systems import Matrix, Vector, spectral_abscissa
from noack.theory.box import BoxGains
from noack.theory.certificate import Constants, Level, NetworkConditions, VoidError, solve
from noack.theory.enclosure import NotDecayingError
from noack.theory.gains import Coefficients, ErrorGains, Output, PlantGains
from tests.noack.theory.loops import RUNS, STEPS, Plants, System, networks, simulate, systems

ROUNDING = 1 + 1e-9
BOXES = 25
POOL = 10

SEARCH = settings(deadline=None, suppress_health_check=list(HealthCheck), phases=[Phase.generate])

seeds = st.integers(0, 2**32)


class Case(NamedTuple):
    """A loop in which plant and model are equal, and the distance of the true plant from them."""

    system: System
    halfwidth_A: Matrix
    halfwidth_B: Matrix

    def gains(self, box: type[BoxGains] = BoxGains) -> BoxGains:
        system = self.system
        error = ErrorGains(system.H, system.K, system.weight, system.alpha)
        return box(
            error, system.A, system.B, self.halfwidth_A, self.halfwidth_B,
            system.x0[:, None], system.alpha,
        )  # fmt: skip

    def certify(
        self, conditions: NetworkConditions | None = None, box: type[BoxGains] = BoxGains
    ) -> Constants:
        level = Level(self.system.beta, self.system.beta)
        plant = self.gains(box)
        return solve(plant.error, plant, conditions or self.system.conditions, level)

    def plants(self, rng: np.random.Generator) -> list[tuple[Matrix, Matrix]]:
        """Plants at corners and inside the box."""
        found = []
        for kind in range(POOL):
            shares = [rng.uniform(-1, 1, half.shape) for half in self[1:]]
            if kind < POOL - 2:
                shares = [np.sign(share) for share in shares]
            found.append(
                (
                    self.system.A + shares[0] * self.halfwidth_A,
                    self.system.B + shares[1] * self.halfwidth_B,
                )
            )
        return found


@st.composite
def cases(draw: st.DrawFn, size: float | None = None, **fixed: Any) -> Case:
    system = draw(systems(mismatch=0.0, **fixed))
    rng = np.random.default_rng(draw(seeds))
    n, m = system.B.shape
    size = draw(st.sampled_from([0.01, 0.05, 0.2])) if size is None else size
    uncertain = rng.uniform(size=(n, n + m)) < draw(st.sampled_from([0.3, 1.0]))
    halfwidths = size * rng.uniform(0, 1, (n, n + m)) * uncertain
    return Case(system, halfwidths[:, :n], halfwidths[:, n:])


def exceeded(case: Case, certified: Constants, seed: int) -> list[str]:
    """The bounds that some run exceeds, for constant plants, fast switching and rare switching."""
    rng = np.random.default_rng(seed)
    often = rng.uniform(size=(RUNS, 1)) ** 3
    often[: RUNS // 3] = 0.0
    changes = rng.uniform(size=(RUNS, STEPS)) < often
    last = np.maximum.accumulate(np.where(changes, np.arange(STEPS), 0), axis=1)
    which = np.take_along_axis(rng.integers(0, POOL, (RUNS, STEPS)), last, axis=1)
    plants = Plants(case.plants(rng), which)
    trace = simulate(case.system, *networks(rng, case.system), plants=plants)
    shares = trace.worst(case.system).shares(certified, case.system.beta)
    return [name for name, share in shares.items() if share > ROUNDING]


@settings(SEARCH, max_examples=BOXES)
@given(cases(), seeds)
def test_no_plant_in_the_box_exceeds_a_bound(case: Case, seed: int) -> None:
    try:
        certified = case.certify()
    except (VoidError, NotDecayingError):
        assume(False)
        raise
    assert exceeded(case, certified, seed) == []


class NoMistakes(BoxGains):
    """Ignores that the plant's deviation separates the plant from the models."""

    @property
    def states(self) -> dict[Output, Coefficients]:  # type: ignore[override]
        return {**super().states, Output.MISMATCH: Coefficients(0.0, 0.0)}


class MistakesOfTheStartOnly(BoxGains):
    """Ignores the feedback of the deviation: w that results from w."""

    def _mistakes_of(self, coordinates: Vector) -> Vector:
        return np.asarray(self._halfwidths @ coordinates)


class OnlyTheStateIsUncertain(BoxGains):
    """Ignores B̃."""

    @property
    def _halfwidths(self) -> Matrix:  # type: ignore[override]
        halfwidths = np.array(super()._halfwidths)
        halfwidths[:, len(self.A_model) :] = 0.0
        return halfwidths


class HalfTheBox(BoxGains):
    @property
    def _halfwidths(self) -> Matrix:  # type: ignore[override]
        return np.array(0.5 * super()._halfwidths)


class TheModelIsThePlant(BoxGains):
    """Ignores the effect of the deviation on the state."""

    @property
    def states(self) -> dict[Output, Coefficients]:  # type: ignore[override]
        own = PlantGains(self.error, self.A_model, self.B_model, self.start, self.alpha_per_s)
        return {**own.states, Output.MISMATCH: super().states[Output.MISMATCH]}


class FeltFromTheStart(BoxGains):
    """Ignores that there is no input at first."""

    def start_up(self, start_s: float) -> tuple[float, Mapping[Output, float]]:
        return super().start_up(0.0)


INSTANT = {"sample_steps": 1, "delay_steps": 0, "hold_steps": 0, "step_share": 0.01}

MUTANTS: dict[str, tuple[type[BoxGains], dict[str, Any]]] = {
    "no mistakes in e_s": (NoMistakes, {"size": 0.2, "mansd": 0, "beta": 0.01, **INSTANT}),
    "no feedback of the mistakes": (
        MistakesOfTheStartOnly, {"size": 1.0, "n": 1, "m": 1, "mansd": 0, "beta": 1.0, **INSTANT},
    ),
    "no uncertainty of B": (
        OnlyTheStateIsUncertain, {"size": 0.6, "n": 1, "m": 2, "beta": 0.01, "mansd": 0, **INSTANT},
    ),
    "no start": (
        FeltFromTheStart,
        {"mansd": 0, "hold_steps": 4, "lag_steps": 2, "beta": 0.01, "step_share": 0.03},
    ),
    "half the box": (HalfTheBox, {"size": 0.6, "n": 1, "beta": 0.01, "mansd": 0, **INSTANT}),
    "no mistakes in x": (
        TheModelIsThePlant,
        {"size": 0.2, "n": 3, "spread": 3.0, "beta": 0.01, "alpha_share": 0.8, **INSTANT},
    ),
}  # fmt: skip


@pytest.mark.parametrize("mutant", MUTANTS)
def test_a_broken_copy_is_caught(mutant: str) -> None:
    broken, where = MUTANTS[mutant]

    def caught(drawn: tuple[Case, int]) -> bool:
        case, seed = drawn
        try:
            return bool(exceeded(case, case.certify(box=broken), seed))
        except (VoidError, NotDecayingError):
            return False

    find(
        st.tuples(cases(**where), seeds),
        caught,
        settings=settings(SEARCH, max_examples=300, database=None),
    )


@settings(SEARCH, max_examples=12)
@given(cases(), st.floats(0.01, 0.5), seeds)
def test_before_the_start_every_plant_falls_freely(case: Case, share: float, seed: int) -> None:
    """p = −Kx before the first input, for every plant in the box, constant or switching."""
    system, rng = case.system, np.random.default_rng(seed)
    start_s = share / float(np.linalg.norm(system.A, 2))
    try:
        bound, _ = case.gains().start_up(start_s)
    except NotDecayingError:  # the box is too large
        assume(False)
    plants = [A for A, _ in case.plants(rng)]
    for _ in range(5):
        x, t_s = system.x0, 0.0
        while t_s < start_s:
            assert np.exp(system.alpha * t_s) * np.linalg.norm(system.K @ x) <= bound * ROUNDING
            x = expm(plants[rng.integers(len(plants))] * start_s / 20) @ x
            t_s += start_s / 20


@settings(SEARCH, max_examples=15)
@given(cases(), st.sampled_from([0.3, 1.0, 3.0]), seeds)
def test_a_box_with_a_plant_that_does_not_decay_is_refused(
    case: Case, size: float, seed: int
) -> None:
    """Wherever there is a certificate, A + BK of every corner decays faster than the threshold."""
    wide = case._replace(halfwidth_A=size * case.halfwidth_A / 0.05,
                         halfwidth_B=size * case.halfwidth_B / 0.05)  # fmt: skip
    try:
        wide.certify(NetworkConditions(case.system.mansd))
    except (VoidError, NotDecayingError):
        return
    for A, B in wide.plants(np.random.default_rng(seed)):
        assert spectral_abscissa(A + B @ case.system.K) < -case.system.alpha


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
        pushed = (1.0 + found.halfwidth_B.item()) * certified.input_error
        start = x0 * whole / margin  # bound for a state that does not decay
        # The enclosures' 0.5 %, and the separate bounds of start and push.
        assert certified.state == pytest.approx(start + pushed / margin, rel=0.15)
        assert certified.state >= (start + pushed / margin) * (1 - 1e-9)
        # w of the state and of the corresponding input.
        state, push = certified.state, certified.input_error
        mistake = found.halfwidth_A.item() * state + found.halfwidth_B.item() * (-k * state + push)
        assert certified.mismatch == pytest.approx(mistake, rel=1e-3)


@settings(SEARCH, max_examples=10)
@given(systems(mismatch=0.0, hold_steps=0, delay_steps=0, step_share=0.01))
def test_a_box_of_nothing_is_the_model(system: System) -> None:
    n, m = system.B.shape
    box = Case(system, np.zeros((n, n)), np.zeros((n, m)))
    for conditions in (NetworkConditions(system.mansd), system.conditions):
        try:
            own = system.certify(conditions)
        except VoidError:
            continue
        found = box.certify(conditions)
        for mine, theirs in zip(found, own, strict=True):
            assert mine == pytest.approx(theirs, rel=1e-9, abs=1e-9)


@settings(SEARCH, max_examples=10)
@given(cases(0.05), st.floats(0.1, 0.9))
def test_a_larger_box_never_has_smaller_bounds(case: Case, share: float) -> None:
    smaller = case._replace(
        halfwidth_A=share * case.halfwidth_A, halfwidth_B=share * case.halfwidth_B
    )
    try:
        larger = case.certify()
    except (VoidError, NotDecayingError):
        assume(False)
        raise
    found = smaller.certify()
    for name in ("delta", "overshoot", "input_error", "state", "mismatch"):
        assert getattr(found, name) <= getattr(larger, name) * (1 + 5e-3)
    # Where the inter-event time exceeds all other durations of the loop, δ is as coarse as its
    # grid.
    longest_s = 5 / case.system.alpha
    least_s = min(larger.inter_event_s or 0.0, longest_s)
    assert (found.inter_event_s or 0.0) >= least_s * (1 - 0.02)
