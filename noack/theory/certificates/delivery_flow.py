"""The flow between two deliveries: what x and e_c can be until the next one.

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
+ e_c = e^{Hτ} ξ has decayed, and z has followed the system for T' from a state with ‖e_c‖_W ≤ D and
‖Λx‖ ≤ 1.

Where bounds are largest, the conditions of several earlier times are used together. Up to the first
event after the start x is known, so if inputs are neither delayed nor held, the ellipsoid need only
contain x at the first delivery after it.

**Delayed and held inputs.** This is so if inputs are neither delayed nor held. Otherwise z begins
with an e_c that is not 0, and the age of inputs drives it; :class:`Disturbed` bounds both. What
they change is added to the bounds; the flow is followed until it is a share of D.

**After lost events.** Without the flow, each missing event adds its ‖e_s‖_W in full, as if all had
one direction. But until the next delivery everything follows from z at one time. Let an event be
lost at least w after the delivery, and ‖e_c‖_W ≤ D up to it. z is the value w before it, z' =
e^{Fw} z:

    ‖Λx‖ ≤ c and ‖e_c‖ ≤ D at z and z',  ‖e_s‖ = ‖C_r z'‖ ≤ β for r until the next event

With positive weights of sum 1, z is in the ellipsoid of the sum of these forms, which bounds e_c =
(0, I) e^{Fr} z' after r. The weights are improved step by step; all weights give a bound.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, Vector, exponential, spectral_abscissa
from noack.theory.bounds.contraction import (
    Stack,
    largest_eigenvalues,
    logarithmic_norm,
    product,
    spectral_norm,
    spectral_norms,
)
from noack.theory.bounds.enclosure import KernelBounds, response, response_until
from noack.theory.bounds.gains import Output, PlantGains

_CELLS_PER_STEP, _FIRST_STEP, _MOST_STEP = 32, 0.005, 0.02
_MOST_GROWTH, _SETTLED, _MOST_CELLS = 1e6, 0.03, 3000
_LOGITS = np.append(np.arange(-12.0, 13.0, 2.0), 40.0)
_ALONE = 40.0
"""λ = 1, to rounding: only ‖Λξ‖ ≤ 1 is used."""
_NEIGHBOURS, _WIDTHS = np.array([-1.0, 0.0, 1.0]), np.array([1.5, 0.75, 0.37, 0.18, 0.09])
_AT_ONCE, _MOST_JOINT = 16, 3
_SHARES = np.array(
    [
        (first, (1 - first) * (1 - last), (1 - first) * last, 0.0)
        for first in (0.01, 0.03, 0.1, 0.3)
        for last in (0.1, 0.3, 0.5, 0.7, 0.9)
    ]
    + [
        (0.0, (1 - of_x) * (1 - last), (1 - of_x) * last, of_x)
        for of_x in (0.5, 0.7, 0.8, 0.87, 0.92, 0.95, 0.97, 0.985)
        for last in (0.4, 0.55, 0.7)
    ]
)
"""Of ‖x_c‖, of ‖e_c‖ at both ends, and of ‖Λx‖, after the last node: the first to be tried."""
_WINDOWS = (1 / 6, 1 / 3, 2 / 3, 0.9, 1.0)
"""T' as shares of the last node."""
_EARLIER = 8
"""Earlier times whose conditions are used together."""
_FOUR = [0, 1, 2 * _EARLIER + 1, 2]
_OTHERS = 0.1
"""Their share at first, beside the best two."""
_HALVINGS = 12
_TAYLOR_TERMS = 4
ROUNDING = 1 + 1e-5
"""Exceeds the error of e^{Fτ}: measured below 1e-12 of its norm, which is up to 1e6; no proof."""
_NEAR, _RATIO, _MOST_NODES = np.linspace(0.0, 1.0, 20).tolist(), 1.03, 300
"""First nodes of r in units of δ; then the ratio from node to node."""
_LATEST = 6.0
"""Largest r in units of δ at which events are looked for."""
_SOUGHT = 0.6
"""‖e^{(H+αI)r}‖_W at the last r, if possible."""
_NEARLY_PLAIN = 0.999
"""Share of the bound without the flow from which on nothing is gained."""
_NOTHING = 1e-3
"""Bound of ‖e_c‖ at a delivery, where it is 0, in β."""
_ROUNDS, _POWER, _LEAST_WEIGHT, _NEARLY = 40, 0.3, 1e-9, 0.97
_LATE_TERMS, _CONDITION = 8, 1e-10


