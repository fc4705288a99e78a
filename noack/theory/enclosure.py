"""Rigorous upper bounds of ‖C e^{Gτ} D‖ over time: suprema and integrals, enclosed between samples.

A response e^{Gτ}D is computed at the nodes of a grid. Between two nodes at a distance s,
F(τ) = C e^{Gτ} D differs from the chord by at most s²/8 · sup‖F''‖ (its integral by s³/12 ·
sup‖F''‖), and a norm is convex along a chord. sup‖F''‖ over the cell, with F'' = C G² e^{Gτ} D, is
bounded by Taylor's formula from the left node. The remainder is bounded by the smaller of two
bounds: e^{μ s} with the logarithmic norm μ of G; or, in coordinates L with logarithmic norm −ν < 0
(:mod:`noack.theory.contraction`), ‖C e^{Gs} Y‖ ≤ ‖C L^{−1}‖ ‖L Y‖ e^{−νs}. The second one also
bounds the response beyond the grid. Steps become longer when fast modes have decayed, so a stiff
system needs hardly more steps than others.

Rounding: the error of the products C Y is bounded by n ε |C| |Y|, which matters if C and D are
ill-conditioned. All other rounding errors, about 1e-12 of a value, are covered by a relative
inflation of 1e-9.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, spectral_abscissa
from noack.theory.contraction import (
    EPSILON,
    Decay,
    Stack,
    decay_of,
    frobenius_norms,
    logarithmic_norm,
    product,
    spectral_norms,
)

_ROUNDING = 1.0 + 1e-9
_TAYLOR_TERMS = 4
_LARGEST_EXPONENT = 100.0
_BLOCK = 64
_FIRST_STEP, _STEP = 0.05, 0.2
"""Step lengths as shares of the fastest mode's time constant."""
_SAG = 0.005
"""A step may become longer if the chord deviates from e^{Gτ}D by at most this share of its norm."""
_CELLS_PER_BLOCK = 256
_MOST_CELLS = 60_000
_MOST_ENTRIES = 4_000_000
"""Largest number of entries of all matrices of a response. With many states there are fewer cells,
and the looser bound beyond the grid applies earlier."""
_TAIL_SHARE = 1e-5


class NotDecayingError(ArithmeticError):
    """The generator is not Hurwitz: bounds over all times would be infinite."""


class KernelBounds(NamedTuple):
    """Upper bounds of k(τ) = ‖C e^{Gτ} D‖ (spectral norm) on a grid of cells, and beyond it."""

    edges_s: NDArray[np.float64]
    """(cells + 1,) nodes of the grid, from 0."""
    highest: NDArray[np.float64]
    """(cells,) bound of k over each cell."""
    area: NDArray[np.float64]
    """(cells,) bound of ∫k over each cell."""
    tail_highest: float
    """Bound of k beyond the grid; infinite if it was not requested."""
    tail_area: float
    """Bound of ∫k beyond the grid."""
    tail_rate_per_s: float
    """Decay rate of the bound of k beyond the grid."""

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
class ResponseBounds:
    """e^{Gτ} D at the nodes of a grid; :meth:`through` applies an output matrix C."""

    generator: Matrix
    """G, (n, n), per second."""
    edges_s: NDArray[np.float64]
    """(cells + 1,)"""
    states: Stack
    """(cells + 1, n, r), e^{Gτ} D."""
    decay: Decay | None
    """L and ν; None if they are not needed, or if G does not decay."""
    endless: bool
    """Whether bounds beyond the grid are requested."""

    @cached_property
    def _bends(self) -> "_Bends":
        return _bends(self.generator, self.states[:-1], np.diff(self.edges_s), self.decay)

    def through(self, C: Matrix) -> KernelBounds:
        """Return bounds of ‖C e^{Gτ} D‖, with C of shape (q, n)."""
        steps_s = np.diff(self.edges_s)
        norms = norm_bounds(C, self.states)
        bend = self._bends.over(C)
        ends = np.maximum(norms[:-1], norms[1:])
        middle = 0.5 * (norms[:-1] + norms[1:])
        rate, beyond = 0.0, math.inf
        if self.endless and self.decay is not None:
            rate = self.decay.rate_per_s
            beyond = float(self.decay.bounds(C, self.states[-1:])[0]) * _ROUNDING
        return KernelBounds(
            self.edges_s,
            (ends + steps_s**2 / 8 * bend) * _ROUNDING,
            (steps_s * middle + steps_s**3 / 12 * bend) * _ROUNDING,
            beyond,
            beyond / rate if rate > 0 else math.inf,
            rate,
        )

    def areas_of_columns(self, C: Matrix) -> Stack:
        """Return bounds of Σ_i ∫‖C e^{Gτ} D_i‖ over each cell, for the columns D_i of D."""
        steps_s, n, columns = np.diff(self.edges_s), len(C.T), self.states.shape[2]
        rounding = frobenius_norms(product(np.abs(C), np.abs(self.states)))
        norms = np.linalg.norm(product(C, self.states), axis=1).sum(axis=1)
        # The sum over the columns is at most √columns times the Frobenius norm.
        norms = norms + np.sqrt(columns) * EPSILON * n * rounding
        middle = 0.5 * (norms[:-1] + norms[1:])
        bend = np.sqrt(columns) * self._bends.over(C)
        return np.asarray((steps_s * middle + steps_s**3 / 12 * bend) * _ROUNDING)


