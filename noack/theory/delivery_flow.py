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

from noack.core.linear_systems import Matrix, Vector, spectral_abscissa
from noack.theory.contraction import Stack, logarithmic_norm
from noack.theory.enclosure import response
from noack.theory.gains import PlantGains

_CELLS_PER_STEP, _FIRST_STEP, _MOST_STEP = 32, 0.005, 0.02
_MOST_GROWTH, _SETTLED, _MOST_CELLS = 1e6, 0.03, 3000
_LOGITS = np.append(np.arange(-12.0, 13.0), 40.0)
_ALONE = 40.0
"""λ = 1, to rounding: only ‖Λξ‖ ≤ 1 is used."""
_NEIGHBOURS, _WIDTHS = np.array([-1.0, 0.0, 1.0]), (1.0, 0.5, 0.25, 0.12, 0.06)
_AT_ONCE = 32
_TAYLOR_TERMS = 4
ROUNDING = 1 + 1e-5
"""Covers the error of e^{Fτ}, about 1e-13 of its norm, which is at most about 1e6."""


class DeliveryFlow:
    """e^{Fτ} (ξ, 0) at the nodes of a grid, for a known plant; W is the identity."""

    def __init__(self, plant: PlantGains) -> None:
        from scipy.linalg import expm

        error = plant.error
        self.weight, self.inverse = error.weight, error.inverse_weight
        self.n = len(error.H)
        self.closed_loop = self.turned(plant.closed_loop)
        self.BK = self.turned(plant.B @ error.K)
        self.H = self.turned(error.scaled_H)
        self.mismatch = E = self.closed_loop - self.H
        self.generator = np.block([[self.closed_loop, self.BK], [-E, self.H - self.BK]])
        self.start = self.weight @ plant.start
        fastest = max(float(np.abs(np.linalg.eigvals(self.generator)).max()), 1e-9)
        slowest, unstable = -spectral_abscissa(self.H), spectral_abscissa(self.generator)
        step_s, state = _FIRST_STEP / fastest, np.eye(2 * self.n)[:, : self.n]
        leap, t_s = expm(self.generator * step_s), 0.0
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
class Reach:
    """What z can be at some time after a delivery."""

    flow: DeliveryFlow
    shape: Matrix
    """Λ, (n, n), invertible: ‖Λ W x‖ ≤ 1 at the delivery."""
    limit: float
    """D, ‖e_c‖_W since then."""

    def sup(self, C: Matrix) -> float:
        """Bound ‖C z‖ at all times, for C of shape (q, 2n)."""
        return max(self._over_cells(C, 0), self._afterwards(C))

    def is_invariant(self) -> bool:
        """Return whether ‖Λx‖ ≤ 1 at a delivery implies the same at all times until the next."""
        flow, n = self.flow, self.flow.n
        x, e_c = np.split(np.eye(2 * n), 2)
        # ‖Λx‖ ≤ 1 cannot be left while ‖ΛBK e_c‖ is below the rate at which it contracts.
        rate = -logarithmic_norm(self.shape @ flow.closed_loop @ np.linalg.inv(self.shape))
        driven = _CellBounds(self, self.shape @ flow.BK @ e_c).loose(np.array([_ALONE]))[:, 0]
        first = int(np.argmax(np.append(driven, np.inf) * ROUNDING >= rate))
        return max(self._over_cells(self.shape @ x, first), self._afterwards(self.shape @ x)) <= 1

    def _over_cells(self, C: Matrix, first: int) -> float:
        """Bound ‖C z‖ over the cells from the given one on."""
        bounds = _CellBounds(self, C)
        loose = bounds.loose(_LOGITS)
        if not np.isfinite(loose).all():
            return math.inf
        highest, logits = loose.min(axis=1), _LOGITS[loose.argmin(axis=1)]
        highest[:first] = 0.0
        found, order = 0.0, np.argsort(highest)[::-1]
        for cells in np.array_split(order, max(len(order) // _AT_ONCE, 1)):
            if highest[cells[0]] <= found:
                break  # the others are below it, too
            found = max(found, float(bounds.tight(cells.astype(np.int64), logits[cells]).max()))
        return found * ROUNDING

    @cached_property
    def _split(self) -> tuple[Vector, Stack]:
        """The singular values of N Λ⁻¹ at the left nodes, and Λ⁻¹ V."""
        inverse, n = np.linalg.inv(self.shape), self.flow.n
        _, singular, Vt = np.linalg.svd(self.flow.states[:-1, n:] @ inverse)
        return singular, inverse @ Vt.transpose(0, 2, 1)

    @cached_property
    def ends(self) -> tuple[Stack, Stack]:
        """e^{Fτ} at both nodes of each cell, on the axes of its ellipsoids."""
        states, axes = self.flow.states, self._split[1]
        return states[:-1] @ axes, states[1:] @ axes

    def semi_axes(self, cells: NDArray[np.int64] | slice, logits: Vector) -> Stack:
        """Return those of the ellipsoids of cells with λ = 1/(1 + e^{−logit}), (…, n)."""
        share = 1 / (1 + np.exp(-logits))[..., None]
        others = (self._split[0][cells, None] / self.limit) ** 2 / (1 + np.exp(logits))[..., None]
        return np.asarray(1 / np.sqrt(share + others))

    @cached_property
    def terms(self) -> tuple[list[Stack], Vector]:
        """Taylor's terms of F² e^{Fτ} over each cell, and the growth of the remainder."""
        F, steps_s = self.flow.generator, np.diff(self.flow.edges_s)
        terms = [F @ F @ self.ends[0]]
        for order in range(1, _TAYLOR_TERMS + 1):
            terms.append(F @ terms[-1] * (steps_s / order)[:, None, None])
        exponents = max(logarithmic_norm(F), 0.0) * steps_s
        with np.errstate(over="ignore"):
            return terms, np.exp(exponents)

    def _afterwards(self, C: Matrix) -> float:
        """Bound ‖C z‖ after the last node."""
        found = float(_largest(_gram(C @ self._last)).min()) * ROUNDING
        return found if math.isfinite(found) else math.inf

    @cached_property
    def _last(self) -> Stack:
        """e^{FT'} on ellipsoids that contain z, T' before each time after the last node.

        They follow from ‖x + e_c‖ ≤ h and ‖e_c‖ ≤ D at that time, and ‖e_c‖ ≤ D now.
        """
        from scipy.linalg import expm

        flow, n = self.flow, self.flow.n
        end_s = float(flow.edges_s[-1])
        ago_s = end_s / 6
        kernel = response(flow.H, np.asarray(np.linalg.inv(self.shape))).through(np.eye(n))
        h = kernel.sup(end_s - ago_s)
        one, none = np.eye(n), np.zeros((n, n))
        moved = expm(flow.generator * ago_s) @ np.block([[one, -one], [none, one]])
        rows = [np.hstack([one, none]) / h, np.hstack([none, one]) / self.limit]
        rows.append(moved[n:] / self.limit)
        grams = [row.T @ row for row in rows]
        found = []
        for first in (0.01, 0.03, 0.1, 0.3):
            for last in (0.1, 0.3, 0.5, 0.7, 0.9):
                shares = (first, (1 - first) * (1 - last), (1 - first) * last)
                values, V = np.linalg.eigh(
                    sum(s * gram for s, gram in zip(shares, grams, strict=True))
                )
                found.append(moved @ V / np.sqrt(values))
        return np.array(found)


class _CellBounds:
    """Bounds of ‖C z‖ over each cell."""

    def __init__(self, reach: Reach, C: Matrix) -> None:
        self._reach = reach
        self._grams = [_gram(C @ ends) for ends in reach.ends]
        terms, growth = reach.terms
        rest = np.linalg.norm(C, 2) * growth[:, None]
        found = [np.einsum("kij,kij->kj", Y, Y) for Y in (C @ term for term in terms[:-1])]
        found.append(rest**2 * np.einsum("kij,kij->kj", terms[-1], terms[-1]))
        self._bends = np.array(found)
        """Squares of the terms that bound ‖C F² e^{Fτ}‖, for each axis, (terms, k, n)."""
        self._sags_s2 = np.diff(reach.flow.edges_s) ** 2 / 8

    def loose(self, logits: Vector) -> Stack:
        """Return bounds in the Frobenius norm, for every λ, (k, j)."""
        squares = self._reach.semi_axes(slice(None), logits) ** 2
        sizes = [np.sqrt(np.einsum("kii,kji->kj", gram, squares)) for gram in self._grams]
        bends = np.sqrt(np.einsum("oki,kji->okj", self._bends, squares)).sum(axis=0)
        return np.asarray(np.maximum(*sizes) + self._sags_s2[:, None] * bends)

    def tight(self, cells: NDArray[np.int64], logits: Vector) -> Vector:
        """Return bounds for some cells, with better λ near the given ones, (k,)."""

        def bounds(tried: Vector) -> Vector:
            d = self._reach.semi_axes(cells, tried)
            sizes = [
                _largest(gram[cells, None] * d[..., None] * d[..., None, :]) for gram in self._grams
            ]
            bends = np.sqrt(np.einsum("oki,kji->okj", self._bends[:, cells], d**2)).sum(axis=0)
            return np.asarray(np.maximum(*sizes) + self._sags_s2[cells, None] * bends)

        rows, best = np.arange(len(cells)), logits
        found = np.full(len(cells), np.inf)
        for width in _WIDTHS:
            tried = best[:, None] + width * _NEIGHBOURS
            values = bounds(tried)
            index = values.argmin(axis=1)
            best, found = tried[rows, index], np.minimum(found, values[rows, index])
        return found


def _gram(values: Stack) -> Stack:
    return np.asarray(values.transpose(0, 2, 1) @ values)


def _largest(grams: Stack) -> Vector:
    """Return the square roots of the largest eigenvalues, (k,)."""
    return np.asarray(np.sqrt(np.linalg.eigvalsh(grams)[..., -1].clip(min=0.0)))
