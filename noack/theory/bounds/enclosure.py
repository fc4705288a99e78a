"""Rigorous upper bounds of ‖C e^{Gτ} D‖ over time: suprema and integrals, enclosed between samples.

A response e^{Gτ}D is computed at the nodes of a grid (:func:`response`, :func:`response_until`).
:class:`ResponseBounds` applies output matrices C to it and returns :class:`KernelBounds`. Between
two nodes at a distance s, F(τ) = C e^{Gτ} D differs from the chord by at most s²/8 · sup‖F''‖ (its
integral by s³/12 · sup‖F''‖), and a norm is convex along a chord. sup‖F''‖ over the cell, with F''
= C G² e^{Gτ} D, is bounded by Taylor's formula from the left node. The remainder is bounded by the
smaller of two bounds: e^{μ s} with the logarithmic norm μ of G; or, in coordinates L with
logarithmic norm −ν < 0 (:mod:`noack.theory.bounds.contraction`), ‖C e^{Gs} Y‖ ≤ ‖C L^{−1}‖ ‖L Y‖
e^{−νs}. The second one also bounds the response beyond the grid. Steps become longer when fast
modes have decayed, so a stiff system needs hardly more steps than others.

Rounding: the error of the products C Y is bounded by n ε |C| |Y|, which matters if C and D are
ill-conditioned. All other rounding errors, about 1e-12 of a value, are covered by a relative
inflation of 1e-9.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import accumulate, pairwise
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, spectral_abscissa
from noack.core.matrix_exponential import exponential
from noack.theory.bounds.contraction import (
    EPSILON,
    Decay,
    Stack,
    find_decay,
    frobenius_norms,
    largest_gains,
    logarithmic_norm,
    product,
    sizes,
    spectral_norm,
    spectral_norms,
    times,
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
Name = TypeVar("Name", bound=str)


class NotDecayingError(ArithmeticError):
    """The generator is not Hurwitz: bounds over all times would be infinite."""


@dataclass(frozen=True)
class KernelBounds:
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
        first = np.searchsorted(self.edges_s, after_s, side="right") - 1
        beyond_s = np.maximum(after_s - self.edges_s[-1], 0.0)
        return np.asarray(self._from_cell[first] * np.exp(-self.tail_rate_per_s * beyond_s))

    @cached_property
    def _from_cell(self) -> NDArray[np.float64]:
        """Sup of k from the begin of each cell on."""
        return np.maximum.accumulate(np.append(self.highest, self.tail_highest)[::-1])[::-1]

    def integral(self) -> float:
        """∫k over all times."""
        return float(self.area.sum()) + self.tail_area

    def sup_on_grid(self) -> float:
        """Sup of k over the grid only."""
        return float(self.highest.max(initial=0.0))

    def integral_on_grid(self) -> float:
        """∫k over the grid only."""
        return float(self.area.sum())


def constant_kernel(value: float) -> KernelBounds:
    """Return the kernel of a constant response."""
    edges_s = np.array([0.0, 1.0])
    return KernelBounds(edges_s, np.full(1, value), np.full(1, value), value, math.inf, 0.0)


class Outputs(Generic[Name]):
    """Several output matrices C, (q, n) each, whose bounds are computed at once.

    They are ``stacked`` one below the other; ``rows`` are the rows of each, ``norms`` its ‖C‖.
    """

    def __init__(self, matrices: Mapping[Name, Matrix]) -> None:
        self.names = list(matrices)
        self.stacked = np.concatenate(list(matrices.values()))
        self.rows = _slices(*accumulate(map(len, matrices.values()), initial=0))
        self.norms = self.norms_with(None)

    def norms_with(self, M: Matrix | None) -> NDArray[np.float64]:
        """Return ‖C M‖ of each C."""
        product = self.stacked if M is None else self.stacked @ M
        return np.array([spectral_norm(product[rows]) for rows in self.rows])

    def sizes(self, values: Stack, columns: Sequence[slice]) -> Stack:
        """Return the Frobenius norms of C Y, (rows, r, k) → (outputs, groups of columns, k)."""
        return np.array([[sizes(values[rows, group]) for group in columns] for rows in self.rows])


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
    """Whether bounds beyond the grid are requested, for one group of columns."""
    groups: tuple[int, ...] = (0,)
    """The first column of each group of D's columns that is bounded apart."""

    @cached_property
    def _bends(self) -> "_Bends":
        nodes = self._nodes[:, :, :-1]
        return _bends(self.generator, nodes, np.diff(self.edges_s), self.decay, self._columns)

    @cached_property
    def _nodes(self) -> Stack:
        """The states with time last, (n, r, cells + 1)."""
        return np.ascontiguousarray(self.states.transpose(1, 2, 0))

    @property
    def _columns(self) -> list[slice]:
        """The columns of each group."""
        return _slices(*self.groups, self.states.shape[2])

    def through(self, C: Matrix) -> KernelBounds:
        """Return bounds of ‖C e^{Gτ} D‖, with C of shape (q, n)."""
        return self.through_each(Outputs({"": C}))[""]

    def through_each(self, outputs: Outputs[Name]) -> dict[Name, KernelBounds]:
        """Return bounds of ‖C e^{Gτ} D‖ for every output."""
        return {name: kernel for name, (kernel,) in self.through_groups(outputs).items()}

    def through_groups(self, outputs: Outputs[Name]) -> dict[Name, list[KernelBounds]]:
        """Return bounds of ‖C e^{Gτ} D‖ for every output and each group of columns of D."""
        steps_s, columns, nodes = np.diff(self.edges_s), self._columns, self._nodes
        exact = times(outputs.stacked, nodes)
        rounding = outputs.sizes(times(np.abs(outputs.stacked), np.abs(nodes)), columns)
        norms = np.array(
            [[largest_gains(exact[rows, group]) for group in columns] for rows in outputs.rows]
        )
        norms += EPSILON * len(nodes) * rounding
        bends = self._bends.over(outputs)
        middle = 0.5 * (norms[..., :-1] + norms[..., 1:])
        highest = np.maximum(norms[..., :-1], norms[..., 1:]) + steps_s**2 / 8 * bends
        areas = (steps_s * middle + steps_s**3 / 12 * bends) * _ROUNDING
        highest *= _ROUNDING
        rate, beyond = 0.0, np.full(norms.shape[:2], math.inf)
        if self.endless and self.decay is not None:
            rate = self.decay.rate_per_s
            last = self.decay.sizes(self.states[-1:])
            beyond = outputs.norms_with(self.decay.inverse)[:, None] * last * _ROUNDING
        tails = beyond.tolist()
        return {
            name: [
                KernelBounds(
                    self.edges_s, highest[i, j], areas[i, j], tail,
                    tail / rate if rate > 0 else math.inf, rate,
                )
                for j, tail in enumerate(tails[i])
            ]
            for i, name in enumerate(outputs.names)
        }  # fmt: skip

    def areas_of_columns(self, C: Matrix) -> Stack:
        """Return bounds of Σ_i ∫‖C e^{Gτ} D_i‖ over each cell, for the columns D_i of D."""
        steps_s, nodes, columns = np.diff(self.edges_s), self._nodes, self.states.shape[2]
        rounding = sizes(times(np.abs(C), np.abs(nodes)))
        norms = np.linalg.norm(times(C, nodes), axis=0).sum(axis=0)
        # The sum over the columns is at most √columns times the Frobenius norm.
        norms = norms + np.sqrt(columns) * EPSILON * len(nodes) * rounding
        middle = 0.5 * (norms[:-1] + norms[1:])
        bend = np.sqrt(columns) * self._bends.over(Outputs({"": C}))[0, 0]
        return np.asarray((steps_s * middle + steps_s**3 / 12 * bend) * _ROUNDING)