def norm_bounds(C: Matrix, states: Stack) -> Stack:
    """Return upper bounds of ‖C Y‖ for a stack of Y, (k, n, r) → (k,), including rounding."""
    exact = product(C, states)
    rounding = frobenius_norms(product(np.abs(C), np.abs(states)))
    return np.asarray(spectral_norms(exact) + EPSILON * len(C.T) * rounding)


@dataclass(frozen=True)
class _Bends:
    """The factors, apart from C, of the bounds of ‖C G² e^{Gτ} D‖ over k cells."""

    terms: Stack
    """(4k, n, r), Taylor's terms G^j e^{Gτ} D s^{j−2}/(j−2)! at the left nodes, by order."""
    rest: Stack
    """(k,), factor of ‖C‖ in a bound of the remainder."""
    decay: Decay | None
    rest_decaying: Stack
    """(k,), factor of ‖C L^{−1}‖ in a bound of the remainder from the decay."""
    least: Stack
    """(k,), factor of ‖C L^{−1}‖ in a bound of the whole value."""

    def over(self, C: Matrix) -> Stack:
        """Return the bounds for an output matrix C, (k,)."""
        bound = frobenius_norms(product(C, self.terms)).reshape(_TAYLOR_TERMS, -1).sum(axis=0)
        rest = float(np.linalg.norm(C, 2)) * self.rest
        if self.decay is None:
            return np.asarray(bound + rest)
        seen = self.decay.seen(C)
        bound += np.minimum(rest, seen * self.rest_decaying)
        return np.asarray(np.minimum(seen * self.least, bound))


def _bends(generator: Matrix, nodes: Stack, steps_s: Stack, decay: Decay | None) -> _Bends:
    """Return the factors for the cells that start at the nodes, (k, n, r), by Taylor's formula."""
    exponents = max(logarithmic_norm(generator), 0.0) * steps_s
    growth = np.where(
        exponents < _LARGEST_EXPONENT, np.exp(exponents.clip(max=_LARGEST_EXPONENT)), np.inf
    )
    terms = [product(generator, product(generator, nodes))]
    for order in range(1, _TAYLOR_TERMS + 1):
        terms.append(product(generator, terms[-1]) * (steps_s / order)[:, None, None])
    none = np.zeros(0)
    return _Bends(
        np.concatenate(terms[:-1]),
        growth * frobenius_norms(terms[-1]),
        decay,
        none if decay is None else decay.sizes(terms[-1]),
        none if decay is None else decay.sizes(terms[0]),
    )