class Disturbed(NamedTuple):
    """How much inputs that are held and late change the flow from the moment an update acts."""

    held: float = 0.0
    """Bound of ‖q‖, p = K e_c + q."""
    late: float = 0.0
    """Bound of ‖e_c‖_W when an update acts."""
    late_s: float = 0.0
    """The largest time from an event until its update acts."""

    @property
    def is_none(self) -> bool:
        """Whether they change nothing."""
        return self.held == 0 and self.late == 0

    def sizes(self, disturbed: tuple[Vector, Vector]) -> Vector:
        """Return by how much an output can differ, over each cell, (k,)."""
        late, pushed = disturbed
        return self.late * late + self.held * pushed


UNDISTURBED = Disturbed()
"""Inputs are neither delayed nor held."""


class DeliveryFlow:
    """e^{Fτ} (ξ, 0) at the nodes of a grid, for a known plant; W is the identity."""

    def __init__(self, plant: PlantGains) -> None:
        self.error = error = plant.error
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
        step_s, state = _FIRST_STEP / fastest, np.eye(2 * self.n)
        leap, t_s = exponential(self.generator * step_s), 0.0
        edges, states = [0.0], [state]
        for cell in range(1, _MOST_CELLS):
            t_s, state = t_s + step_s, leap @ state
            edges.append(t_s)
            states.append(state)
            grown = np.linalg.norm(state[:, : self.n])
            if grown > _MOST_GROWTH or math.exp(-slowest * t_s) < _SETTLED:
                break
            if cell % _CELLS_PER_STEP == 0 and 2 * step_s * unstable < _MOST_STEP:
                step_s, leap = 2 * step_s, leap @ leap
        self.edges_s, self._propagators = np.array(edges), np.array(states)
        self.states = np.ascontiguousarray(self._propagators[:, :, : self.n])
        self.input_error = self.weight @ plant.input_matrix
        self.gain = error.split_K[1] @ self.inverse

    @cached_property
    def begun(self) -> tuple[Matrix, Vector]:
        """e^{Fτ} (x(0), 0) at the nodes, (k + 1, 2n), and bounds of its second derivative, (k,)."""
        z, steps_s, F = self.states @ self.start[:, 0], np.diff(self.edges_s), self.generator
        term, bends = z[:-1] @ (F @ F).T, np.zeros(len(steps_s))
        for order in range(1, _TAYLOR_TERMS + 1):
            bends += np.linalg.norm(term, axis=1)
            term = term @ F.T * (steps_s / order)[:, None]
        with np.errstate(over="ignore"):
            growth = np.exp(max(logarithmic_norm(F), 0.0) * steps_s)
        return z, bends + growth * np.linalg.norm(term, axis=1)

    def from_start(self, C: Matrix, limit: float, first: int = 0) -> float:
        """Bound ‖C z‖ from a cell after the start on, until the first delivery, if ‖e_c‖_W ≤ D.

        z is at most as large as that of x(0), and small enough for D at all earlier times.
        """
        z, bends = self.begun
        errors = np.maximum.accumulate(np.linalg.norm(z[:-1, self.n :], axis=1))
        shares = limit / np.maximum(errors, limit)
        sizes = np.linalg.norm(z @ C.T, axis=1)
        sags = np.diff(self.edges_s) ** 2 / 8 * bends * float(np.linalg.norm(C, 2))
        cells = shares * (np.maximum(sizes[1:], sizes[:-1]) + sags)
        return float(cells[first:].max()) * ROUNDING

    def first_event(self, level: float) -> int:
        """Return the first cell in which ‖e_s‖_W can reach a level after the start."""
        z, bends = self.begun
        sizes = np.linalg.norm(z[:, self.n :], axis=1)
        highest = np.maximum(sizes[1:], sizes[:-1]) + np.diff(self.edges_s) ** 2 / 8 * bends
        return int(np.argmax(np.append(highest[:-1] * ROUNDING >= level, True)))

    def cell_at(self, time_s: float) -> int:
        """Return the cell that contains a time."""
        return max(int(self.edges_s[1:-1].searchsorted(time_s)), 0)

    @cached_property
    def _entered(self) -> tuple[Stack, Stack, Vector]:
        """e^{Fτ} (0, I) and e^{Fτ} (BU, −BU) at the nodes, and step²/8 · ‖F‖² e^{‖F‖ step}."""
        pushed = self._propagators @ np.vstack([self.input_error, -self.input_error])
        turns = np.diff(self.edges_s) * float(np.linalg.norm(self.generator, 2))
        return self._propagators[:, :, self.n :], pushed, turns**2 / 8 * np.exp(turns)

    def disturbed(self, C: Matrix) -> tuple[Vector, Vector]:
        """Bound sup ‖C e^{Fτ} (0, I)‖ over each cell, and ∫₀^τ ‖C e^{Fs} (BU, −BU)‖ ds, (k,)."""
        late, pushed, bends = self._entered
        size, found = float(np.linalg.norm(C, 2)), []
        for stack in (late, pushed):
            ends = spectral_norms(C @ stack)
            sags = bends * size * np.linalg.norm(stack[:-1], axis=(1, 2))
            found.append((np.maximum(ends[1:], ends[:-1]) + sags) * ROUNDING)
        return found[0], np.cumsum(found[1] * np.diff(self.edges_s))

    @cached_property
    def of_error(self) -> tuple[Vector, Vector]:
        """The same for C = (0, I)."""
        return self.disturbed(np.eye(2 * self.n)[self.n :])

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
    def model_sups(self) -> Mapping[Output, float]:
        """The largest ‖C e^{(H+αI)τ} ξ‖ for all τ and all these ξ, of every output C of e_c."""
        error = self.flow.error
        followed = response(error.scaled_H, error.inverse_weight @ self.inverse)
        return {C: float(k.sup()) for C, k in followed.through_each(error.stacked).items()}

    @cached_property
    def driven(self) -> tuple[float, Vector, "_CellBounds"]:
        """The largest ‖p‖ that does not drive ‖Λx‖ beyond 1, ‖K e_c‖ over the cells, its bounds.

        On ‖y‖ = 1, y = Λx, d‖y‖/dt ≤ yᵀSy + yᵀΛBU p, and yᵀΛBU p ≤ ‖p‖ (γ/2 + ‖(ΛBU)ᵀy‖²/2γ).
        """
        flow = self.flow
        S = self.shape @ flow.closed_loop @ self.inverse
        pushed = self.shape @ flow.input_error
        squares, largest = pushed @ pushed.T / 2, 0.0
        size = float(np.linalg.norm(pushed, 2))
        for gamma in size * np.exp(np.linspace(-4.0, 0.0, 17)) if size else ():
            low, high = 0.0, -2 * float(logarithmic_norm(S)) / gamma
            for _ in range(_HALVINGS if high > 0 else 0):
                middle = (low + high) / 2
                grown = float(logarithmic_norm(S + middle / gamma * squares)) + middle * gamma / 2
                low, high = (middle, high) if grown < 0 else (low, middle)
            largest = max(largest, low)
        bounds = _CellBounds(self, np.hstack([np.zeros_like(flow.gain), flow.gain]))
        return largest, bounds.loose(np.ones(1), np.array([_ALONE]))[:, 0], bounds


