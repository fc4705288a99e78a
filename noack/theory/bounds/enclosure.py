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

G, D and C are matrices, or stacks of matrices with common leading axes "…", whose bounds are
computed together. The grids of a stack have equally many nodes; where one ends earlier, its last
cells have the width 0.

Rounding: the error of the products C Y is bounded by n ε |C| |Y|, which matters if C and D are
ill-conditioned. All other rounding errors, about 1e-12 of a value, are to be covered by a relative
inflation of 1e-9 (``ROUNDING``).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from noack.core.cached_method import cached_function, cached_method
from noack.core.linear_systems import Matrix, exponential
from noack.theory.bounds.contraction import EPSILON, Decay, abscissas, find_decay, logarithmic_norm
from noack.theory.bounds.stacked_norms import (
    ROUNDING,
    Stack,
    frobenius_norms,
    frobenius_norms_along_last,
    larger_ends,
    product_along_last,
    spectral_norm,
    spectral_norms,
    spectral_norms_along_last,
    stack_product,
)

_TAYLOR_TERMS = 4
"""Terms by which a second derivative over a cell is bounded; then comes the remainder."""
_LARGEST_EXPONENT = 100.0
"""Larger exponents of a remainder count as infinite: its bound would be of no use."""
_BLOCK = 64
"""Powers of e^{Gs} that are multiplied with a state by one product."""
_FIRST_STEP, _STEP = 0.05, 0.2
"""Step lengths as shares of the fastest mode's time constant."""
_SAG = 0.005
"""A step may become longer if the chord deviates from e^{Gτ}D by at most this share of its norm."""
_CELLS_PER_BLOCK, _MOST_CELLS = 256, 60_000
"""Cells of equal length, after which the step is chosen anew; limit of all cells."""
_MOST_ENTRIES = 4_000_000
"""Largest number of entries of all matrices of a response. With many states there are fewer cells,
and the looser bound beyond the grid applies earlier."""
_TAIL_SHARE = 1e-5
"""The grid ends where the bound of the area beyond it is at most this share of its own area."""
Name = TypeVar("Name", bound=str)
Groups = Sequence[slice]
"""Groups of columns."""


class NotDecayingError(ArithmeticError):
    """The generator is not Hurwitz: bounds over all times would be infinite."""


@dataclass(frozen=True)
class KernelBounds:
    """Upper bounds of k(τ) = ‖C e^{Gτ} D‖ (spectral norm) on a grid of cells, and beyond it."""

    edges_s: Stack
    """(…, cells + 1) nodes of the grid, from 0."""
    highest: Stack
    """(…, cells) bound of k over each cell."""
    area: Stack
    """(…, cells) bound of ∫k over each cell."""
    tail_highest: Stack
    """(…) Bound of k beyond the grid; infinite if it was not requested."""
    tail_area: Stack
    """(…) Bound of ∫k beyond the grid."""
    tail_rate_per_s: Stack
    """(…) Decay rate of the bound of k beyond the grid."""

    def sup(self, after_s: float = 0.0) -> Stack:
        """Sup of k(τ) over τ ≥ ``after_s``, (…)."""
        return self.sups(np.array([after_s]))[..., 0] if after_s else self._from_cell[..., 0]

    def sups(self, after_s: Stack) -> Stack:
        """Sup of k(τ) over τ ≥ a for each a, (…, j)."""
        first_cells = cells_at(self.edges_s, after_s)
        beyond_s = np.maximum(after_s - self.edges_s[..., -1:], 0.0)
        decayed = np.exp(-np.asarray(self.tail_rate_per_s)[..., None] * beyond_s)
        return np.asarray(take_rows(self._from_cell, first_cells) * decayed)

    @cached_property
    def _from_cell(self) -> Stack:
        """Sup of k from the start of each cell on."""
        tail = np.broadcast_to(self.tail_highest, self.highest.shape[:-1])[..., None]
        values = np.concatenate([self.highest, tail], axis=-1)[..., ::-1]
        return np.maximum.accumulate(values, axis=-1)[..., ::-1]

    def integral(self) -> Stack:
        """∫k over all times, (…)."""
        return np.asarray(self.area.sum(axis=-1) + self.tail_area)

    def integral_until(self, age_s: Stack) -> Stack:
        """∫₀^a k for each a, (j,), of one kernel."""
        sums = np.append(0.0, np.cumsum(self.area))
        cell = np.searchsorted(self.edges_s, age_s, side="right") - 1
        inside = np.minimum(cell, len(self.area) - 1)
        in_cell = self.highest[inside] * (age_s - self.edges_s[inside])
        until_age = sums[inside] + np.minimum(in_cell, self.area[inside])
        return np.asarray(np.where(cell < len(self.area), until_age, self.integral()))

    def sup_on_grid(self) -> Stack:
        """Sup of k over the grid only, (…)."""
        return np.asarray(self.highest.max(axis=-1, initial=0.0))

    def integral_on_grid(self) -> Stack:
        """∫k over the grid only, (…)."""
        return np.asarray(self.area.sum(axis=-1))


