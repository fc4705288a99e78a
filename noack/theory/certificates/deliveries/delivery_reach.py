"""Bounds of x and e_c after a delivery, for all states ξ of an ellipsoid.

All that is uncertain of the flow (``delivery_flow.py``) is ξ, and the time of the next delivery.
States and errors are in its coordinates, in which ‖·‖_W is ‖·‖. Let ‖Λξ‖ ≤ 1 and ‖e_c‖ ≤ D at all
times. At the time τ, ξ has ‖Λξ‖ ≤ 1 and ‖Nξ‖ ≤ D, N the rows of e_c in e^{Fs} (I, 0) for an s ≤ τ.
So ξ is in the ellipsoid λ‖Λξ‖² + (1 − λ)‖Nξ‖²/D² ≤ 1, for each λ in [0, 1]. So ‖C z(τ)‖ is at most
the norm of C e^{Fτ} on this ellipsoid, and the λ with the smallest is used. If no ‖Λx(τ)‖ found in
this way exceeds 1, ‖Λx‖ ≤ 1 holds at the next delivery, whenever it happens, and by induction at all
times: the set ‖Λx‖ ≤ 1 is invariant.

Over a cell of the grid, s is the left node. From the last node T on, x + e_c = e^{Hτ} ξ has
decayed, and z has followed the system for T' from a state with ‖e_c‖ ≤ D and ‖Λx‖ ≤ 1. If inputs
are delayed or held, the flow is followed until what they change is a share of D.

Where bounds are largest, the conditions of several earlier times are used together
(``ellipsoid_intersections.py``). Up to the first event after the start x is known, so if inputs are
neither delayed nor held, the ellipsoid need only contain x at the first delivery after it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.cached_method import cached_method
from noack.core.linear_systems import Matrix, Vector, exponential
from noack.theory.bounds.contraction import logarithmic_norm
from noack.theory.bounds.enclosure import response
from noack.theory.bounds.gains import Output
from noack.theory.bounds.stacked_norms import Stack, largest_eigenvalues, spectral_norm, spectral_norms
from noack.theory.certificates.deliveries.delivery_flow import (
    FLOW_ROUNDING,
    NO_EFFECTS,
    DeliveryFlow,
    InputEffects,
    bend_terms,
)
from noack.theory.certificates.deliveries.ellipsoid_intersections import (
    LEAST_CONDITION,
    Wanted,
    balancing_coordinates,
    bound_outputs,
    weights_favouring,
)

_LARGEST_LOGIT = 40.0
"""The logit of a λ of 1, to rounding: only ‖Λξ‖ ≤ 1 is used."""
_LOGITS = np.append(np.arange(-12.0, 13.0, 2.0), _LARGEST_LOGIT)
"""Logits of λ, ln λ/(1 − λ), that are tried first in each cell: from 6e-6 to 1."""
_LOGIT_CHANGES = np.array([1.5, 0.75, 0.37, 0.18, 0.09])
"""Changes of the logit in each round of the search: they fill the gaps of 2 between the first ones."""
_NEIGHBOURS = np.array([-1.0, 0.0, 1.0])
"""Multiples of the change that are compared in each round."""
_CELLS_AT_ONCE = 16
"""Cells with the highest bounds, which are improved together: one product for all of them."""
_MOST_JOINT_ROUNDS = 3
"""Maximum number of rounds that use the conditions of earlier times: each takes long."""
_CLEARLY_ENOUGH = 0.98
"""Share of a sufficient bound from which on a bound at one end of a cell is not improved: the other end
and the sag come on top."""
_EARLIER_TIMES = 8
"""Earlier times whose conditions are used together."""
_WINDOWS = (1 / 6, 1 / 3, 2 / 3, 0.9, 1.0)
"""T' as shares of the last node: long ones have decayed, short ones grow less."""
_FIRST_WEIGHTS = np.array(
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
"""Weights of ‖x_c‖, of ‖e_c‖ at both ends, and of ‖Λx‖, after the last node: the first to be tried."""
_WEIGHTED_FORMS = [0, 1, 2 * _EARLIER_TIMES + 1, 2]
"""The forms of :meth:`Reach._rows_in` to which ``_FIRST_WEIGHTS`` belong."""
_HALVINGS = 12
"""Halvings of the interval of the largest ‖p‖, which is found to 1/4096 from below."""


class _Window(NamedTuple):
    """The flow from a node T' ago until now, in (x_c, e_c) T' ago."""

    node: int
    cells: NDArray[np.intp]
    """The cells of the times since the node, from 0 to T', (k + 1,)."""
    flows: Stack
    """z at these times, (k + 1, 2n, 2n)."""
    model: Matrix
    """x_c at the node from ξ, (n, n)."""
    model_norm: float
    """‖x_c‖ for ‖ξ‖ ≤ 1."""
    largest_model: float
    """‖x_c‖ for ‖Λξ‖ ≤ 1."""


@dataclass(frozen=True)
class DeliveryEllipsoid:
    """The states ξ at a delivery with ‖Λξ‖ ≤ 1."""

    flow: DeliveryFlow
    scaling: Matrix
    """Λ, (n, n), invertible."""

    @cached_property
    def inverse(self) -> Matrix:
        """Λ⁻¹."""
        return np.asarray(np.linalg.inv(self.scaling))

    @cached_property
    def axes(self) -> tuple[Vector, Stack]:
        """The singular values of N Λ⁻¹ at the left nodes, and Λ⁻¹ V."""
        _, singular, Vt = np.linalg.svd(self.flow.states[:-1, self.flow.n :] @ self.inverse)
        return singular, self.inverse @ Vt.transpose(0, 2, 1)

    @cached_property
    def cell_terms(self) -> tuple[Matrix, Matrix, Vector]:
        """The flow over the cells, on the axes of their ellipsoids.

        e^{Fτ} at both nodes of each cell, and Taylor's terms of F² e^{Fτ}, both as columns; and
        bounds of the terms' remainder.
        """
        flow, axes = self.flow, self.axes[1]
        ends = [flow.states[:-1] @ axes, flow.states[1:] @ axes]
        terms, remainder = bend_terms(flow.generator, ends[0], np.diff(flow.edges_s))
        return _columns(ends), _columns(terms), np.linalg.norm(remainder, axis=1)

    @cached_property
    def state_bounds(self) -> "_CellBounds":
        """Bounds of Λx."""
        return _CellBounds(self, np.hstack([self.scaling, np.zeros_like(self.scaling)]))

    @cached_method
    def windows(self, last_node: int) -> list[_Window]:
        """Return the windows before a node, for each T'."""
        flow, identity = self.flow, np.eye(self.flow.n)
        last_s = float(flow.edges_s[last_node])
        windows = []
        for share in _WINDOWS:
            node = max(int(flow.edges_s.searchsorted(last_s - share * last_s)) - 1, 0)
            since_s = last_s - float(flow.edges_s[node])
            # z from (x_c, e_c) = (x + e_c, e_c).
            flows = [np.block([[identity, -identity], [np.zeros_like(identity), identity]])]
            step = exponential(flow.generator * (since_s / _EARLIER_TIMES))
            for _ in range(_EARLIER_TIMES):
                flows.append(step @ flows[-1])
            cells = [flow.cell_at(number * since_s / _EARLIER_TIMES) for number in range(_EARLIER_TIMES + 1)]
            model = flow.states[node, : flow.n] + flow.states[node, flow.n :]
            window = _Window(
                node=node,
                cells=np.array(cells),
                flows=np.array(flows),
                model=model,
                model_norm=float(np.linalg.norm(model, 2)),
                largest_model=float(np.linalg.norm(model @ self.inverse, 2)),
            )
            windows.append(window)
        return windows

    @cached_property
    def model_sups(self) -> Mapping[Output, float]:
        """The largest ‖C e^{(H+αI)τ} ξ‖ for all τ and all these ξ, of every output C of e_c."""
        error = self.flow.error
        responses = response(error.scaled_H, error.inverse_weight @ self.inverse)
        return {C: float(k.sup()) for C, k in responses.through_each(error.stacked).items()}

    @cached_property
    def drive_limit(self) -> tuple[float, Vector, "_CellBounds"]:
        """The largest ‖p‖ that does not drive ‖Λx‖ beyond 1; bounds of ‖K e_c‖; their cells.

        On ‖y‖ = 1, y = Λx, d‖y‖/dt ≤ yᵀSy + yᵀΛBU p, and yᵀΛBU p ≤ ‖p‖ (γ/2 + ‖(ΛBU)ᵀy‖²/2γ).
        """
        flow = self.flow
        # The largest ‖p‖ for each γ, by bisection.
        S = self.scaling @ flow.closed_loop @ self.inverse
        by_input = self.scaling @ flow.input_matrix
        squares = by_input @ by_input.T / 2
        gain = float(np.linalg.norm(by_input, 2))
        largest = 0.0
        if gain:
            gamma = gain * np.exp(np.linspace(-4.0, 0.0, 17))
            low = np.zeros(len(gamma))
            high = -2 * logarithmic_norm(S).clip(max=0.0) / gamma
            for _ in range(_HALVINGS):
                middle = (low + high) / 2
                driven = S + (middle / gamma)[:, None, None] * squares
                grows = logarithmic_norm(driven) + middle * gamma / 2 >= 0
                low = np.where(grows, low, middle)
                high = np.where(grows, middle, high)
            largest = float(low.max())
        cells = _CellBounds(self, np.hstack([np.zeros_like(flow.gain), flow.gain]))
        input_errors = cells.frobenius_bounds(np.ones(1), np.array([_LARGEST_LOGIT]))[:, 0]
        return largest, input_errors, cells


@dataclass(frozen=True)
class Reach:
    """All z after a delivery with ‖Λξ‖ ≤ c at the delivery and ‖e_c‖_W ≤ D since then."""

    ellipsoid: DeliveryEllipsoid
    scale: float
    """c"""
    error_bound: float
    """D"""
    effects: InputEffects = NO_EFFECTS
    followed_share: float = 1.0
    """e_c is followed until delay and hold may have changed it by this share of D."""
    first_cell: int = 0
    """‖Λξ‖ ≤ c from this cell after the start on; before, x is that of the start."""

    def sup(self, C: Matrix) -> float:
        """Bound ‖C z‖ at all times, for C of shape (q, 2n)."""
        bounds = _CellBounds(self.ellipsoid, C)
        # If the larger one is known well enough, the smaller one need not be.
        after = self._sup_after_last_node(bounds, math.inf)
        followed = self._sup_followed(bounds, after)
        if after > followed:
            after = self._sup_after_last_node(bounds, followed)
            followed = self._sup_followed(bounds, after)
        return max(self.scale * max(followed, after), self._from_start(C))

    def sup_state(self, C: Matrix) -> float:
        """Bound ‖C x‖ at all times, for C of shape (q, n)."""
        in_ellipsoid = self.scale * float(spectral_norm(C @ self.ellipsoid.inverse)) * FLOW_ROUNDING
        return max(in_ellipsoid, self._from_start(np.hstack([C, np.zeros_like(C)])))

    def _from_start(self, C: Matrix) -> float:
        return self.ellipsoid.flow.from_start(C, self.error_bound) if self.first_cell else 0.0

    def largest_state(self, since_s: float = 0.0) -> float:
        """Bound ‖Λx‖ from a time after the start on."""
        if not self.first_cell:
            return self.scale
        flow, C = self.ellipsoid.flow, self.ellipsoid.state_bounds.C
        return max(self.scale, flow.from_start(C, self.error_bound, flow.cell_at(since_s)))

    def is_invariant(self) -> bool:
        """Return whether ‖Λx‖ ≤ c at a delivery implies the same at all times until the next.

        It cannot be left while ‖K e_c + q‖ is below :attr:`DeliveryEllipsoid.drive_limit`.
        """
        largest, input_errors, bounds = self.ellipsoid.drive_limit
        input_errors = input_errors + (self._changes(bounds) + self.effects.age_input) / self.scale
        first_open_cell = int(np.argmax(np.append(input_errors, np.inf) * FLOW_ROUNDING >= largest))
        states = self.ellipsoid.state_bounds
        is_inside = self._sup_after_last_node(states, 1.0, most=1.0) <= 1
        return is_inside and self._sup_followed(states, 1.0, first_open_cell) <= 1

    def _changes(self, bounds: "_CellBounds") -> Vector:
        """Bound what delay and hold change of C z over the cells, (k,)."""
        return self.effects.changes(bounds.unit_effects)

    @cached_property
    def _error_changes(self) -> Vector:
        """Bounds of what delay and hold change of e_c over the cells, (k,)."""
        return self.effects.changes(self.ellipsoid.flow.error_effects)

    @cached_property
    def _state_limits(self) -> Vector:
        """Bounds of ‖Λx‖ over the cells, for c = 1."""
        return 1 + self._changes(self.ellipsoid.state_bounds) / self.scale

    @cached_property
    def _followed_cells(self) -> int:
        """The cells that are followed."""
        return int(np.argmax(np.append(self._error_changes, np.inf) > self.followed_share * self.error_bound))

    def _sup_followed(self, bounds: "_CellBounds", enough: float, first_cell: int = 0) -> float:
        """Bound ‖C z‖ over the cells that are followed, for c = 1; see :meth:`_CellBounds.sup`."""
        # All is in proportion to c, for D/c.
        errors, changes = self.error_bound + self._error_changes, self._changes(bounds)
        cells = slice(first_cell, self._followed_cells)
        return bounds.sup(errors / self.scale, self._state_limits, changes / self.scale, cells, enough)

    def _sup_after_last_node(self, bounds: "_CellBounds", enough: float, *, most: float = math.inf) -> float:
        """Bound ‖C z‖ after the last node that is followed, for c = 1.

        A bound of at most ``enough`` is not improved, nor one that cannot become at most ``most``.
        """
        changes = self.effects.age_input * bounds.unit_effects[1]
        # By the ellipsoids of the first weights.
        cells, flows, forms, semi_axes = self._last_windows
        Y = bounds.C @ flows
        images = Y[:, None] @ semi_axes
        norms = spectral_norms(images.reshape(-1, *images.shape[2:])).reshape(images.shape[:2])
        added = changes[cells] / self.scale
        smallest = float((norms.min(axis=1) * FLOW_ROUNDING + added).min())
        if smallest <= enough:
            return smallest
        # By those of better weights.
        first_weights = weights_favouring(forms, _WEIGHTED_FORMS, _FIRST_WEIGHTS[norms.argmin(axis=1)])
        largest, _ = bound_outputs(
            forms, Y, enough, first_weights, wanted=Wanted.SMALLEST, added=added, most=min(smallest, most)
        )
        return min(smallest, float((largest + added).min()))

    @cached_property
    def _last_windows(self) -> tuple[NDArray[np.int64], Stack, Stack, Stack]:
        """The cell, the flow and the forms of the time T' ago, after the last node that is followed.

        For each T': T' as a cell; the flow in it; forms of (x_c, e_c) T' ago that are at most 1, for
        c = 1; and the semi-axes of the ellipsoids of ``_FIRST_WEIGHTS``.
        """
        n, windows = self.ellipsoid.flow.n, self.ellipsoid.windows(self._followed_cells)
        rows = np.array([self._rows_in(window) for window in windows])
        # Semi-axes of the ellipsoids of the first weights, in balanced coordinates.
        coordinates = balancing_coordinates(rows)
        balanced = rows @ coordinates[:, None]
        forms = balanced.swapaxes(-1, -2) @ balanced
        weighted = forms[:, _WEIGHTED_FORMS].reshape(len(windows), len(_WEIGHTED_FORMS), -1)
        first_forms = _FIRST_WEIGHTS @ weighted
        values, V = np.linalg.eigh(first_forms.reshape(len(windows), -1, 2 * n, 2 * n))
        usable = values[..., :1] > LEAST_CONDITION * values[..., -1:]  # others are too flat
        semi_axes = V / np.sqrt(np.where(usable, values, LEAST_CONDITION))[..., None, :]
        cells = np.array([window.cells[-1] for window in windows])
        flows = np.array([window.flows[-1] for window in windows]) @ coordinates
        return cells, flows, forms, semi_axes

    def _rows_in(self, window: _Window) -> Stack:
        """Return rows C with ‖C (x_c, e_c)‖ ≤ 1 T' ago, for c = 1, (i, n, 2n).

        They are ‖x_c‖ ≤ h then, and in turns ‖e_c‖ ≤ D and ‖Λx‖ ≤ 1 at times from then until now.
        """
        ellipsoid, flow, n = self.ellipsoid, self.ellipsoid.flow, self.ellipsoid.flow.n
        # h bounds x_c = x + e_c, which follows the model, at the node T' ago.
        h = window.largest_model + window.model_norm * self.effects.first_error / self.scale
        if self.first_cell:
            h = max(h, float(np.linalg.norm(window.model @ flow.start)) / self.scale)
        # Held inputs change e_c and x after that node.
        age_input = self.effects.age_input / self.scale
        error_changes = (age_input * flow.error_effects[1])[window.cells]
        state_changes = (age_input * ellipsoid.state_bounds.unit_effects[1])[window.cells]
        error_changes[0] = state_changes[0] = 0.0
        state_bound = 1.0 if window.node >= self.first_cell else self.largest_state() / self.scale
        errors = self.error_bound / self.scale + error_changes
        states = state_bound + state_changes[:-1]
        rows = np.zeros((2 * _EARLIER_TIMES + 2, n, 2 * n))
        rows[0, :, :n] = np.eye(n) / (flow.model_growth * h)
        rows[1::2] = window.flows[:, n:] / errors[:, None, None]
        rows[2::2] = (ellipsoid.scaling @ window.flows[:-1, :n]) / states[:, None, None]
        return rows


class _CellBounds:
    """Bounds of ‖C z‖ over each cell, for ‖Λξ‖ ≤ 1."""

    def __init__(self, ellipsoid: DeliveryEllipsoid, C: Matrix) -> None:
        self.C, self._flow, self._scaling = C, ellipsoid.flow, ellipsoid.scaling
        self._singular = ellipsoid.axes[0]
        cells, n = self._singular.shape
        ends, terms, remainder = ellipsoid.cell_terms
        self._ends = (C @ ends).reshape(len(C), 2, cells, n)
        bends = (C @ terms).reshape(len(C), -1, cells, n)
        self._squares = np.concatenate(
            [
                np.einsum("qokj->kjo", self._ends**2),
                np.einsum("qokj->kjo", bends**2),
                (np.linalg.norm(C, 2) * remainder)[..., None] ** 2,
            ],
            axis=2,
        )
        """(k, n, 7): of both ends, and of the terms that bound ‖C F² e^{Fτ}‖, for each axis."""
        self._sag_factors_s2 = np.diff(ellipsoid.flow.edges_s) ** 2 / 8

    @cached_property
    def unit_effects(self) -> tuple[Vector, Vector]:
        """See :meth:`DeliveryFlow.unit_effects`."""
        return self._flow.unit_effects(self.C)

    def sup(
        self, errors: Vector, states: Vector, added: Vector, followed_cells: slice, enough: float
    ) -> float:
        """Bound ‖C z‖ over some cells, given D and ‖Λx‖ for each, with what is added to each, (k,).

        A bound below ``enough`` is not improved.
        """
        bounds = self.frobenius_bounds(errors, _LOGITS)
        if not np.isfinite(bounds).all():
            return math.inf
        highest = bounds.min(axis=1) + added
        logits = _LOGITS[bounds.argmin(axis=1)]
        highest[: followed_cells.start] = 0.0
        highest[followed_cells.stop :] = 0.0
        rounds = np.zeros(len(highest), dtype=np.int64)
        joint_rounds = 0
        while True:  # the highest bounds become better, until that of the highest is settled
            cells = np.argsort(highest)[-_CELLS_AT_ONCE:]
            is_last = rounds[cells[-1]] > len(_LOGIT_CHANGES) or joint_rounds == _MOST_JOINT_ROUNDS
            if is_last or highest[cells[-1]] * FLOW_ROUNDING <= enough:
                return float(highest[cells[-1]]) * FLOW_ROUNDING
            has_best_share = rounds[cells] == len(_LOGIT_CHANGES)
            if has_best_share.any():
                cells = cells[has_best_share]
                wanted = (enough - added[cells]).clip(min=0.0)
                values = self._joint_bounds(errors, states, cells, logits[cells, None], wanted)
                joint_rounds += 1
            else:
                cells = cells[rounds[cells] < len(_LOGIT_CHANGES)]
                logit_changes = _LOGIT_CHANGES[rounds[cells], None]
                values, logits[cells] = self._better_shares(errors, cells, logits[cells], logit_changes)
            highest[cells] = np.minimum(highest[cells], values + added[cells])
            rounds[cells] += 1

    def _better_shares(
        self, errors: Vector, cells: NDArray[np.int64], logits: Vector, logit_changes: Matrix
    ) -> tuple[Vector, Vector]:
        """Return the bounds of cells by the best of three λ each, and its logit, (k,)."""
        candidates = logits[:, None] + logit_changes * _NEIGHBOURS
        values = self._spectral_bounds(errors, cells, candidates)
        best = np.arange(len(cells)), values.argmin(axis=1)
        return values[best], candidates[best]

    def frobenius_bounds(self, errors: Vector, logits: Vector) -> Stack:
        """Return bounds in the Frobenius norm, for every λ, (k, j), given D for each cell."""
        singular = self._singular / errors[:, None]
        norms = np.sqrt(_semi_axes(singular, logits) ** 2 @ self._squares)
        ends = norms[..., :2].max(axis=2)
        bends = norms[..., 2:].sum(axis=2)
        return np.asarray(ends + self._sag_factors_s2[:, None] * bends)

    def _spectral_bounds(self, errors: Vector, cells: NDArray[np.int64], logits: Stack) -> Stack:
        """Return bounds in the spectral norm for some cells, each with its own λ, (k, j)."""
        ends = self._ends[:, :, cells]
        semi_axes = _semi_axes(self._singular[cells] / errors[cells, None], logits)
        grams = np.einsum("qoki,qokj->koij", ends, ends)[:, None]
        scaled = grams * semi_axes[:, :, None, :, None] * semi_axes[:, :, None, None, :]
        squares = largest_eigenvalues(scaled.reshape(-1, *scaled.shape[-2:])).clip(min=0.0)
        at_ends = np.sqrt(squares.reshape(scaled.shape[:-2])).max(axis=2)
        return np.asarray(at_ends + self._sags(cells, semi_axes))

    def _sags(self, cells: NDArray[np.int64], semi_axes: Stack) -> Matrix:
        """Bound how far ‖C z‖ may lie above both ends of some cells, for each λ, (k, j)."""
        bends = np.sqrt(semi_axes**2 @ self._squares[cells, :, 2:]).sum(axis=2)
        return np.asarray(self._sag_factors_s2[cells, None] * bends)

    def _joint_bounds(
        self, errors: Vector, states: Vector, cells: NDArray[np.int64], logits: Stack, enough: Vector
    ) -> Vector:
        """Return bounds by all conditions at several earlier nodes, (k,).

        One that is clearly below ``enough`` is not improved.
        """
        flow, n = self._flow, self._flow.n
        # The conditions, as rows for ξ: ‖Λξ‖ ≤ 1, ‖e_c‖ ≤ D, ‖Λx‖ ≤ 1; the last ‖e_c‖ has most weight.
        times_s = flow.edges_s[cells, None] * (np.arange(1, _EARLIER_TIMES + 1) / _EARLIER_TIMES)
        nodes = np.minimum(flow.edges_s.searchsorted(times_s, side="right") - 1, cells[:, None])
        flows, scaling = flow.states[nodes], self._scaling
        rows = np.concatenate(
            [
                np.broadcast_to(scaling, (len(cells), 1, n, n)),
                flows[:, :, n:] / errors[nodes][..., None, None],
                scaling @ flows[:, :, :n] / states[nodes][..., None, None],
            ],
            axis=1,
        )
        share = 1 / (1 + np.exp(-logits[:, 0]))
        first_weights = weights_favouring(rows, [0, _EARLIER_TIMES], np.stack([share, 1 - share], axis=1))
        # The best weights at the right end, which are used at both ends.
        coordinates = balancing_coordinates(rows * np.sqrt(first_weights)[..., None, None])
        rows = rows @ coordinates[:, None]
        forms = rows.swapaxes(-1, -2) @ rows
        ends = self.C @ np.array([flow.states[cells], flow.states[cells + 1]]) @ coordinates
        bounds, weights = bound_outputs(forms, ends[1], _CLEARLY_ENOUGH * enough, first_weights)
        inverse = np.linalg.inv(np.einsum("ji,jiab->jab", weights, forms))
        squares = np.linalg.eigvalsh(ends @ inverse @ ends.swapaxes(-1, -2))[..., -1].max(axis=0)
        squares = np.where(np.isfinite(bounds), squares.clip(min=0.0), np.inf)
        semi_axes = _semi_axes(self._singular[cells] / errors[cells, None], logits)
        return np.asarray(np.sqrt(squares) + self._sags(cells, semi_axes)[:, 0])


def _semi_axes(singular: Vector, logits: Vector) -> Stack:
    """Return those of the ellipsoids of cells with λ = 1/(1 + e^{−logit}), (k, j, n)."""
    share = 1 / (1 + np.exp(-logits))[..., None]
    return np.asarray(1 / np.sqrt(share + (1 - share) * singular[:, None] ** 2))


def _columns(stacks: list[Stack]) -> Matrix:
    """Return stacks of the same shape (k, 2n, n) side by side."""
    return np.asarray(np.concatenate(stacks).transpose(1, 0, 2).reshape(stacks[0].shape[1], -1))