@dataclass(frozen=True)
class Reach:
    """What z can be at some time after a delivery: ‖ΛWξ‖ ≤ c at the delivery, ‖e_c‖_W ≤ D since."""

    starts: Starts
    size: float
    """c."""
    limit: float
    """D."""
    by: Disturbed = UNDISTURBED
    followed: float = 1.0
    """e_c is followed until delay and hold may have changed it by this share of D."""
    first: int = 0
    """‖ΛWξ‖ ≤ c from this cell after the start on; before, x is that of the start."""

    def sup(self, C: Matrix) -> float:
        """Bound ‖C z‖ at all times, for C of shape (q, 2n)."""
        return max(self._sup(_CellBounds(self.starts, C), 0), self._from_start(C))

    def sup_state(self, C: Matrix) -> float:
        """Bound ‖C W x‖ at all times, for C of shape (q, n)."""
        size = self.size * float(spectral_norm(C @ self.starts.inverse)) * ROUNDING
        return max(size, self._from_start(np.hstack([C, np.zeros_like(C)])))

    def _from_start(self, C: Matrix) -> float:
        return self.starts.flow.from_start(C, self.limit) if self.first else 0.0

    def largest(self, since_s: float = 0.0) -> float:
        """Bound ‖ΛWx‖ from a time after the start on."""
        if not self.first:
            return self.size
        flow, C = self.starts.flow, self.starts.itself.C
        return max(self.size, flow.from_start(C, self.limit, flow.cell_at(since_s)))

    def is_invariant(self) -> bool:
        """Return whether ‖Λx‖ ≤ c at a delivery implies the same at all times until the next.

        It cannot be left while ‖K e_c + q‖ is below :attr:`Starts.driven`.
        """
        largest, driven, bounds = self.starts.driven
        driven = driven + (self._changes(bounds) + self.by.held) / self.size
        first = int(np.argmax(np.append(driven, np.inf) * ROUNDING >= largest))
        return self._sup(self.starts.itself, first) <= self.size

    def _changes(self, bounds: "_CellBounds") -> Vector:
        """Bound what delay and hold change of C z over the cells, (k,)."""
        return self.by.sizes(bounds.disturbed) if not self.by.is_none else np.zeros(bounds.cells)

    @cached_property
    def _errors(self) -> Vector:
        """The same of e_c."""
        flow = self.starts.flow
        return self.by.sizes(flow.of_error) if not self.by.is_none else np.zeros(len(flow.edges_s) - 1)

    @cached_property
    def _levels(self) -> Vector:
        """Bounds of ‖ΛWx‖ over the cells, for c = 1."""
        return 1 + self._changes(self.starts.itself) / self.size

    @cached_property
    def _cells(self) -> int:
        """The cells that are followed."""
        return int(np.argmax(np.append(self._errors, np.inf) > self.followed * self.limit))

    def _sup(self, bounds: "_CellBounds", first: int) -> float:
        # All is in proportion to c, for D/c.
        limits, changes = self.limit + self._errors, self._changes(bounds)
        cells = slice(first, self._cells)
        after = self._afterwards(bounds)
        near = bounds.sup(limits / self.size, self._levels, changes / self.size, cells, after)
        return float(self.size * max(near, after))

    def _afterwards(self, bounds: "_CellBounds") -> float:
        """Bound ‖C z‖ after the last node that is followed, for c = 1."""
        changes = np.zeros(bounds.cells)
        if not self.by.is_none:
            held = self.by._replace(late=0.0)
            changes = held.sizes(bounds.disturbed)
        found = []
        for cell, moved, forms, roots in self._windows:
            sizes = spectral_norms(bounds.C @ moved @ roots)
            begin = np.full((1, len(forms)), _OTHERS / len(forms))
            begin[0, _FOUR] += (1 - _OTHERS) * _SHARES[int(sizes.argmin())]
            largest, _ = _largest(forms[None], (bounds.C @ moved)[None], 0.0, begin)
            size = min(float(sizes.min()) * ROUNDING, float(largest[0]))
            found.append(size + float(changes[cell]) / self.size)
        return min(found)

    @cached_property
    def _windows(self) -> list[tuple[int, Matrix, Stack, Stack]]:
        """What holds of z a time T' ago, after the last node that is followed, for each T'.

        T' as a cell, the flow in it, forms that are at most 1, all for c = 1 and in (x_c, e_c):
        ‖x_c‖ ≤ h, and ‖e_c‖ ≤ D and ‖Λx‖ ≤ 1 at several times; semi-axes for some of their sums.
        """
        flow, n, shape, found = self.starts.flow, self.starts.flow.n, self.starts.shape, []
        last_s, limit, identity = float(flow.edges_s[self._cells]), self.limit / self.size, np.eye(n)
        errors = np.zeros(len(flow.edges_s) - 1)
        levels = np.ones(len(errors))
        if not self.by.is_none:
            held = self.by._replace(late=0.0)
            errors = held.sizes(flow.of_error) / self.size
            levels = levels + held.sizes(self.starts.itself.disturbed) / self.size
        for share in _WINDOWS:
            node = max(int(flow.edges_s.searchsorted(last_s - share * last_s)) - 1, 0)
            since_s = last_s - float(flow.edges_s[node])
            x_c = flow.states[node, :n] + flow.states[node, n:]
            h = float(np.linalg.norm(x_c @ self.starts.inverse, 2))
            h = h + float(np.linalg.norm(x_c, 2)) * self.by.late / self.size
            if self.first:
                h = max(h, float(np.linalg.norm(x_c @ flow.start)) / self.size)
            level = 1.0 if node >= self.first else self.largest() / self.size
            rows = [np.hstack([identity, np.zeros((n, n))]) / (flow.stretch * h)]
            moved = np.block([[identity, -identity], [np.zeros((n, n)), identity]])
            step = exponential(flow.generator * (since_s / _EARLIER))
            for number in range(_EARLIER + 1):
                cell = flow.cell_at(number * since_s / _EARLIER) if number else 0
                added = (errors[cell], levels[cell] - 1) if number else (0.0, 0.0)
                rows.append(moved[n:] / (limit + added[0]))
                if number < _EARLIER:
                    rows.append(shape @ moved[:n] / (level + added[1]))
                    moved = step @ moved
            turn = _balancing(np.array(rows)[None])[0]
            turned = np.array(rows) @ turn
            forms = turned.swapaxes(-1, -2) @ turned
            values, V = np.linalg.eigh(np.tensordot(_SHARES, forms[_FOUR], axes=1))
            usable = values[:, :1] > _CONDITION * values[:, -1:]  # others are too flat
            roots = V / np.sqrt(np.where(usable, values, _CONDITION))[:, None]
            found.append((flow.cell_at(since_s), moved @ turn, forms, roots))
        return found