def cells_at(edges_s: Stack, t_s: Stack) -> NDArray[np.intp]:
    """Return the cell of each time, (…, j), in a grid, (…, cells + 1); the last edge is a cell."""
    if edges_s.ndim == 1:
        return np.asarray(np.searchsorted(edges_s, t_s, side="right") - 1)
    lead = np.broadcast_shapes(edges_s.shape[:-1], t_s.shape[:-1])
    cells = np.empty((*lead, t_s.shape[-1]), np.intp)
    edges_s = np.broadcast_to(edges_s, (*lead, edges_s.shape[-1]))
    t_s = np.broadcast_to(t_s, cells.shape)
    for index in np.ndindex(lead):
        cells[index] = np.searchsorted(edges_s[index], t_s[index], side="right")
    return cells - 1


def take_rows(values: Stack, indices: NDArray[np.intp]) -> Stack:
    """Return the values, (…, k), at some indices, (…, j), along the last axis."""
    if values.ndim == 1:
        return np.asarray(values[indices])
    return np.take_along_axis(values, indices, axis=-1)


def constant_kernel(value: float | Stack) -> KernelBounds:
    """Return the kernel of a constant response, (…)."""
    tail = np.asarray(value, dtype=np.float64)
    values = tail[..., None]
    return KernelBounds(np.array([0.0, 1.0]), values, values, tail, np.array(math.inf), np.array(0.0))


class Outputs(Generic[Name]):
    """Several output matrices C, (…, q, n) each, whose bounds are computed at once.

    They are ``stacked`` one below the other; ``rows`` are the rows of each, ``norms`` its ‖C‖.
    """

    def __init__(self, matrices: Mapping[Name, Matrix]) -> None:
        self.names = list(matrices)
        lead = np.broadcast_shapes(*(C.shape[:-2] for C in matrices.values()))
        matrices_alike = [np.broadcast_to(C, (*lead, *C.shape[-2:])) for C in matrices.values()]
        self.stacked = np.concatenate(matrices_alike, axis=-2)
        self.rows = _slices(*accumulate((C.shape[-2] for C in matrices_alike), initial=0))
        self._alike = _grouped(self.rows)
        self.norms = self.norms_with(None)

    def norms_with(self, M: Matrix | None) -> Stack:
        """Return ‖C M‖ of each C, (…, outputs)."""
        product = self.stacked if M is None else self.stacked @ M
        norms = np.empty((*product.shape[:-2], len(self.rows)))
        for indices, rows in self._alike:
            norms[..., indices] = spectral_norm(product[..., rows, :])
        return norms

    def each(self, norm: Callable[[Stack], Stack], values: Stack, columns: Groups) -> Stack:
        """Return a norm of each C Y, (…, rows, r, k) → (…, outputs, groups of columns, k)."""
        *lead, _, _, cells = values.shape
        stack = np.empty((*lead, len(self.rows), len(columns), cells))
        for indices, rows in self._alike:
            for number, group in enumerate(columns):
                stack[..., indices, number, :] = norm(values[..., rows, group, :])
        return stack


def _grouped(groups: Groups) -> list[tuple[list[int], NDArray[np.intp]]]:
    """Return the indices of groups of equal length, with the rows of each, (groups, rows)."""
    lengths = [group.stop - group.start for group in groups]
    stacks = []
    for length in dict.fromkeys(lengths):
        indices = [index for index, other in enumerate(lengths) if other == length]
        rows = np.array([range(groups[index].start, groups[index].stop) for index in indices])
        stacks.append((indices, rows))
    return stacks


