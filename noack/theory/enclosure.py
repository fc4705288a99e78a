"""Rigorous upper bounds of ‖C e^{Gτ} D‖ over time: suprema and integrals that sampling cannot miss.

A response e^{Gτ}D is computed at the nodes of a grid. Between two nodes, a step s apart,
F(τ) = C e^{Gτ} D differs from the chord by at most s²/8 · sup‖F''‖ (its integral by s³/12 ·
sup‖F''‖), and a norm is convex along a chord. sup‖F''‖ over the cell is bounded by Taylor's formula
from the node, F'' = C G² e^{Gτ} D and its derivatives, the remainder by e^{μ s} with μ the
logarithmic norm of G. Beyond the grid a Lyapunov function bounds the rest: GᵀP + PG ⪯ −2νP gives
‖C e^{G(T+s)} D‖ ≤ ‖C P^{−1/2}‖ ‖P^{1/2} e^{GT} D‖ e^{−νs}. Rounding, some 1e-12 of a value, is
covered by a relative inflation of 1e-9.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.linear import Matrix, spectral_abscissa

Stack = NDArray[np.float64]

_ROUNDING = 1.0 + 1e-9
_TAYLOR_TERMS = 4
_BLOCK = 64
_STEPS_PER_RATE = (0.05, 0.1, 0.2)
_CELLS_PER_STEP = 256
_MOST_CELLS = 60_000
_TAIL_SHARE = 1e-5


class NotDecayingError(ArithmeticError):
    """The generator is not Hurwitz: over all times, the bounds would be infinite."""


class Kernel(NamedTuple):
    """Upper bounds of k(τ) = ‖C e^{Gτ} D‖ (spectral norm) on a grid of cells, and beyond it."""

    edges_s: NDArray[np.float64]
    """(cells + 1,) nodes of the grid, from 0."""
    highest: NDArray[np.float64]
    """(cells,) bound of k over each cell."""
    area: NDArray[np.float64]
    """(cells,) bound of ∫k over each cell."""
    tail_highest: float
    """Bound of k beyond the grid; infinite if it was not asked for."""
    tail_area: float
    """Bound of ∫k beyond the grid."""
    tail_rate_per_s: float
    """Beyond the grid, the bound of k falls at this rate."""

    def sup(self, after_s: float = 0.0) -> float:
        """Sup of k(τ) over τ ≥ ``after_s``."""
        return float(self.sups(np.array([after_s]))[0])

    def sups(self, after_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sup of k(τ) over τ ≥ a for each a, (j,)."""
        from_cell = np.maximum.accumulate(np.append(self.highest, self.tail_highest)[::-1])[::-1]
        first = np.searchsorted(self.edges_s, after_s, side="right") - 1
        beyond_s = np.maximum(after_s - self.edges_s[-1], 0.0)
        return np.asarray(from_cell[first] * np.exp(-self.tail_rate_per_s * beyond_s))

    def integral(self) -> float:
        """∫k over all times."""
        return float(self.area.sum()) + self.tail_area

    def sup_on_grid(self) -> float:
        """Sup of k over the grid only."""
        return float(self.highest.max(initial=0.0))

    def integral_on_grid(self) -> float:
        """∫k over the grid only."""
        return float(self.area.sum())


@dataclass(frozen=True)
class Response:
    """e^{Gτ} D at the nodes of a grid; :meth:`through` looks at it through an output matrix C."""

    generator: Matrix
    """G, (n, n), per second."""
    edges_s: NDArray[np.float64]
    """(cells + 1,)"""
    states: Stack
    """(cells + 1, n, r), e^{Gτ} D."""
    tail: "_Tail | None"

    def through(self, C: Matrix) -> Kernel:
        """Bounds of ‖C e^{Gτ} D‖, with C of shape (q, n)."""
        steps_s = np.diff(self.edges_s)
        norms = _spectral_norms(C @ self.states)
        bend = self._second_derivative(C, steps_s)
        ends = np.maximum(norms[:-1], norms[1:])
        middle = 0.5 * (norms[:-1] + norms[1:])
        beyond = math.inf if self.tail is None else self.tail.through(C) * _ROUNDING
        return Kernel(
            self.edges_s,
            (ends + steps_s**2 / 8 * bend) * _ROUNDING,
            (steps_s * middle + steps_s**3 / 12 * bend) * _ROUNDING,
            beyond,
            beyond if self.tail is None else beyond / self.tail.rate_per_s,
            0.0 if self.tail is None else self.tail.rate_per_s,
        )

    def _second_derivative(self, C: Matrix, steps_s: Stack) -> Stack:
        """Bound of ‖C G² e^{Gτ} D‖ over each cell, by Taylor's formula from its left node."""
        bound = np.zeros(len(steps_s))
        row = C @ self.generator @ self.generator
        nodes = self.states[:-1]
        for order in range(_TAYLOR_TERMS):
            bound += steps_s**order / math.factorial(order) * _frobenius_norms(row @ nodes)
            row = row @ self.generator
        growth = np.exp(max(_logarithmic_norm(self.generator), 0.0) * steps_s)
        rest = np.linalg.norm(row, 2) * growth * _frobenius_norms(nodes)
        return np.asarray(bound + steps_s**_TAYLOR_TERMS / math.factorial(_TAYLOR_TERMS) * rest)


class _Tail(NamedTuple):
    factor_inverse: Matrix
    """P^{−1/2}."""
    height: float
    """‖P^{1/2} e^{GT} D‖."""
    rate_per_s: float
    """ν."""

    def through(self, C: Matrix) -> float:
        return float(np.linalg.norm(C @ self.factor_inverse, 2)) * self.height


