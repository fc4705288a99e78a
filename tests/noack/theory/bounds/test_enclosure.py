"""Enclosures against dense sampling, quadrature and decimal arithmetic, on every kind of system."""

import math
from collections.abc import Callable
from decimal import Decimal, localcontext
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm

from noack.core.linear_systems import Matrix, spectral_abscissa
from noack.theory.bounds.contraction import find_decay
from noack.theory.bounds.enclosure import KernelBounds, NotDecayingError, response

Rng = np.random.Generator


def in_skew_coordinates(rng: Rng, blocks: Matrix) -> Matrix:
    """The same system in skew coordinates."""
    S = rng.normal(size=blocks.shape) + 2 * np.eye(len(blocks))
    return np.asarray(S @ blocks @ np.linalg.inv(S))


def dense(rng: Rng, n: int) -> Matrix:
    G = rng.normal(size=(n, n)) * 3
    return np.asarray(G - (spectral_abscissa(G) + rng.uniform(0.3, 2)) * np.eye(n))


def stiff(rng: Rng, n: int) -> Matrix:
    rates = np.geomspace(1.0, 10.0 ** rng.uniform(2, 4), n)
    return in_skew_coordinates(rng, np.diag(-rates)) if n > 1 else np.array([[-1e4]])


def defective(rng: Rng, n: int) -> Matrix:
    """A single Jordan block."""
    return in_skew_coordinates(rng, np.diag(np.ones(n - 1), 1) - rng.uniform(0.3, 1.0) * np.eye(n))


def non_normal(rng: Rng, n: int) -> Matrix:
    """Grows by orders of magnitude before it decays."""
    upper = np.triu(rng.normal(size=(n, n)), 1) * 10.0 ** rng.uniform(1, 2)
    return np.asarray(upper - np.diag(rng.uniform(1, 3, n)))


def ringing(rng: Rng, n: int) -> Matrix:
    """Lightly damped oscillations."""
    skew = rng.normal(size=(n, n)) * 5
    return np.asarray(skew - skew.T - rng.uniform(0.05, 0.3) * np.eye(n))


KINDS: dict[str, Callable[[Rng, int], Matrix]] = {
    kind.__name__: kind for kind in (dense, stiff, defective, non_normal, ringing)
}


@st.composite
def cases(draw: st.DrawFn, kind: str) -> tuple[Matrix, Matrix, Matrix]:
    """C, G, D of ‖C e^{Gτ} D‖."""
    n, rng = draw(st.integers(1, 6)), np.random.default_rng(draw(st.integers(0, 2**32)))
    rows, columns = (draw(st.integers(1, n)) for _ in range(2))
    G = KINDS[kind](rng, n)
    assume(find_decay(G) is not None)
    whole = draw(st.booleans())
    C = np.eye(n) if whole else rng.normal(size=(rows, n))
    D = np.eye(n) if whole else rng.normal(size=(n, columns))
    return C, G, D


def values(C: Matrix, G: Matrix, D: Matrix, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """‖C e^{Gt} D‖, each time from a new matrix exponential."""
    return np.asarray(np.linalg.norm(C @ expm(G * t_s[:, None, None]) @ D, 2, axis=(1, 2)))


def times(G: Matrix, end_s: float) -> NDArray[np.float64]:
    """Times that are dense for the fast modes and for the slow ones."""
    fast = float(np.abs(np.linalg.eigvals(G)).max())
    return np.unique(np.concatenate([np.geomspace(1e-3 / fast, end_s, 250), np.linspace(0.0, end_s, 400)]))


def cell_of(kernel: KernelBounds, t_s: NDArray[np.float64]) -> NDArray[np.int64]:
    return np.searchsorted(kernel.edges_s, t_s, side="right") - 1


def peak(kernel: KernelBounds, C: Matrix, G: Matrix, D: Matrix) -> float:
    """The largest value in the interval where the enclosure has its own maximum."""
    cell = int(kernel.highest.argmax())
    return float(values(C, G, D, np.linspace(*kernel.edges_s[cell : cell + 2], 50)).max())


# The enclosure covers its own rounding; the remaining difference is the reference's.
ROUNDING = 1 - 1e-10


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=6)
@given(data=st.data())
def test_no_value_is_above_its_enclosure_and_the_enclosure_is_tight(kind: str, data: st.DataObject) -> None:
    """Cell by cell, beyond the grid, and from any time on; the supremum is within 1 %."""
    C, G, D = data.draw(cases(kind))
    kernel = response(G, D).through(C)
    grid_s = float(kernel.edges_s[-1])
    t_s = times(G, 1.2 * grid_s)
    norms = values(C, G, D, t_s)
    on_grid = t_s < grid_s
    highest = kernel.highest[cell_of(kernel, t_s[on_grid])]
    # Values as small as the reference's rounding are not compared.
    rounding = 1e-13 * norms.max()
    assert (highest + rounding >= norms[on_grid] * ROUNDING).all()
    assert (kernel.sups(t_s) + rounding >= norms * ROUNDING).all()
    assert (np.diff(kernel.sups(t_s)) <= 0).all()
    assert kernel.sup() == kernel.sups(np.zeros(1))[0] == kernel.highest.max()
    assert kernel.sup() <= 1.01 * peak(kernel, C, G, D)


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=2)
@given(n=st.integers(2, 5), seed=st.integers(0, 2**32))
def test_no_integral_is_above_its_enclosure_and_the_enclosure_is_tight(kind: str, n: int, seed: int) -> None:
    """Cell by cell, against Gauss's formula, which gives ‖C e^{Gτ} d‖ for a vector d to 1e-8."""
    points, weights = np.polynomial.legendre.leggauss(4)
    rng = np.random.default_rng(seed)
    G, C, d = KINDS[kind](rng, n), rng.normal(size=(n, n)), rng.normal(size=(n, 1))
    kernel = response(G, d).through(C)
    begins_s, steps_s = kernel.edges_s[:-1, None], np.diff(kernel.edges_s)[:, None]
    t_s = begins_s + steps_s * (1 + points) / 2
    areas = values(C, G, d, t_s.ravel()).reshape(t_s.shape) @ weights * steps_s[:, 0] / 2
    assert (kernel.area + 1e-13 * areas.sum() >= areas * (1 - 1e-7)).all()
    assert kernel.integral_on_grid() == pytest.approx(float(kernel.area.sum()))
    assert kernel.integral() <= 1.01 * float(areas.sum())