@dataclass(frozen=True)
class ResponseBounds:
    """e^{Gτ} D at the nodes of a grid; :meth:`through` applies an output matrix C."""

    generator: Matrix
    """G, (…, n, n), per second."""
    edges_s: Stack
    """(…, cells + 1)"""
    states: Stack
    """(…, cells + 1, n, r), e^{Gτ} D."""
    decay: Decay | None
    """L and ν; None if they are not needed, or if G does not decay."""
    has_tail: bool
    """Whether bounds beyond the grid are requested, for one group of columns."""
    groups: tuple[int, ...] = (0,)
    """The first column of each group of D's columns that is bounded separately."""

    @cached_property
    def _bends(self) -> "_Bends":
        nodes = self._nodes[..., :-1]
        return _bound_bends(self.generator, nodes, np.diff(self.edges_s), self.decay, self._columns)

    @cached_property
    def _nodes(self) -> Stack:
        """The states with time last, (…, n, r, cells + 1)."""
        return np.ascontiguousarray(np.moveaxis(self.states, -3, -1))

    @property
    def _columns(self) -> Groups:
        """The columns of each group."""
        return _slices(*self.groups, self.states.shape[-1])

    def through(self, C: Matrix) -> KernelBounds:
        """Return bounds of ‖C e^{Gτ} D‖, with C of shape (…, q, n)."""
        return self.through_each(Outputs({"": C}))[""]

    def through_each(self, outputs: Outputs[Name]) -> dict[Name, KernelBounds]:
        """Return bounds of ‖C e^{Gτ} D‖ for every output."""
        return {name: kernel for name, (kernel,) in self.through_groups(outputs).items()}

    @cached_method
    def through_groups(self, outputs: Outputs[Name]) -> dict[Name, list[KernelBounds]]:
        """Return bounds of ‖C e^{Gτ} D‖ for every output and each group of columns of D."""
        columns, nodes = self._columns, self._nodes
        steps_s = np.diff(self.edges_s)[..., None, None, :]
        # The norms at the nodes, with the rounding of the products.
        norms = outputs.each(spectral_norms_along_last, product_along_last(outputs.stacked, nodes), columns)
        magnitudes = product_along_last(np.abs(outputs.stacked), np.abs(nodes))
        norms += EPSILON * nodes.shape[-3] * outputs.each(frobenius_norms_along_last, magnitudes, columns)
        # Over each cell by both ends and the sag, and beyond the last one by the decay.
        bends = self._bends.over(outputs)
        middle = 0.5 * (norms[..., :-1] + norms[..., 1:])
        highest = larger_ends(norms) + steps_s**2 / 8 * bends
        areas = (steps_s * middle + steps_s**3 / 12 * bends) * ROUNDING
        highest *= ROUNDING
        rate, tails = np.array(0.0), np.full(norms.shape[:-1], math.inf)
        if self.has_tail and self.decay is not None:
            rate = self.decay.rate_per_s
            last = self.decay.sizes(self.states[..., -1:, :, :])[..., None, :]
            tails = outputs.norms_with(self.decay.inverse)[..., :, None] * last * ROUNDING
        decays = (rate > 0)[..., None, None]
        after = np.where(decays, tails / np.where(rate > 0, rate, 1.0)[..., None, None], math.inf)
        return {
            name: [
                KernelBounds(
                    self.edges_s,
                    highest[..., i, j, :],
                    areas[..., i, j, :],
                    tails[..., i, j],
                    after[..., i, j],
                    rate,
                )
                for j in range(len(columns))
            ]
            for i, name in enumerate(outputs.names)
        }

    def areas_of_columns(self, C: Matrix) -> Stack:
        """Return bounds of Σ_i ∫‖C e^{Gτ} D_i‖ over each cell, for the columns D_i of D."""
        steps_s, nodes, columns = np.diff(self.edges_s), self._nodes, self.states.shape[-1]
        rounding = frobenius_norms_along_last(product_along_last(np.abs(C), np.abs(nodes)))
        norms = np.linalg.norm(product_along_last(C, nodes), axis=-3).sum(axis=-2)
        # The sum over the columns is at most √columns times the Frobenius norm.
        norms = norms + np.sqrt(columns) * EPSILON * nodes.shape[-3] * rounding
        middle = 0.5 * (norms[..., :-1] + norms[..., 1:])
        bend = np.sqrt(columns) * self._bends.over(Outputs({"": C}))[..., 0, 0, :]
        return np.asarray((steps_s * middle + steps_s**3 / 12 * bend) * ROUNDING)