def response(generator: Matrix, D: Matrix) -> ResponseBounds:
    """Compute e^{Gτ} D over all times, shapes (n, n) and (n, r).

    Raises:
        NotDecayingError: G is not Hurwitz.
    """
    margin = -spectral_abscissa(generator)
    if margin <= 0:
        raise NotDecayingError(f"the slowest mode grows at {-margin:.3g} /s")
    decay = decay_of(generator)
    if decay is None:
        raise NotDecayingError("no Lyapunov function of it was found to working precision")
    everything = np.eye(len(generator))
    parts: list[Stack] = []
    edges: list[Stack] = [np.zeros(1)]
    area, t_s, state, cells = 0.0, 0.0, D, 0
    most_cells = min(_MOST_CELLS, _MOST_ENTRIES // D.size)
    usual_s = _STEP / _fastest(generator)
    step_s = usual_s * _FIRST_STEP / _STEP
    while True:
        states = _propagate(generator, state, step_s, _CELLS_PER_BLOCK)
        parts.append(states[:-1])
        edges.append(np.asarray(t_s + step_s * np.arange(1.0, _CELLS_PER_BLOCK + 1)))
        t_s, state = float(edges[-1][-1]), states[-1]
        area += step_s * float(frobenius_norms(states[:-1]).sum())
        cells += _CELLS_PER_BLOCK
        rest = float(decay.bounds(everything, state[None])[0]) / decay.rate_per_s
        if rest <= _TAIL_SHARE * area or cells >= most_cells:
            break
        while step_s > usual_s and not _straight(generator, state, step_s, decay):
            step_s /= 2
        if 2 * step_s <= usual_s or _straight(generator, state, 2 * step_s, decay):
            step_s *= 2
    states = np.concatenate([*parts, state[None]])
    return ResponseBounds(generator, np.concatenate(edges), states, decay, endless=True)


def _straight(generator: Matrix, state: Matrix, step_s: float, decay: Decay) -> bool:
    """Return whether e^{Gτ} Y is close to its chord over a step."""
    size = float(np.linalg.norm(state))
    everything, steps_s = np.eye(len(generator)), np.array([step_s])
    bend = _bends(generator, state[None], steps_s, decay).over(everything)
    return bool(step_s**2 / 8 * bend[0] <= _SAG * size)


def response_until(generator: Matrix, D: Matrix, until_s: float, cells: int = 64) -> ResponseBounds:
    """Compute e^{Gτ} D over 0 ≤ τ ≤ ``until_s`` on a grid of ``cells`` equal cells."""
    step_s = until_s / cells
    return ResponseBounds(
        generator,
        np.linspace(0.0, until_s, cells + 1),
        _propagate(generator, D, step_s, cells),
        decay_of(generator) if step_s * np.linalg.norm(generator) > 1 else None,
        endless=False,
    )


def constant_kernel(value: float) -> KernelBounds:
    """Return the kernel of a constant response."""
    edges_s = np.array([0.0, 1.0])
    return KernelBounds(edges_s, np.full(1, value), np.full(1, value), value, math.inf, 0.0)


def factors(matrix: Matrix) -> tuple[Matrix, Matrix]:
    """Factorise a matrix as L R; L has orthonormal columns, their number is the matrix's rank.

    ‖L R v‖ = ‖R v‖, so a signal that acts in few directions is bounded in these directions only.
    """
    U, singular, Vt = np.linalg.svd(matrix, full_matrices=False)
    cut = singular.max(initial=0.0) * max(matrix.shape) * np.finfo(float).eps
    # The omitted part is below the matrix's rounding error; a zero matrix keeps one column.
    rank = max(int((singular > cut).sum()), 1)
    return U[:, :rank], singular[:rank, None] * Vt[:rank]


def _propagate(generator: Matrix, state: Matrix, step_s: float, cells: int) -> Stack:
    """Return e^{G k s} state for k = 0 … cells, (cells + 1, n, r), block by block."""
    from scipy.linalg import expm

    powers, size = np.eye(len(generator))[None], min(_BLOCK, cells)
    leap = expm(generator * step_s)
    while len(powers) < size:
        powers, leap = np.concatenate([powers, product(leap, powers)]), leap @ leap
    size = len(powers)
    blocks = []
    for _ in range(-(-(cells + 1) // size)):
        blocks.append((powers.reshape(-1, len(state)) @ state).reshape(size, *state.shape))
        state = leap @ state
    return np.concatenate(blocks)[: cells + 1]


def _fastest(generator: Matrix) -> float:
    """Return the rate in 1/s that determines the step."""
    magnitude = float(np.abs(np.linalg.eigvals(generator)).max())
    return max(magnitude, 0.2 * logarithmic_norm(generator), np.finfo(float).tiny)