class _CellBounds:
    """Bounds of ‖C z‖ over each cell, for ‖Λξ‖ ≤ 1."""

    def __init__(self, starts: Starts, C: Matrix) -> None:
        self.C, self._singular, self._flow, self._starts = C, starts.axes[0], starts.flow, starts
        self.cells, n = self._singular.shape
        cells = self.cells
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

    @cached_property
    def disturbed(self) -> tuple[Vector, Vector]:
        """See :meth:`DeliveryFlow.disturbed`."""
        return self._flow.disturbed(self.C)

    def sup(self, limits: Vector, levels: Vector, added: Vector, followed: slice, enough: float) -> float:
        """Bound ‖C z‖ over some cells, given D and ‖Λx‖ for each, with what is added to each, (k,).

        A bound below ``enough`` is not improved.
        """
        loose = self.loose(limits, _LOGITS)
        if not np.isfinite(loose).all():
            return math.inf
        highest, logits = loose.min(axis=1) + added, _LOGITS[loose.argmin(axis=1)]
        highest[: followed.start] = 0.0
        highest[followed.stop :] = 0.0
        rounds, joint = np.zeros(len(highest), dtype=np.int64), 0
        while True:  # the highest bounds become better, until that of the highest is settled
            cells = np.argsort(highest)[-_AT_ONCE:]
            is_last = rounds[cells[-1]] > len(_WIDTHS) or joint == _MOST_JOINT
            if is_last or highest[cells[-1]] * ROUNDING <= enough:
                return float(highest[cells[-1]]) * ROUNDING
            settled = cells[rounds[cells] == len(_WIDTHS)]
            if len(settled):
                values = self._joint(limits, levels, settled, logits[settled, None])
                highest[settled] = np.minimum(highest[settled], values + added[settled])
                rounds[settled], joint = rounds[settled] + 1, joint + 1
                continue
            cells = cells[rounds[cells] < len(_WIDTHS)]
            tried = logits[cells, None] + _WIDTHS[rounds[cells], None] * _NEIGHBOURS
            values = self._tight(limits, cells, tried)
            index = values.argmin(axis=1)
            logits[cells] = tried[np.arange(len(cells)), index]
            highest[cells] = np.minimum(highest[cells], values.min(axis=1) + added[cells])
            rounds[cells] += 1

    def loose(self, limits: Vector, logits: Vector) -> Stack:
        """Return bounds in the Frobenius norm, for every λ, (k, j)."""
        singular = self._singular / limits[:, None]
        sizes = np.sqrt(_semi_axes(singular, logits) ** 2 @ self._squares)
        return np.asarray(sizes[..., :2].max(axis=2) + self._sags_s2[:, None] * sizes[..., 2:].sum(axis=2))

    def _tight(self, limits: Vector, cells: NDArray[np.int64], logits: Stack) -> Stack:
        """Return bounds in the spectral norm for some cells, each with its own λ, (k, j)."""
        ends, d = (
            self._ends[:, :, cells],
            _semi_axes(self._singular[cells] / limits[cells, None], logits),
        )
        grams = np.einsum("qoki,qokj->koij", ends, ends)[:, None]
        scaled = grams * d[:, :, None, :, None] * d[:, :, None, None, :]
        sizes = largest_eigenvalues(scaled.reshape(-1, *scaled.shape[-2:])).clip(min=0.0)
        bends = np.sqrt(d**2 @ self._squares[cells, :, 2:]).sum(axis=2)
        ends = np.sqrt(sizes.reshape(scaled.shape[:-2])).max(axis=2)
        return np.asarray(ends + self._sags_s2[cells, None] * bends)

    def _joint(self, limits: Vector, levels: Vector, cells: NDArray[np.int64], logits: Stack) -> Vector:
        """Return bounds by all conditions at several earlier nodes, (k,); the bends are as above."""
        flow, n = self._flow, self._flow.n
        times_s = flow.edges_s[cells, None] * (np.arange(1, _EARLIER + 1) / _EARLIER)
        nodes = np.minimum(flow.edges_s.searchsorted(times_s, side="right") - 1, cells[:, None])
        states, shape = flow.states[nodes], self._starts.shape
        rows = np.concatenate(
            [
                np.broadcast_to(shape, (len(cells), 1, n, n)),
                states[:, :, n:] / limits[nodes][..., None, None],
                shape @ states[:, :, :n] / levels[nodes][..., None, None],
            ],
            axis=1,
        )
        share = 1 / (1 + np.exp(-logits[:, 0]))
        begin = np.full(rows.shape[:2], _OTHERS / rows.shape[1])
        begin[:, 0] += (1 - _OTHERS) * share
        begin[:, _EARLIER] += (1 - _OTHERS) * (1 - share)
        turn = _balancing(rows * np.sqrt(begin)[..., None, None])
        rows = rows @ turn[:, None]
        forms = rows.swapaxes(-1, -2) @ rows
        ends = self.C @ np.array([flow.states[cells], flow.states[cells + 1]]) @ turn
        bounds, weights = _largest(forms, ends[1], 0.0, begin, all_of_them=True)
        inverse = np.linalg.inv(np.einsum("ji,jiab->jab", weights, forms))
        sizes = np.linalg.eigvalsh(ends @ inverse @ ends.swapaxes(-1, -2))[..., -1].max(axis=0)
        sizes = np.where(np.isfinite(bounds), sizes.clip(min=0.0), np.inf)
        d = _semi_axes(self._singular[cells] / limits[cells, None], logits)
        bends = np.sqrt(d**2 @ self._squares[cells, :, 2:]).sum(axis=2)[:, 0]
        return np.asarray(np.sqrt(sizes) + self._sags_s2[cells] * bends)