def norm_bounds(C: Matrix, states: Stack) -> Stack:
    """Return upper bounds of ‖C Y‖ for a stack of Y, (k, n, r) → (k,), including rounding."""
    exact = stack_product(C, states)
    rounding = frobenius_norms(stack_product(np.abs(C), np.abs(states)))
    return np.asarray(spectral_norms(exact) + EPSILON * len(C.T) * rounding)


@dataclass(frozen=True)
class _Bends:
    """The factors, apart from C, of the bounds of ‖C G² e^{Gτ} D‖ over k cells."""

    columns: Groups
    """Groups of D's columns."""
    powers: Stack
    """(…, 4, n, n), G^j of Taylor's terms G^j e^{Gτ} D s^{j−2}/(j−2)!."""
    scales: Stack
    """(…, 4, k), s^{j−2}/(j−2)!"""
    nodes: Stack
    """(…, n, r, k), e^{Gτ} D at the left nodes."""
    remainder: Stack
    """(…, groups, k), factor of ‖C‖ in a bound of the remainder."""
    decay: Decay | None
    decaying_remainder: Stack
    """(…, groups, k), factor of ‖C L^{−1}‖ in a bound of the remainder from the decay; infinite
    without one."""
    decaying_value: Stack
    """(…, groups, k), factor of ‖C L^{−1}‖ in a bound of the whole value; infinite without one."""

    def over(self, outputs: Outputs[Name]) -> Stack:
        """Return the bounds for output matrices C, (…, outputs, groups, k)."""
        transformed = outputs.stacked[..., None, :, :] @ self.powers
        *lead, terms, rows, n = transformed.shape
        images = product_along_last(transformed.reshape(*lead, terms * rows, n), self.nodes)
        images = images.reshape(*images.shape[:-3], terms, rows, *images.shape[-2:])
        terms_of_bound = (
            outputs.each(frobenius_norms_along_last, images, self.columns) * self.scales[..., None, None, :]
        )
        bound = terms_of_bound.sum(axis=-4)
        remainder = outputs.norms[..., None, None] * self.remainder[..., None, :, :]
        if self.decay is None:
            return np.asarray(bound + remainder)
        factor = outputs.norms_with(self.decay.inverse)[..., None, None]
        bound += np.minimum(remainder, factor * self.decaying_remainder[..., None, :, :])
        return np.asarray(np.minimum(factor * self.decaying_value[..., None, :, :], bound))


def _bound_bends(
    generator: Matrix, nodes: Stack, steps_s: Stack, decay: Decay | None, columns: Groups
) -> _Bends:
    """Return the factors for the cells that start at the nodes, (…, n, r, k): Taylor's formula."""
    powers, growth_per_s = _taylor(generator)
    exponents = growth_per_s[..., None] * steps_s
    growth = np.where(exponents < _LARGEST_EXPONENT, np.exp(exponents.clip(max=_LARGEST_EXPONENT)), np.inf)
    scales = [np.ones_like(steps_s)]
    for order in range(1, _TAYLOR_TERMS + 1):
        scales.append(scales[-1] * (steps_s / order))

    def norms(matrix: Matrix) -> Stack:
        values = product_along_last(matrix, nodes)
        return np.stack([frobenius_norms_along_last(values[..., group, :]) for group in columns], axis=-2)

    last = scales[-1][..., None, :]
    decaying_remainder = decaying_value = np.zeros(0)
    if decay is not None:
        exists = (decay.rate_per_s > 0)[..., None, None]
        decaying_remainder = np.where(exists, last * norms(decay.factor @ powers[..., -1, :, :]), math.inf)
        decaying_value = np.where(exists, norms(decay.factor @ powers[..., 0, :, :]), math.inf)
    return _Bends(
        columns,
        powers[..., :-1, :, :],
        np.stack(scales[:-1], axis=-2),
        nodes,
        growth[..., None, :] * last * norms(powers[..., -1, :, :]),
        decay,
        decaying_remainder,
        decaying_value,
    )