def test_an_oscillation_that_appears_when_the_rest_has_decayed_is_followed() -> None:
    """By then, the steps of the enclosure have become long."""
    G = np.array([[-1.0, 0.0, 0.0], [0.0, -0.05, 30.0], [0.0, -30.0, -0.05]])
    C, D = np.array([[0.0, 1.0, 0.0]]), np.array([[1.0], [1e-5], [0.0]])
    kernel = response(G, D).through(C)
    t_s = np.linspace(0.0, float(kernel.edges_s[-1]), 5000)[:-1]
    assert (kernel.highest[cell_of(kernel, t_s)] >= values(C, G, D, t_s) * ROUNDING).all()


def test_a_system_that_does_not_decay_is_refused() -> None:
    with pytest.raises(NotDecayingError, match=r"a mode of the loop grows at 2 /s"):
        response(np.diag([-1.0, 2.0]), np.eye(2))
    for G in (np.zeros((1, 1)), np.array([[0.0, 1.0], [-1.0, 0.0]]), np.diag([1e-9, -1e9])):
        with pytest.raises(NotDecayingError):
            response(G, np.eye(len(G)))


def test_a_system_that_decays_only_to_rounding_is_refused() -> None:
    """A Jordan block of ten; rounding moves its eigenvalues by more than their distance from 0."""
    Q = np.linalg.qr(np.random.default_rng(1).normal(size=(10, 10)))[0]
    for margin, why in ((1e-3, "grows at"), (0.1, "no Lyapunov function")):
        triangular = np.diag(np.ones(9), 1) - margin * np.eye(10)
        with pytest.raises(NotDecayingError, match=why):
            response(Q @ triangular @ Q.T, np.eye(10))


def decimals(matrix: Matrix) -> Any:
    return np.vectorize(Decimal, otypes=[object])(matrix)


def exactly(C: Matrix, G: Matrix, D: Matrix, t_s: float) -> float:
    """‖C e^{Gt} D‖ in 60 digits: Taylor's series at t/2^k, squared k times."""
    with localcontext() as context:
        context.prec = 60
        halvings = max(0, math.ceil(math.log2(max(np.linalg.norm(G) * t_s, 1e-9))) + 2)
        scaled = decimals(G) * (Decimal(t_s) / 2**halvings)
        total = term = decimals(np.eye(len(G)))
        for k in range(1, 35):
            term = term @ scaled / k
            total = total + term
        for _ in range(halvings):
            total = total @ total
        exact = decimals(C) @ total @ decimals(D)
    return float(np.linalg.norm(exact.astype(np.float64), 2))


@pytest.mark.parametrize(("kind", "condition"), [("dense", 1e4), ("stiff", 1e8), ("ringing", 1e11)])
def test_rounding_is_covered_where_weights_are_ill_conditioned(kind: str, condition: float) -> None:
    """‖W e^{Gτ} W⁻¹‖ for a W that amplifies errors of 1e-16 by its condition number."""
    rng, n = np.random.default_rng(11), 3
    U, V = (np.linalg.qr(rng.normal(size=(n, n)))[0] for _ in range(2))
    W = U @ np.diag(np.geomspace(1, condition**-1, n)) @ V
    G, D = KINDS[kind](rng, n), np.linalg.inv(W)
    kernel = response(G, D).through(W)
    for node in (0, 1, 64):
        t_s = float(kernel.edges_s[node])
        exact = exactly(W, G, D, t_s)
        assert kernel.highest[node] >= exact
        assert kernel.sups(np.array([t_s]))[0] >= exact