def response(generator: Matrix, D: Matrix) -> Response:
    """Follow e^{Gτ} D over all times, shapes (n, n) and (n, r).

    Raises:
        NotDecayingError: G is not Hurwitz.
    """
    margin = -spectral_abscissa(generator)
    if margin <= 0:
        raise NotDecayingError(f"the slowest mode grows at {-margin:.3g} /s")
    rate = 0.5 * margin
    factor = _lyapunov_factor(generator, rate)
    inverse = np.asarray(np.linalg.inv(factor))
    condition = float(np.linalg.norm(factor, 2) * np.linalg.norm(inverse, 2))
    parts: list[Stack] = []
    edges: list[Stack] = [np.zeros(1)]
    area, t_s = 0.0, 0.0
    state, cells, level = D, 0, 0
    while True:
        step_s = _STEPS_PER_RATE[min(level, 2)] / _fastest(generator)
        states = _propagate(generator, state, step_s, _CELLS_PER_STEP)
        parts.append(states[:-1])
        edges.append(np.asarray(t_s + step_s * np.arange(1.0, _CELLS_PER_STEP + 1)))
        t_s, state = float(edges[-1][-1]), states[-1]
        area += step_s * float(_frobenius_norms(states[:-1]).sum())
        cells, level = cells + _CELLS_PER_STEP, level + 1
        rest = float(np.linalg.norm(state)) * condition / rate
        if rest <= _TAIL_SHARE * area or cells >= _MOST_CELLS:
            break
    tail = _Tail(inverse, float(np.linalg.norm(factor @ state, 2)), rate)
    return Response(generator, np.concatenate(edges), np.concatenate([*parts, state[None]]), tail)


def response_until(generator: Matrix, D: Matrix, until_s: float, cells: int = 64) -> Response:
    """Follow e^{Gτ} D over 0 ≤ τ ≤ ``until_s`` on a grid of ``cells`` equal cells."""
    return Response(
        generator,
        np.linspace(0.0, until_s, cells + 1),
        _propagate(generator, D, until_s / cells, cells),
        None,
    )


def constant_kernel(value: float) -> Kernel:
    """The kernel of a response that neither decays nor grows."""
    edges_s = np.array([0.0, 1.0])
    return Kernel(edges_s, np.full(1, value), np.full(1, value), value, math.inf, 0.0)


def factors(matrix: Matrix) -> tuple[Matrix, Matrix]:
    """Write a matrix as L R with orthonormal columns in L and as many of them as its rank.

    ‖L R v‖ = ‖R v‖, so that a signal that acts through few directions is measured in these only.
    """
    U, singular, Vt = np.linalg.svd(matrix, full_matrices=False)
    cut = singular.max(initial=0.0) * max(matrix.shape) * np.finfo(float).eps
    # What is cut off is as small as the matrix's own rounding; a zero matrix keeps a column.
    rank = max(int((singular > cut).sum()), 1)
    return U[:, :rank], singular[:rank, None] * Vt[:rank]


def _propagate(generator: Matrix, state: Matrix, step_s: float, cells: int) -> Stack:
    """e^{G k s} state for k = 0 … cells, (cells + 1, n, r); each block starts anew."""
    from scipy.linalg import expm

    powers = np.eye(len(generator))[None]
    size = min(_BLOCK, cells)
    while len(powers) < size:
        powers = np.concatenate([powers, expm(generator * (step_s * len(powers))) @ powers])
    powers = powers[:size]
    leap = expm(generator * (step_s * size))
    blocks = []
    for _ in range(-(-(cells + 1) // size)):
        blocks.append(powers @ state)
        state = leap @ state
    return np.concatenate(blocks)[: cells + 1]


def _lyapunov_factor(generator: Matrix, rate_per_s: float) -> Matrix:
    """A factor L of P = LᵀL with GᵀP + PG ⪯ −2νP, checked after the fact.

    Raises:
        NotDecayingError: no such P was found to working precision.
    """
    from scipy.linalg import cholesky, solve_continuous_lyapunov

    n = len(generator)
    shifted = generator + rate_per_s * np.eye(n)
    P = solve_continuous_lyapunov(shifted.T, -np.eye(n))
    P = 0.5 * (P + P.T)
    residual = shifted.T @ P + P @ shifted
    try:
        factor = cholesky(P)
    except np.linalg.LinAlgError:
        raise NotDecayingError("no Lyapunov function was found") from None
    if np.linalg.eigvalsh(residual).max() > 0:
        raise NotDecayingError("the Lyapunov function does not stand its check")
    return np.asarray(factor)


def _fastest(generator: Matrix) -> float:
    """The rate in 1/s that sets the step."""
    magnitude = float(np.abs(np.linalg.eigvals(generator)).max())
    return max(magnitude, 0.2 * _logarithmic_norm(generator), np.finfo(float).tiny)


def _logarithmic_norm(generator: Matrix) -> float:
    return float(np.linalg.eigvalsh(0.5 * (generator + generator.T)).max())


def _spectral_norms(stack: Stack) -> Stack:
    if min(stack.shape[1:]) == 1:
        return _frobenius_norms(stack)
    return np.asarray(np.linalg.norm(stack, 2, axis=(1, 2)))


def _frobenius_norms(stack: Stack) -> Stack:
    return np.asarray(np.sqrt(np.einsum("kij,kij->k", stack, stack)))
