"""The flow between two deliveries: what x and e_c can be, if inputs are neither delayed nor held.

From one delivery to the next no update reaches the controller. So z = (x, e_c) follows a linear
system without an input, from (ξ, 0) with the state ξ at the delivery:

    x' = (A + BK + αI) x + BK e_c,    e_c' = −E x + (H − BK + αI) e_c,    z(τ) = e^{Fτ} (ξ, 0)

All that is uncertain is ξ, and the time of the next delivery. Let ‖Λξ‖ ≤ 1 and ‖e_c‖_W ≤ D at all
times. At the time τ, ξ has ‖Λξ‖ ≤ 1 and ‖Nξ‖_W ≤ D, N the rows of e_c in e^{Fs} (I, 0) for an
s ≤ τ. So ξ is in the ellipsoid λ‖Λξ‖² + (1 − λ)‖Nξ‖²/D² ≤ 1, for each λ in [0, 1].
So ‖C z(τ)‖ is at most the norm of C e^{Fτ} on this ellipsoid, and the λ with the smallest is used.
If no ‖Λx(τ)‖ found in this way exceeds 1, ‖Λx‖ ≤ 1 holds at the next delivery, whenever it happens,
and by induction at all times: the set ‖Λx‖ ≤ 1 is invariant.

All matrices are in coordinates in which W is the identity. Between two nodes of the grid the bounds
are those of :mod:`noack.theory.enclosure`, with s the left node. From the last node T on, x + e_c =
e^{Hτ} ξ has decayed, and z has followed the system for T' from a state with ‖e_c‖_W ≤ D.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, Vector, exponential, spectral_abscissa
from noack.theory.contraction import (
    Stack,
    largest_eigenvalues,
    logarithmic_norm,
    product,
    spectral_norms,
)
from noack.theory.error_gains import Output
from noack.theory.plant_gains import PlantGains

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
        self.stretch = error.kernels[Output.WEIGHTED].sup()
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
        one, none = np.eye(n), np.zeros((n, n))
        moved = moved @ np.block([[one, -one], [none, one]])
        rows = [np.hstack([one, none]) / h, np.hstack([none, one]) / limit, moved[n:] / limit]
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
        found = float(sizes.min(initial=math.inf)) * ROUNDING
        return found if math.isfinite(found) else math.inf


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