def _semi_axes(singular: Vector, logits: Vector) -> Stack:
    """Return those of the ellipsoids of cells with λ = 1/(1 + e^{−logit}), (k, j, n)."""
    share = 1 / (1 + np.exp(-logits))[..., None]
    return np.asarray(1 / np.sqrt(share + (1 - share) * singular[:, None] ** 2))


def _columns(stacks: list[Stack]) -> Matrix:
    """Return stacks of the same shape (k, 2n, n) side by side."""
    return np.asarray(np.concatenate(stacks).transpose(1, 0, 2).reshape(stacks[0].shape[1], -1))


class SensorErrors(NamedTuple):
    """What is known of ‖e_s‖_W between two events."""

    sizes: Vector
    """Its bounds, while 0, 1, … events have been lost since the delivery."""
    tested: float
    """Its bound after a test; infinite if there is none."""
    begin_s: float
    """The first test is that long after an event."""
    grid_s: float
    """Tests are multiples of this after an event; 0 if the trigger is tested at all times."""
    level: float
    """At an event it, or what is compared, is at least this large; 0 if nothing is known."""
    integrates: bool
    """Whether its integral since the event is compared."""
    forced_s: float
    """So long after an event the next one may be due without any of this."""


def errors_after_losses(
    reach: Reach,
    plain: Vector,
    known: SensorErrors,
    outputs: Sequence[Matrix],
    spacing_s: float,
    kernel: KernelBounds,
    bend: float,
) -> tuple[Vector, float]:
    """Bound ‖e_c‖_W while at most 0, 1, … events have been lost since the delivery.

    Args:
        reach: the flow from a delivery; it is invariant.
        plain: bounds without the flow, for 0, 1, … events.
        known: bounds of e_s.
        outputs: matrices Y with ‖Y z‖ ≤ 1 at all times.
        spacing_s: the least time between events.
        kernel: of ‖e^{(H+αI)τ}‖_W.
        bend: that of e_s, see :func:`bend_of_error`.

    Returns:
        The bounds, and a time between events that is at least ``spacing_s``.
    """
    errors, since_s, flow, size_of_x = plain.copy(), -reach.by.late_s, reach.starts.flow, reach.size
    first_s = float(flow.edges_s[reach.first]) if reach.first else math.inf
    most_s = float(flow.edges_s[-1]) / 4  # e^{Fτ} is accurate until 4 times as late
    if spacing_s >= most_s or len(plain) == 1:
        return errors, spacing_s
    r_s, apart_s = _nodes_s(spacing_s, kernel, 2 * most_s, known.grid_s), math.inf
    flows = np.array([exponential(flow.generator * time_s) for time_s in r_s.tolist()])
    tested = np.where(r_s * ROUNDING >= known.begin_s, known.tested, math.inf)
    for lost, size in enumerate(known.sizes.tolist()):
        earlier = float(errors[lost - 1]) if lost else max(_NOTHING * size, reach.by.late)
        window_s = min(max(since_s, 0.0), most_s)
        stage = _Stage(reach, window_s, earlier, size_of_x, outputs, r_s, flows)
        if lost:
            added = size + kernel.sups(r_s) * earlier
            largest = stage.largest_error(np.minimum(tested, size), added)
            errors[lost] = min(plain[lost], max(largest, float(added[-1]), earlier))
            if lost > 1 and errors[lost] > _NEARLY_PLAIN * float(added[0]):
                return errors, spacing_s  # later stages gain nothing, either
        # After a delivery e_s is at most ‖e^{(H+αI)r}‖ · late larger than C_r z.
        more = 0.0 if lost else flow.stretch * reach.by.late
        later_s = stage.next_event_s(known, more, bend, min(_LATEST * spacing_s, known.forced_s))
        since_s += max(spacing_s, later_s)
        if not lost:  # x(0) itself may be outside the ellipsoid
            since_s, later_s = min(since_s, first_s), min(later_s, first_s)
            size_of_x = reach.largest(first_s - since_s)
        apart_s = min(apart_s, max(spacing_s, later_s))
    return errors, apart_s


