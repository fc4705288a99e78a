"""The flow between two deliveries: what x and e_c can be, if inputs are neither delayed nor held.

From one delivery to the next no update reaches the controller. So z = (x, e_c) follows a linear
system without an input, from (ξ, 0) with the state ξ at the delivery:

    x' = (A + BK + αI) x + BK e_c,    e_c' = −E x + (H − BK + αI) e_c,    z(τ) = e^{Fτ} (ξ, 0)

All that is uncertain is ξ, and the time of the next delivery. Let ‖Λξ‖ ≤ 1 and ‖e_c‖_W ≤ D at all
times. At the time τ, ξ has ‖Λξ‖ ≤ 1 and ‖Nξ‖_W ≤ D, N the rows of e_c in e^{Fs} (I, 0) for an s ≤
τ. So ξ is in the ellipsoid λ‖Λξ‖² + (1 − λ)‖Nξ‖²/D² ≤ 1, for each λ in [0, 1]. So ‖C z(τ)‖ is at
most the norm of C e^{Fτ} on this ellipsoid, and the λ with the smallest is used. If no ‖Λx(τ)‖
found in this way exceeds 1, ‖Λx‖ ≤ 1 holds at the next delivery, whenever it happens, and by
induction at all times: the set ‖Λx‖ ≤ 1 is invariant.

All matrices are in coordinates in which W is the identity. Between two nodes of the grid the bounds
are those of :mod:`noack.theory.bounds.enclosure`, with s the left node. From the last node T on, x
+ e_c = e^{Hτ} ξ has decayed, and z has followed the system for T' from a state with ‖e_c‖_W ≤ D.

**After lost events.** Without the flow, each missing event adds its ‖e_s‖_W in full, as if all had
one direction. But until the next delivery everything follows from z at one time. Let an event be
lost at least w after the delivery, and ‖e_c‖_W ≤ D up to it. z is the value w before it, z' =
e^{Fw} z:

    ‖Λx‖ ≤ c,  ‖e_c‖ ≤ D at z, half way and at z',  ‖e_s‖ = ‖C_r z'‖ ≤ β for r until the next event

With positive weights of sum 1, z is in the ellipsoid of the sum of these forms, which bounds e_c =
(0, I) e^{Fr} z' after r. The weights are improved step by step; all weights give a bound.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, Vector, exponential, spectral_abscissa
from noack.theory.bounds.contraction import (
    Stack,
    largest_eigenvalues,
    logarithmic_norm,
    product,
    spectral_norms,
)
from noack.theory.bounds.enclosure import KernelBounds
from noack.theory.bounds.gains import Output, PlantGains

_CELLS_PER_STEP, _FIRST_STEP, _MOST_STEP = 32, 0.005, 0.02
_MOST_GROWTH, _SETTLED, _MOST_CELLS = 1e6, 0.03, 3000
_LOGITS = np.append(np.arange(-12.0, 13.0, 2.0), 40.0)
_ALONE = 40.0
"""λ = 1, to rounding: only ‖Λξ‖ ≤ 1 is used."""
_NEIGHBOURS, _WIDTHS = np.array([-1.0, 0.0, 1.0]), np.array([1.5, 0.75, 0.37, 0.18, 0.09])
_AT_ONCE = 16
SHARES = np.array([
    (first, (1 - first) * (1 - last), (1 - first) * last)
    for first in (0.01, 0.03, 0.1, 0.3) for last in (0.1, 0.3, 0.5, 0.7, 0.9)
])  # fmt: skip
"""Of the three conditions that hold after the last node."""
_TAYLOR_TERMS = 4
ROUNDING = 1 + 1e-5
"""Exceeds the error of e^{Fτ}: measured below 1e-12 of its norm, which is up to 1e6; no proof."""
_NEAR, _RATIO, _MOST_NODES = (0.0, 0.5, 0.75, 1.0), 1.1, 80
"""First nodes of r in units of δ; then the ratio from node to node."""
_LATEST = 6.0
"""Largest r in units of δ at which events are looked for."""
_SOUGHT = 0.8
"""‖e^{(H+αI)r}‖_W at the last r, if possible."""
_NEARLY_PLAIN = 0.999
"""Share of the bound without the flow from which on nothing is gained."""
_NOTHING = 1e-3
"""Bound of ‖e_c‖ at a delivery, where it is 0, in β."""
_ROUNDS, _POWER, _LEAST_WEIGHT, _NEARLY = 40, 0.3, 1e-9, 0.97
_LATE_TERMS, _CONDITION = 8, 1e-10


class DeliveryFlow:
    """e^{Fτ} (ξ, 0) at the nodes of a grid, for a known plant; W is the identity."""

    def __init__(self, plant: PlantGains) -> None:
        error = plant.error
        self.weight, self.inverse = error.weight, error.inverse_weight
        self.n = len(error.H)
        self.closed_loop = self.turned(plant.closed_loop)
        self.BK = self.turned(plant.B @ error.K)
        self.H = self.turned(error.scaled_H)
        self.mismatch = E = self.closed_loop - self.H
        self.generator = np.block([[self.closed_loop, self.BK], [-E, self.H - self.BK]])
        self.start = self.weight @ plant.start
        self.stretch = float(error.kernels[Output.WEIGHTED].sup())
        fastest = max(float(np.abs(np.linalg.eigvals(self.generator)).max()), 1e-9)
        slowest, unstable = -spectral_abscissa(self.H), spectral_abscissa(self.generator)
        step_s, state = _FIRST_STEP / fastest, np.eye(2 * self.n)[:, : self.n]
        leap, t_s = exponential(self.generator * step_s), 0.0
        edges, states = [0.0], [state]
        for cell in range(1, _MOST_CELLS):
            t_s, state = t_s + step_s, leap @ state
            edges.append(t_s)
            states.append(state)
            if np.linalg.norm(state) > _MOST_GROWTH or math.exp(-slowest * t_s) < _SETTLED:
                break
            if cell % _CELLS_PER_STEP == 0 and 2 * step_s * unstable < _MOST_STEP:
                step_s, leap = 2 * step_s, leap @ leap
        self.edges_s, self.states = np.array(edges), np.array(states)

    def turned(self, matrix: Matrix) -> Matrix:
        """Return a matrix of the system in the coordinates W x."""
        return np.asarray(self.weight @ matrix @ self.inverse)


@dataclass(frozen=True)
class Starts:
    """The states ξ at a delivery with ‖Λ W ξ‖ ≤ 1."""

    flow: DeliveryFlow
    shape: Matrix
    """Λ, (n, n), invertible."""

    @cached_property
    def inverse(self) -> Matrix:
        """Λ⁻¹."""
        return np.asarray(np.linalg.inv(self.shape))

    @cached_property
    def axes(self) -> tuple[Vector, Stack]:
        """The singular values of N Λ⁻¹ at the left nodes, and Λ⁻¹ V."""
        _, singular, Vt = np.linalg.svd(self.flow.states[:-1, self.flow.n :] @ self.inverse)
        return singular, self.inverse @ Vt.transpose(0, 2, 1)

    @cached_property
    def followed(self) -> tuple[Matrix, Matrix, Vector]:
        """What bounds of z over the cells need, on the axes of their ellipsoids.

        e^{Fτ} at both nodes of each cell, Taylor's terms of F² e^{Fτ}, both as columns; and bounds
        of the terms' remainder.
        """
        flow, axes = self.flow, self.axes[1]
        F, steps_s = flow.generator, np.diff(flow.edges_s)
        ends = [flow.states[:-1] @ axes, flow.states[1:] @ axes]
        terms = [product(F @ F, ends[0])]
        for order in range(1, _TAYLOR_TERMS + 1):
            terms.append(product(F, terms[-1]) * (steps_s / order)[:, None, None])
        with np.errstate(over="ignore"):
            growth = np.exp(max(logarithmic_norm(F), 0.0) * steps_s)
        rest = growth[:, None] * np.linalg.norm(terms[-1], axis=1)
        return _columns(ends), _columns(terms[:-1]), rest

    @cached_property
    def itself(self) -> "_CellBounds":
        """Bounds of Λx."""
        return _CellBounds(self, np.hstack([self.shape, np.zeros_like(self.shape)]))

    @cached_property
    def first(self) -> int:
        """The first cell in which ‖Λx‖ might grow.

        ‖Λx‖ ≤ 1 cannot be left while ‖ΛBK e_c‖ is below the rate at which it contracts.
        """
        flow = self.flow
        rate = -logarithmic_norm(self.shape @ flow.closed_loop @ self.inverse)
        C = np.hstack([np.zeros_like(flow.BK), self.shape @ flow.BK])
        driven = _CellBounds(self, C).loose(1.0, np.array([_ALONE]))[:, 0]
        return int(np.argmax(np.append(driven, np.inf) * ROUNDING >= rate))

    @cached_property
    def late(self) -> tuple[Matrix, float]:
        """e^{FT'} for some T' before the last node, and a bound of ‖x + e_c‖ from then on."""
        flow, n = self.flow, self.flow.n
        node = int(flow.edges_s.searchsorted(5 / 6 * flow.edges_s[-1])) - 1
        since_s = float(flow.edges_s[-1] - flow.edges_s[node])
        x_c = flow.states[node, :n] + flow.states[node, n:]
        return np.asarray(exponential(flow.generator * since_s)), flow.stretch * float(
            np.linalg.norm(x_c @ self.inverse, 2)
        )

    def late_forms(self, limit: float) -> tuple[Stack, Matrix]:
        """Return three forms of (x + e_c, e_c), at most 1, and what makes z of it after T'.

        They follow from ‖x + e_c‖ ≤ h and ‖e_c‖ ≤ D, T' before, and ‖e_c‖ ≤ D now.
        """
        n = self.flow.n
        moved, h = self.late
        identity, none = np.eye(n), np.zeros((n, n))
        moved = moved @ np.block([[identity, -identity], [none, identity]])
        rows = [
            np.hstack([identity, none]) / h,
            np.hstack([none, identity]) / limit,
            moved[n:] / limit,
        ]
        return np.array([row.T @ row for row in rows]), moved


@dataclass(frozen=True)
class Reach:
    """What z can be at some time after a delivery: ‖ΛWξ‖ ≤ c at the delivery, ‖e_c‖_W ≤ D since."""

    starts: Starts
    size: float
    """c."""
    limit: float
    """D."""

    def sup(self, C: Matrix) -> float:
        """Bound ‖C z‖ at all times, for C of shape (q, 2n)."""
        return self._sup(C, _CellBounds(self.starts, C), 0)

    def is_invariant(self) -> bool:
        """Return whether ‖Λx‖ ≤ c at a delivery implies the same at all times until the next."""
        itself = self.starts.itself
        return self._sup(itself.C, itself, self.starts.first) <= self.size

    def _sup(self, C: Matrix, bounds: "_CellBounds", first: int) -> float:
        # All is in proportion to c, for D/c.
        limit = self.limit / self.size
        return self.size * max(bounds.sup(limit, first), self._afterwards(C, limit))

    def _afterwards(self, C: Matrix, limit: float) -> float:
        """Bound ‖C z‖ after the last node, for c = 1."""
        grams, moved = self.starts.late_forms(limit)
        values, V = np.linalg.eigh(np.tensordot(SHARES, grams, axes=1))
        usable = values[:, 0] > 1e-12 * values[:, -1]  # others are too flat for their rounding
        sizes = spectral_norms(C @ moved @ V[usable] / np.sqrt(values[usable])[:, None])
        largest = float(sizes.min(initial=math.inf)) * ROUNDING
        return largest if math.isfinite(largest) else math.inf


class _CellBounds:
    """Bounds of ‖C z‖ over each cell, for ‖Λξ‖ ≤ 1."""

    def __init__(self, starts: Starts, C: Matrix) -> None:
        self.C, self._singular = C, starts.axes[0]
        cells, n = self._singular.shape
        ends, terms, rest = starts.followed
        self._ends = (C @ ends).reshape(len(C), 2, cells, n)
        followed = (C @ terms).reshape(len(C), _TAYLOR_TERMS, cells, n)
        self._squares = np.concatenate(
            [
                np.einsum("qokj->kjo", self._ends**2),
                np.einsum("qokj->kjo", followed**2),
                (np.linalg.norm(C, 2) * rest)[..., None] ** 2,
            ],
            axis=2,
        )
        """(k, n, 7): of both ends, and of the terms that bound ‖C F² e^{Fτ}‖, for each axis."""
        self._sags_s2 = np.diff(starts.flow.edges_s) ** 2 / 8

    def sup(self, limit: float, first: int) -> float:
        """Bound ‖C z‖ over the cells from the given one on, for this D."""
        loose = self.loose(limit, _LOGITS)
        if not np.isfinite(loose).all():
            return math.inf
        highest, logits = loose.min(axis=1), _LOGITS[loose.argmin(axis=1)]
        highest[:first] = 0.0
        rounds = np.zeros(len(highest), dtype=np.int64)
        while True:  # the highest bounds become better, until that of the highest is settled
            cells = np.argsort(highest)[-_AT_ONCE:]
            if rounds[cells[-1]] == len(_WIDTHS):
                return float(highest[cells[-1]]) * ROUNDING
            cells = cells[rounds[cells] < len(_WIDTHS)]
            tried = logits[cells, None] + _WIDTHS[rounds[cells], None] * _NEIGHBOURS
            values = self._tight(limit, cells, tried)
            index = values.argmin(axis=1)
            logits[cells] = tried[np.arange(len(cells)), index]
            highest[cells] = np.minimum(highest[cells], values.min(axis=1))
            rounds[cells] += 1

    def loose(self, limit: float, logits: Vector) -> Stack:
        """Return bounds in the Frobenius norm, for every λ, (k, j)."""
        sizes = np.sqrt(_semi_axes(self._singular / limit, logits) ** 2 @ self._squares)
        return np.asarray(
            sizes[..., :2].max(axis=2) + self._sags_s2[:, None] * sizes[..., 2:].sum(axis=2)
        )

    def _tight(self, limit: float, cells: NDArray[np.int64], logits: Stack) -> Stack:
        """Return bounds in the spectral norm for some cells, each with its own λ, (k, j)."""
        ends, d = self._ends[:, :, cells], _semi_axes(self._singular[cells] / limit, logits)
        grams = np.einsum("qoki,qokj->koij", ends, ends)[:, None]
        scaled = grams * d[:, :, None, :, None] * d[:, :, None, None, :]
        sizes = largest_eigenvalues(scaled.reshape(-1, *scaled.shape[-2:])).clip(min=0.0)
        bends = np.sqrt(d**2 @ self._squares[cells, :, 2:]).sum(axis=2)
        ends = np.sqrt(sizes.reshape(scaled.shape[:-2])).max(axis=2)
        return np.asarray(ends + self._sags_s2[cells, None] * bends)


def _semi_axes(singular: Vector, logits: Vector) -> Stack:
    """Return those of the ellipsoids of cells with λ = 1/(1 + e^{−logit}), (k, j, n)."""
    share = 1 / (1 + np.exp(-logits))[..., None]
    return np.asarray(1 / np.sqrt(share + (1 - share) * singular[:, None] ** 2))


def _columns(stacks: list[Stack]) -> Matrix:
    """Return stacks of the same shape (k, 2n, n) side by side."""
    return np.asarray(np.concatenate(stacks).transpose(1, 0, 2).reshape(stacks[0].shape[1], -1))


def errors_after_losses(
    reach: Reach,
    plain: Vector,
    size: float,
    level: float,
    spacing_s: float,
    kernel: KernelBounds,
    bend: float,
) -> Vector:
    """Bound ‖e_c‖_W while at most 0, 1, … events have been lost since the delivery.

    Args:
        reach: the flow from a delivery; it is invariant.
        plain: bounds without the flow, for 0, 1, … events.
        size: bound of ‖e_s‖_W.
        level: ‖e_s‖_W at an event, at least.
        spacing_s: the least time between events.
        kernel: of ‖e^{(H+αI)τ}‖_W.
        bend: that of e_s, see :func:`bend_of_error`.
    """
    errors, since_s, flow = plain.copy(), 0.0, reach.starts.flow
    most_s = float(flow.edges_s[-1]) / 4  # e^{Fτ} is accurate until 4 times as late
    if spacing_s >= most_s or len(plain) == 1:
        return errors
    r_s = _nodes_s(spacing_s, kernel, 2 * most_s)
    flows = np.array([exponential(flow.generator * time_s) for time_s in r_s.tolist()])
    for lost in range(len(plain)):
        earlier = float(errors[lost - 1]) if lost else _NOTHING * size
        stage = _Stage(reach, min(since_s, most_s), earlier, r_s, flows)
        if lost:
            added = size + kernel.sups(r_s) * earlier
            largest = max(stage.largest_error(size, added), float(added[-1]), earlier)
            errors[lost] = min(plain[lost], largest)
            if lost > 1 and errors[lost] > _NEARLY_PLAIN * float(added[0]):
                break  # later stages gain nothing, either
        if lost + 1 < len(plain):
            since_s += max(spacing_s, stage.next_event_s(level, bend, _LATEST * spacing_s))
    return errors


def bend_of_error(reach: Reach, level: float) -> float:
    """Bound the second derivative of e_s while ‖e_s‖_W is below a level."""
    flow = reach.starts.flow
    n, F, H = flow.n, flow.generator, flow.H
    bend = reach.sup((F @ F)[n:] - np.hstack([np.zeros((n, n)), H @ H]))
    return bend + float(np.linalg.norm(H @ H, 2)) * level


def _nodes_s(spacing_s: float, kernel: KernelBounds, most_s: float) -> Vector:
    """Return times r, if possible up to one at which ‖e^{(H+αI)r}‖_W has fallen below a value."""
    nodes_s = [spacing_s * share for share in _NEAR]
    while len(nodes_s) < _MOST_NODES and kernel.sup(nodes_s[-1]) > _SOUGHT:
        nodes_s.append(nodes_s[-1] * _RATIO)
    return np.array([time_s for time_s in nodes_s if time_s <= most_s])


class _Stage:
    """What follows an event, a time w or more after the delivery, for times r since it."""

    def __init__(
        self, reach: Reach, window_s: float, earlier: float, r_s: Vector, flows: Stack
    ) -> None:
        self._flow, self._r_s, self._earlier = reach.starts.flow, r_s, earlier
        n, identity = self._flow.n, np.eye(2 * self._flow.n)
        half = exponential(self._flow.generator * window_s / 2)
        rows = [identity[n:] / earlier, half[n:] / earlier, (half @ half)[n:] / earlier]
        rows.append(reach.starts.shape @ identity[:n] / reach.size)
        forms = np.array([row.T @ row for row in rows])
        self._forms = np.broadcast_to(forms, (len(r_s), *forms.shape))
        self._z = flows @ half @ half
        # x + e_c follows the models: e^{Hr} is the sum of both rows of e^{Fr} (I, 0).
        models = flows[:, :n, :n] + flows[:, n:, :n]
        self._e_s = self._z[:, n:] - models @ (half @ half)[n:]

    def largest_error(self, size: float, added: Vector) -> float:
        """Bound ‖e_c‖_W up to the last r, given bounds without the flow for the nodes."""
        n = self._flow.n
        events = (self._e_s.swapaxes(1, 2) @ self._e_s)[:-1, None] / size**2
        forms = np.concatenate([self._forms[:-1], events], axis=1)
        ends, weights = _largest(forms, self._z[1:, n:], float(added[-1]))
        cells = np.maximum(ends, np.append(self._earlier, ends[:-1])) + self._sags(forms, weights)
        return float(np.minimum(cells, added[:-1]).max())

    def _sags(self, forms: Stack, weights: Stack) -> Vector:
        """Bound how much e_c differs from its chord in each cell of r."""
        F, steps_s = self._flow.generator, np.diff(self._r_s)[:, None, None]
        inverse = np.linalg.inv(np.einsum("ji,jiab->jab", weights, forms))
        terms, bends = F @ F @ self._z[:-1], np.zeros(len(steps_s))
        for order in range(1, _LATE_TERMS + 1):
            seen = terms[:, self._flow.n :]
            bends += np.sqrt(np.abs(np.einsum("jab,jbc,jac->j", seen, inverse, seen)))
            terms = F @ terms * (steps_s / order)
        with np.errstate(over="ignore"):
            growth = np.exp(max(float(logarithmic_norm(F)), 0.0) * steps_s[:, 0, 0])
        bends += growth * np.sqrt(np.abs(np.einsum("jab,jbc,jac->j", terms, inverse, terms)))
        return np.asarray(steps_s[:, 0, 0] ** 2 / 8 * bends * ROUNDING)

    def next_event_s(self, level: float, bend: float, most_s: float) -> float:
        """Return a time before which ‖e_s‖_W does not reach a level."""
        near = self._r_s <= most_s
        ends, _ = _largest(self._forms[near], self._e_s[near], 0.9 * level, all_of_them=True)
        sags = np.diff(self._r_s[near]) ** 2 / 8 * bend
        reached = np.maximum(ends[1:], ends[:-1]) + sags >= level
        return float(self._r_s[np.append(reached, True).argmax()])


def error_after(flow: DeliveryFlow, time_s: float) -> Matrix:
    """Return C_r: e_s a time after an event is C_r z."""
    rows = np.asarray(exponential(flow.generator * time_s)[flow.n :])
    rows[:, flow.n :] -= exponential(flow.H * time_s)
    return rows


def _largest(
    forms: Stack, Y: Stack, enough: float, *, all_of_them: bool = False
) -> tuple[Vector, Stack]:
    """Bound ‖Y z‖ for all z with forms of at most 1, (j,), by weights, (j, i).

    None below ``enough`` is improved, and only the largest ones unless all of them are wanted.
    """
    bounds, weights = np.full(len(forms), np.inf), np.full(forms.shape[:2], 1 / forms.shape[1])
    active, best = np.arange(len(forms)), weights.copy()
    for _ in range(_ROUNDS):
        some = forms[active]
        Z = np.linalg.solve(
            np.einsum("ji,jiab->jab", weights[active], some), Y[active].swapaxes(1, 2)
        )
        values, vectors = np.linalg.eigh(Y[active] @ Z)
        sizes = np.sqrt(values[:, -1].clip(min=0.0)) * ROUNDING
        better = sizes < bounds[active]
        best[active[better]] = weights[active[better]]
        bounds[active] = np.minimum(bounds[active], sizes)
        # The forms of the z with the largest ‖Y z‖: those above the mean need more weight.
        z = (Z @ vectors[:, :, -1:])[..., 0]
        sizes = np.einsum("ja,jiab,jb->ji", z, some, z)
        weights[active] *= (sizes / sizes.max(axis=1, keepdims=True).clip(min=1e-300)) ** _POWER
        weights = weights.clip(min=_LEAST_WEIGHT)
        weights /= weights.sum(axis=1, keepdims=True)
        least = enough if all_of_them else max(enough, _NEARLY * float(bounds.max()))
        active = np.flatnonzero(bounds > least)
        if not len(active):
            break
    sums = np.linalg.eigvalsh(np.einsum("ji,jiab->jab", best, forms))
    bounds[~(sums[:, 0] > _CONDITION * sums[:, -1])] = np.inf
    return bounds, best