def norm_bounds(C: Matrix, states: Stack) -> Stack:
    """Return upper bounds of ‖C Y‖ for a stack of Y, (k, n, r) → (k,), including rounding."""
    exact = product(C, states)
    rounding = frobenius_norms(product(np.abs(C), np.abs(states)))
    return np.asarray(spectral_norms(exact) + EPSILON * len(C.T) * rounding)


@dataclass(frozen=True)
class _Bends:
    """The factors, apart from C, of the bounds of ‖C G² e^{Gτ} D‖ over k cells."""

    columns: Sequence[slice]
    """Groups of D's columns."""
    powers: Stack
    """(4, n, n), G^j of Taylor's terms G^j e^{Gτ} D s^{j−2}/(j−2)!."""
    scales: Matrix
    """(4, k), s^{j−2}/(j−2)!"""
    nodes: Stack
    """(n, r, k), e^{Gτ} D at the left nodes."""
    rest: Stack
    """(groups, k), factor of ‖C‖ in a bound of the remainder."""
    decay: Decay | None
    rest_decaying: Stack
    """(groups, k), factor of ‖C L^{−1}‖ in a bound of the remainder from the decay."""
    least: Stack
    """(groups, k), factor of ‖C L^{−1}‖ in a bound of the whole value."""

    def over(self, outputs: Outputs[Name]) -> Stack:
        """Return the bounds for output matrices C, (outputs, groups, k)."""
        turned = (outputs.stacked @ self.powers).reshape(-1, len(self.nodes))
        terms = times(turned, self.nodes)
        terms = terms.reshape(len(self.powers), -1, *terms.shape[1:])

        def total(values: Stack) -> Stack:
            norms = np.sqrt(np.einsum("jirk,jirk->jk", values, values))
            return np.asarray((norms * self.scales).sum(axis=0))

        bound = np.array(
            [[total(terms[:, rows, group]) for group in self.columns] for rows in outputs.rows]
        )
        rest = outputs.norms[:, None, None] * self.rest
        if self.decay is None:
            return np.asarray(bound + rest)
        seen = outputs.norms_with(self.decay.inverse)[:, None, None]
        bound += np.minimum(rest, seen * self.rest_decaying)
        return np.asarray(np.minimum(seen * self.least, bound))