def bend_of_error(reach: Reach, level: float) -> float:
    """Bound the second derivative of e_s while ‖e_s‖_W is below a level."""
    flow = reach.starts.flow
    return reach.sup(bend_rows(flow)) + float(np.linalg.norm(flow.H @ flow.H, 2)) * level


def bend_rows(flow: DeliveryFlow) -> Matrix:
    """Return the matrix of the part of e_s'' that follows from z."""
    n, F, H = flow.n, flow.generator, flow.H
    return np.asarray((F @ F)[n:] - np.hstack([np.zeros((n, n)), H @ H]))


def _nodes_s(spacing_s: float, kernel: KernelBounds, most_s: float, grid_s: float) -> Vector:
    """Return times r, if possible up to one at which ‖e^{(H+αI)r}‖_W has fallen below a value."""
    nodes_s = [spacing_s * share for share in _NEAR]
    while len(nodes_s) < _MOST_NODES and kernel.sup(nodes_s[-1]) > _SOUGHT:
        nodes_s.append(nodes_s[-1] * _RATIO)
    found_s = np.array([time_s for time_s in nodes_s if time_s <= most_s])
    return grid_s * np.unique(np.rint(found_s / grid_s)) if grid_s else found_s


class _Stage:
    """What follows an event, a time w or more after the delivery, for times r since it.

    z is e^{Fw} ζ at the event. What q has changed since some time before is bounded with e^{−Fs} (BU, −BU).
    """

    def __init__(
        self,
        reach: Reach,
        window_s: float,
        earlier: float,
        size_of_x: float,
        outputs: Sequence[Matrix],
        r_s: Vector,
        flows: Stack,
    ) -> None:
        self._flow, self._r_s, self._earlier = reach.starts.flow, r_s, earlier
        self._held, self._late_s = reach.by.held, reach.by.late_s
        n, shape, identity = self._flow.n, reach.starts.shape, np.eye(2 * self._flow.n)
        event = exponential(self._flow.generator * window_s)
        pushed = self._flow.of_error[1][[self._flow.cell_at(time_s) for time_s in r_s.tolist()]]
        self._later = self._held * pushed if self._held else np.zeros(len(r_s))
        error, of_x = (self._held * self._pushed_back(C, window_s) for C in (identity[n:, n:], shape))
        rows = [
            identity[n:] / (earlier + error),
            shape @ identity[:n] / (size_of_x + of_x),
            event[n:] / earlier,
            shape @ event[:n] / size_of_x,
            *(Y @ event for Y in outputs),
        ]
        forms = np.array([row.T @ row for row in rows])
        self._forms = np.broadcast_to(forms, (len(r_s), *forms.shape))
        self._z = flows @ event
        # x + e_c follows the models: e^{Hr} is the sum of both rows of e^{Fr} (I, 0).
        models = flows[:, :n, :n] + flows[:, n:, :n]
        self._e_s = self._z[:, n:] - models @ event[n:]

    def _pushed_back(self, C: Matrix, ago_s: float) -> float:
        """Bound ∫ ‖C e^{−As} BU‖ ds over some time; (I, 0) e^{−Fs} (BU, −BU) = e^{−As} BU."""
        if not (self._held and ago_s):
            return 0.0
        flow = self._flow
        followed = response_until(flow.BK - flow.closed_loop, flow.input_error, ago_s)
        return float(followed.through(C).integral_on_grid())

    def largest_error(self, sizes: Vector, added: Vector) -> float:
        """Bound ‖e_c‖_W up to the last r, given those of e_s, and bounds without the flow."""
        n, sizes = self._flow.n, (sizes + self._later)[:-1, None, None] ** 2
        events = (self._e_s.swapaxes(1, 2) @ self._e_s)[:-1] / sizes
        forms = np.concatenate([self._forms[:-1], events[:, None]], axis=1)
        used = added[:-1] - self._later[1:]
        ends, weights = _largest(forms, self._z[1:, n:], float(added[-1]), used=used)
        cells = np.maximum(ends, np.append(self._earlier, ends[:-1])) + self._sags(forms, weights)
        return float(np.minimum(cells + self._later[1:], added[:-1]).max())

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

    def next_event_s(self, known: SensorErrors, more: float, bend: float, most_s: float) -> float:
        """Return a time before which there is no event; e_s may be larger than C_r z by ``more``."""
        near, flow, level = self._r_s <= most_s, self._flow, known.level
        level -= more * self._late_s if known.integrates else more
        if level <= 0:
            return 0.0
        if self._held:  # what is followed differs from e_s
            pushed = flow.disturbed(bend_rows(flow))[1][flow.cell_at(most_s)]
            differs = float(np.linalg.norm(flow.H @ flow.H, 2)) * float(self._later.max())
            bend = bend + self._held * float(pushed) + differs
        enough = 0.0 if known.integrates else 0.9 * level
        ends, _ = _largest(self._forms[near], self._e_s[near], enough, all_of_them=True)
        steps_s = np.diff(self._r_s[near])
        cells = np.maximum(ends[1:], ends[:-1]) + steps_s**2 / 8 * bend + self._later[1:][near[1:]]
        if known.integrates:
            cells = np.cumsum(steps_s * (np.maximum.accumulate(cells) + more))
        found_s = float(self._r_s[np.append(cells >= level, True).argmax()])
        # Tests may lie beside the nodes if times are not those since an event.
        return max(found_s - known.grid_s, 0.0) if more and known.integrates else found_s