@cached_function(8)
def _taylor(generator: Matrix) -> tuple[Stack, Stack]:
    """Return G^j of Taylor's terms and of the remainder, (…, 5, n, n), and max(μ, 0) of G, (…)."""
    powers = [generator @ generator]
    for _ in range(_TAYLOR_TERMS):
        powers.append(generator @ powers[-1])
    return np.stack(powers, axis=-3), np.maximum(logarithmic_norm(generator), 0.0)


def _slices(*ends: int) -> Groups:
    return [slice(*pair) for pair in pairwise(ends)]


@cached_function(8)
def response(generator: Matrix, D: Matrix) -> ResponseBounds:
    """Compute e^{Gτ} D over all times, shapes (…, n, n) and (…, n, r).

    Raises:
        NotDecayingError: a G is not Hurwitz.
    """
    margin = float(-abscissas(generator).max())
    if margin <= 0:
        raise NotDecayingError(f"a mode of the loop grows at {-margin:.3g} /s")
    decay = find_decay(generator)
    if decay is None or not (decay.rate_per_s > 0).all():
        raise NotDecayingError("no Lyapunov function of it was found to working precision")
    # The grid so far: e^{Gτ} D at its nodes in blocks, and their edges.
    everything = Outputs({"": np.eye(generator.shape[-1])})
    lead = np.broadcast_shapes(generator.shape[:-2], D.shape[:-2])
    state = np.broadcast_to(D, (*lead, *D.shape[-2:]))
    parts: list[Stack] = []
    edges: list[Stack] = [np.zeros((*lead, 1))]
    area, cells, ends = np.zeros(lead), 0, np.zeros(lead, dtype=bool)
    # The first steps are shorter than usual; longer ones are usable where the response is straight.
    most_cells = min(_MOST_CELLS, _MOST_ENTRIES // math.prod(D.shape[-2:]))
    usual_s = np.broadcast_to(_STEP / _fastest(generator), lead)
    step_s = usual_s * _FIRST_STEP / _STEP

    def usable_step(step_s: Stack) -> NDArray[np.bool_]:
        is_short = step_s <= usual_s
        return is_short if is_short.all() else is_short | _is_straight(generator, state, step_s, decay)

    while True:
        # The next block of cells.
        states = _propagate(generator, state, step_s, _CELLS_PER_BLOCK)
        parts.append(states[..., :-1, :, :])
        passed_s = step_s[..., None] * np.arange(1.0, _CELLS_PER_BLOCK + 1)
        edges.append(edges[-1][..., -1:] + passed_s)
        state = states[..., -1, :, :]
        area = area + step_s * frobenius_norms(parts[-1]).sum(axis=-1)
        cells += _CELLS_PER_BLOCK
        # The grid ends where the area beyond it is a small share of its own.
        remainder = decay.bounds(everything.stacked, state[..., None, :, :])[..., 0] / decay.rate_per_s
        ends = ends | (remainder <= _TAIL_SHARE * area)
        if ends.all() or cells >= most_cells:
            break
        # The next step is twice as long if that is usable, and shorter if need be.
        while not (usable := usable_step(step_s)).all():
            step_s = np.where(usable, step_s, step_s / 2)
        step_s = np.where(ends, 0.0, np.where(usable_step(2 * step_s), 2 * step_s, step_s))
    states = np.concatenate([*parts, state[..., None, :, :]], axis=-3)
    return ResponseBounds(generator, np.concatenate(edges, axis=-1), states, decay, has_tail=True)


def _is_straight(generator: Matrix, state: Matrix, step_s: Stack, decay: Decay) -> NDArray[np.bool_]:
    """Return whether e^{Gτ} Y is close to its chord over a step, (…)."""
    everything = Outputs({"": np.eye(generator.shape[-1])})
    size = np.linalg.norm(state, axis=(-2, -1))
    bends = _bound_bends(generator, state[..., None], step_s[..., None], decay, [slice(None)])
    return np.asarray(step_s**2 / 8 * bends.over(everything)[..., 0, 0, 0] <= _SAG * size)


@cached_function(32)
def response_until(
    generator: Matrix, D: Matrix, until_s: float | Stack, cells: int = 64, groups: tuple[int, ...] = (0,)
) -> ResponseBounds:
    """Compute e^{Gτ} D over 0 ≤ τ ≤ ``until_s``, (…), on a grid of ``cells`` equal cells."""
    step_s = np.asarray(until_s) / cells
    is_long = step_s * np.linalg.norm(generator, axis=(-2, -1)) > 1
    decay = find_decay(generator) if is_long.any() else None
    if decay is not None:
        decay = decay._replace(rate_per_s=np.where(is_long, decay.rate_per_s, 0.0))
    return ResponseBounds(
        generator,
        np.linspace(0.0, until_s, cells + 1, axis=-1),
        _propagate(generator, D, step_s, cells),
        decay,
        has_tail=False,
        groups=groups,
    )


def factors(matrix: Matrix) -> tuple[Matrix, Matrix]:
    """Factorise matrices of equal rank as L R; L has orthonormal columns, as many as the rank.

    ‖L R v‖ = ‖R v‖, so a signal that acts in few directions is bounded in these directions only.
    """
    U, singular, Vt = np.linalg.svd(matrix, full_matrices=False)
    (rank,) = {int(value) for value in np.ravel(_ranks(singular, matrix.shape))}
    return U[..., :, :rank], singular[..., :rank, None] * Vt[..., :rank, :]


def ranks(matrix: Matrix) -> NDArray[np.int64]:
    """Return the ranks of matrices, (…), as :func:`factors` uses them."""
    return _ranks(np.linalg.svd(matrix, compute_uv=False), matrix.shape)


def _ranks(singular: NDArray[np.floating], shape: tuple[int, ...]) -> NDArray[np.int64]:
    cut = singular.max(axis=-1, initial=0.0) * max(shape[-2:]) * np.finfo(float).eps
    # The omitted part is below the matrix's rounding error; a zero matrix keeps one column.
    return np.asarray(np.maximum((singular > cut[..., None]).sum(axis=-1), 1))


def _propagate(generator: Matrix, state: Matrix, step_s: Stack, cells: int) -> Stack:
    """Return e^{G k s} state for k = 0 … cells, (…, cells + 1, n, r), block by block."""
    powers, leap = _powers(generator, step_s, min(_BLOCK, cells))
    *lead, size, n, _ = powers.shape
    blocks, rows = [], powers.reshape(*lead, size * n, n)
    for _ in range(-(-(cells + 1) // size)):
        block = rows @ state
        blocks.append(block.reshape(*block.shape[:-2], size, n, block.shape[-1]))
        state = leap @ state
    return np.concatenate(blocks, axis=-3)[..., : cells + 1, :, :]


@cached_function(8)
def _powers(generator: Matrix, step_s: Stack, least: int) -> tuple[Stack, Matrix]:
    """Return e^{G k s} for k < 2^j, where 2^j ≥ ``least``, and e^{G 2^j s}.

    Several responses follow each other with the same steps.
    """
    exponents = generator * step_s[..., None, None]
    leap = np.empty(exponents.shape)
    for index in np.ndindex(exponents.shape[:-2]):
        leap[index] = exponential(exponents[index])
    n = generator.shape[-1]
    powers = np.broadcast_to(np.eye(n), (*leap.shape[:-2], 1, n, n))
    while (size := powers.shape[-3]) < least:
        later = (powers.reshape(*leap.shape[:-2], size * n, n) @ leap).reshape(powers.shape)
        powers, leap = np.concatenate([powers, later], axis=-3), leap @ leap
    return powers, leap


def _fastest(generator: Matrix) -> Stack:
    """Return the rate in 1/s that determines the step, (…)."""
    magnitude = np.abs(np.linalg.eigvals(generator)).max(axis=-1)
    rates = np.maximum(magnitude, 0.2 * logarithmic_norm(generator))
    return np.asarray(np.maximum(rates, np.finfo(float).tiny))