def _bends(
    generator: Matrix, nodes: Stack, steps_s: Stack, decay: Decay | None, columns: Sequence[slice]
) -> _Bends:
    """Return the factors for the cells that start at the nodes, (n, r, k), by Taylor's formula."""
    exponents = max(logarithmic_norm(generator), 0.0) * steps_s
    growth = np.where(
        exponents < _LARGEST_EXPONENT, np.exp(exponents.clip(max=_LARGEST_EXPONENT)), np.inf
    )
    powers, scales = [generator @ generator], [np.ones(len(steps_s))]
    for order in range(1, _TAYLOR_TERMS + 1):
        powers.append(generator @ powers[-1])
        scales.append(scales[-1] * (steps_s / order))

    def norms(matrix: Matrix) -> Stack:
        values = times(matrix, nodes)
        return np.array([sizes(values[:, group]) for group in columns])

    none = np.zeros(0)
    return _Bends(
        columns,
        np.array(powers[:-1]),
        np.array(scales[:-1]),
        nodes,
        growth * scales[-1] * norms(powers[-1]),
        decay,
        none if decay is None else scales[-1] * norms(decay.factor @ powers[-1]),
        none if decay is None else norms(decay.factor @ powers[0]),
    )


def _slices(*ends: int) -> list[slice]:
    return [slice(*pair) for pair in pairwise(ends)]


def response(generator: Matrix, D: Matrix) -> ResponseBounds:
    """Compute e^{Gτ} D over all times, shapes (n, n) and (n, r).

    Raises:
        NotDecayingError: G is not Hurwitz.
    """
    margin = -spectral_abscissa(generator)
    if margin <= 0:
        raise NotDecayingError(f"a mode of the loop grows at {-margin:.3g} /s")
    decay = find_decay(generator)
    if decay is None:
        raise NotDecayingError("no Lyapunov function of it was found to working precision")
    everything = Outputs({"": np.eye(len(generator))})
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
        rest = float(decay.bounds(everything.stacked, state[None])[0]) / decay.rate_per_s
        if rest <= _TAIL_SHARE * area or cells >= most_cells:
            break
        while step_s > usual_s and not _straight(everything, generator, state, step_s, decay):
            step_s /= 2
        if 2 * step_s <= usual_s or _straight(everything, generator, state, 2 * step_s, decay):
            step_s *= 2
    states = np.concatenate([*parts, state[None]])
    return ResponseBounds(generator, np.concatenate(edges), states, decay, endless=True)


def _straight(
    everything: Outputs[str], generator: Matrix, state: Matrix, step_s: float, decay: Decay
) -> bool:
    """Return whether e^{Gτ} Y is close to its chord over a step."""
    size = float(np.linalg.norm(state))
    bends = _bends(generator, state[:, :, None], np.array([step_s]), decay, [slice(None)])
    return bool(step_s**2 / 8 * bends.over(everything).item() <= _SAG * size)


def response_until(
    generator: Matrix, D: Matrix, until_s: float, cells: int = 64, groups: tuple[int, ...] = (0,)
) -> ResponseBounds:
    """Compute e^{Gτ} D over 0 ≤ τ ≤ ``until_s`` on a grid of ``cells`` equal cells."""
    step_s = until_s / cells
    return ResponseBounds(
        generator,
        np.linspace(0.0, until_s, cells + 1),
        _propagate(generator, D, step_s, cells),
        find_decay(generator) if step_s * np.linalg.norm(generator) > 1 else None,
        endless=False,
        groups=groups,
    )


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
    entries = np.asarray(generator, dtype=np.float64).tobytes()
    powers, leap = _powers(entries, len(generator), step_s, min(_BLOCK, cells))
    size, blocks = len(powers), []
    for _ in range(-(-(cells + 1) // size)):
        blocks.append((powers.reshape(-1, len(state)) @ state).reshape(size, *state.shape))
        state = leap @ state
    return np.concatenate(blocks)[: cells + 1]


@lru_cache(maxsize=8)
def _powers(entries: bytes, n: int, step_s: float, least: int) -> tuple[Stack, Matrix]:
    """Return e^{G k s} for k < 2^j, at least so many, and e^{G 2^j s}.

    The matrix is given by its entries; several responses follow each other with the same steps.
    """
    generator = np.frombuffer(entries).reshape(n, n)
    powers, leap = np.eye(n)[None], exponential(generator * step_s)
    while len(powers) < least:
        later = (powers.reshape(-1, n) @ leap).reshape(-1, n, n)
        powers, leap = np.concatenate([powers, later]), leap @ leap
    return powers, leap


def _fastest(generator: Matrix) -> float:
    """Return the rate in 1/s that determines the step."""
    magnitude = float(np.abs(np.linalg.eigvals(generator)).max())
    return max(magnitude, 0.2 * logarithmic_norm(generator), np.finfo(float).tiny)