def _balancing(rows: Stack) -> Stack:
    """Return coordinates in which the sum of the squares of rows is the identity, (j, m, m).

    ``rows`` is (j, i, q, m). The squares themselves may be too different for their rounding.
    """
    together = rows.reshape(len(rows), -1, rows.shape[-1])
    return np.asarray(np.linalg.inv(np.linalg.qr(together, mode="r")))


def error_after(flow: DeliveryFlow, time_s: float) -> Matrix:
    """Return C_r: e_s a time after an event is C_r z."""
    rows = np.asarray(exponential(flow.generator * time_s)[flow.n :])
    rows[:, flow.n :] -= exponential(flow.H * time_s)
    return rows


def _largest(
    forms: Stack,
    Y: Stack,
    enough: float,
    begin: Stack | None = None,
    *,
    all_of_them: bool = False,
    used: Vector | float = math.inf,
) -> tuple[Vector, Stack]:
    """Bound ‖Y z‖ for all z with forms of at most 1, (j,), by weights, (j, i), from some on.

    None below ``enough`` is improved, and only the largest ones unless all of them are wanted.
    Bounds above ``used`` count as that.
    """
    bounds = np.full(len(forms), np.inf)
    weights = np.full(forms.shape[:2], 1 / forms.shape[1]) if begin is None else begin
    active, best = np.arange(len(forms)), weights.copy()
    for _ in range(_ROUNDS):
        some = forms[active]
        Z = np.linalg.solve(np.einsum("ji,jiab->jab", weights[active], some), Y[active].swapaxes(1, 2))
        values, vectors = np.linalg.eigh(Y[active] @ Z)
        sizes = np.sqrt(values[:, -1].clip(min=0.0)) * ROUNDING
        better = sizes < bounds[active]
        best[active[better]] = weights[active[better]]
        bounds[active] = np.minimum(bounds[active], sizes)
        # The forms of the z with the largest ‖Y z‖: those above the mean need more weight.
        z = (Z @ vectors[:, :, -1:])[..., 0]
        sizes = np.einsum("ja,jiab,jb->ji", z, some, z).clip(min=0.0)
        weights[active] *= (sizes / sizes.max(axis=1, keepdims=True).clip(min=1e-300)) ** _POWER
        weights = weights.clip(min=_LEAST_WEIGHT)
        weights /= weights.sum(axis=1, keepdims=True)
        sizes = np.minimum(bounds, used)
        least = enough if all_of_them else max(enough, _NEARLY * float(sizes.max()))
        active = np.flatnonzero(sizes > least)
        if not len(active):
            break
    sums = np.linalg.eigvalsh(np.einsum("ji,jiab->jab", best, forms))
    bounds[~(sums[:, 0] > _CONDITION * sums[:, -1])] = np.inf
    return bounds, best
