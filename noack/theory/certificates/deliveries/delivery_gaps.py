"""What one gap between two delivered events makes of a ball, where events are due.

Let ξ = x at a delivered event, and z = (x, e_c) with e_c = 0 there. Until the next delivered event,
a time g later, and scaled by e^{αt},

    z' = F z + (B; −B) w,   F = [[A + BK, BK], [−E, H − BK]] + αI,   w = u − K(x + e_c)

If events are due, g is one of finitely many times. w is only what lateness adds: the age of the
applied input, ‖w‖ ≤ sup_{|τ|≤σ} ‖K(e^{−Hτ} − I)e^{Hr}ξ‖, and for a time d after the event the error
e⁻ that the update removes, ‖w‖ ≤ J = sup ‖K e^{H(r−τ)} e⁻‖ more. All norms over cells of time are
enclosed (:mod:`noack.theory.bounds.enclosure`).
"""

import itertools
import math
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, Vector, exponential
from noack.theory.bounds.certificate_terms import NetworkConditions, NoCertificateError, TriggerBound
from noack.theory.bounds.contraction import Stack
from noack.theory.bounds.enclosure import Outputs, response_until
from noack.theory.bounds.gains import Output, PlantGains

ROUNDING = 1 + 1e-9
_MOST_GAPS, _MOST_CELLS = 256, 640
_CELL = 0.04
"""Length of a cell, in time constants of the flow."""
_PIECES = 4
"""In so many pieces of a gap the ages of the input are averaged."""
_AGES = 4
"""Cells into which ages of an input from 0 to σ are divided."""
_LEAST, _THETAS = 1e-6, 2.0 ** np.arange(0, 7)
"""θ that are tried, in units of the smallest one that may suit, which is at least ``_LEAST``."""
ERROR, INPUT = "e_c in W", "e_c in K"
"""Names of outputs of z."""


class Gaps(NamedTuple):
    """The times between two successive delivered events."""

    step_s: float
    """All of them are multiples of it."""
    counts: NDArray[np.int64]
    """(k,)"""
    least_s: float
    """The shortest one."""

    @classmethod
    def of(cls, conditions: NetworkConditions, bound: TriggerBound) -> "Gaps":
        """Return the times for events as far apart as a bound says.

        Raises:
            NoCertificateError: they are not covered.
        """
        most_events, step_s = conditions.dropouts + 1, conditions.spacing_s
        least_s = max(bound.apart_s, step_s)
        if step_s == 0 or not math.isfinite(bound.due_s):
            raise NoCertificateError("events are not due at sampling times")
        fewest_steps, most_steps = (math.floor(time_s / step_s + 1e-9) for time_s in (least_s, bound.due_s))
        if fewest_steps == most_steps:
            return cls(fewest_steps * step_s, np.arange(1, most_events + 1), fewest_steps * step_s)
        if most_events * most_steps > _MOST_GAPS:
            raise NoCertificateError("too many times between deliveries")
        counts = {n for j in range(1, most_events + 1) for n in range(j * fewest_steps, j * most_steps + 1)}
        return cls(step_s, np.array(sorted(counts)), fewest_steps * step_s)


class GapNorm(NamedTuple):
    """What one gap makes of ‖Λξ‖ ≤ 1: arrays of (gaps,), (cells,) or (gaps, cells)."""

    shape: Matrix
    """Λ"""
    age_bends: Vector
    """How far ‖w‖ may lie above its values at nodes, from the age of the input."""
    ages: Vector
    """‖w‖ in each cell from the age of the input."""
    stretch: Vector
    """γ_g, with the age of the input."""
    aged: Matrix
    """∫‖ΛΨ‖ over each cell."""
    removal: Vector
    """J of the next event, with the age of the input."""
    removal_aged: Matrix
    """The part of J of the next event that a w of 1 in each cell causes."""
    pulse: Vector
    """‖Λξ‖ after a gap, J of the next event, and what is left of S, for S = 1."""
    removal_pulse: Vector
    remaining: Vector
    weighted_sum: Vector
    """‖Λξ‖/θ + S after a gap for S = 1."""
    theta: float
    """θ"""
    gain: float
    """‖Λξ‖ + θS after a gap, at most, if it was 1."""


class GapLoop:
    """The loop between two deliveries; cells divide the time r since the first of them."""

    def __init__(self, plant: PlantGains, conditions: NetworkConditions, gaps: Gaps) -> None:
        self.plant, self.conditions, self.gaps, self.n = plant, conditions, gaps, len(plant.A)
        self.H, self.R = plant.error.H, plant.error.split_K[1]
        self.scaled_H = self.H + plant.alpha_per_s * np.eye(self.n)
        M, BK = plant.closed_loop, plant.B @ plant.error.K
        self.F = np.block([[M, BK], [self.scaled_H - M, self.scaled_H - BK]])
        self.BK = np.vstack([BK, -BK])
        # An update may be in flight for d.
        d = conditions.delay_s
        self.starts_late = conditions.start_s > gaps.least_s * ROUNDING
        if self.starts_late:  # what is delivered before the first input stays in flight until then
            d = max(d, conditions.start_s)
        self.delay_s = d
        # Cells: as many in each step of the gaps, from r = 0 until d after the longest gap.
        fastest, longest = float(np.abs(np.linalg.eigvals(self.F)).max()), int(gaps.counts[-1])
        per_step = math.ceil(gaps.step_s / min(_CELL / fastest, d or math.inf) - 1e-9)
        per_step = max(min(per_step, _MOST_CELLS // (longest + 1)), 1)
        self.cell_s = gaps.step_s / per_step
        self.late_cells = math.ceil(d / self.cell_s - 1e-9)
        self.ends = gaps.counts * per_step
        self.cells = longest * per_step + self.late_cells
        self.until_s = self.cells * self.cell_s
        self.flows = self._powers(self.F)[:, :, : self.n]
        """e^{Fr} (I; 0) at all nodes, (cells + 1, 2n, n)."""
        event_cells = np.arange(0, self.late_cells or 1, per_step)
        event_cells = event_cells[(event_cells == 0) | (event_cells >= gaps.least_s / self.cell_s - 1e-9)]
        self.windows = self.late_cells - event_cells
        """Cells for which updates may still be in flight, by times at which their events can have been."""
        self.shares = self.windows / self.late_cells if self.late_cells else np.ones(1)
        """What J of these events counts in S."""
        # The outputs of z that are bounded.
        no_state, no_input = np.zeros((self.n, self.n)), np.zeros_like(self.R)
        self.outputs = {
            ERROR: np.hstack([no_state, plant.error.weight]),
            INPUT: np.hstack([no_input, self.R]),
        }
        for name in (Output.STATE, Output.WEIGHTED, Output.MISMATCH):
            self.outputs[name] = np.hstack([plant.outputs[name], 0 * plant.outputs[name]])
        # What drives z: a w at any time, and the age of the input for each τ from −σ to σ.
        BU = plant.input_matrix
        self._response = response_until(self.F, np.vstack([BU, -BU]), self.until_s, self.cells)
        s = conditions.hold_s
        of_age = [
            self.R @ (exponential(-self.H * (s * k / _AGES)) - np.eye(self.n))
            for k in range(-_AGES, _AGES + 1)
        ]
        self.aged = np.array(of_age) @ self._powers(self.scaled_H)[:, None]
        """R(e^{−Hτ} − I)e^{Hr} at nodes of r and τ, (cells + 1, ages, q, n)."""

    def _powers(self, generator: Matrix) -> Stack:
        step, powers = exponential(generator * self.cell_s), [np.eye(len(generator))]
        for _ in range(self.cells):
            powers.append(step @ powers[-1])
        return np.array(powers)

    @cached_property
    def removal(self) -> tuple[Matrix, float]:
        """C and b with J ≤ max_i ‖C_i e⁻‖ + b ‖e⁻‖_W, C of shape (nodes, q, n).

        C_i = e^{αd} R e^{Hu} at nodes of u from −σ to d + σ.
        """
        d, s, H = self.delay_s, self.conditions.hold_s, self.H
        grown = math.exp(self.plant.alpha_per_s * d)
        nodes_s = np.linspace(-s, d + s, 4 * _AGES + 1)
        curvature = 0.0
        for G, until_s in ((H, d + s), (-H, s)):
            response = response_until(G, self.plant.error.inverse_weight, until_s or 1e-9)
            curvature = max(curvature, float(response.through(self.R @ H @ H).sup_on_grid()))
        bend = grown * float(nodes_s[1] - nodes_s[0]) ** 2 / 8 * curvature
        nodes = [grown * self.R @ exponential(H * u_s) for u_s in nodes_s.tolist()]
        return np.array(nodes), bend * ROUNDING

    def removal_sizes(self, errors: Matrix) -> Vector:
        """Bound J for errors e⁻, (k, n)."""
        nodes, bend = self.removal
        sizes = np.linalg.norm(np.einsum("iqn,kn->kiq", nodes, errors), axis=-1).max(axis=-1)
        weighted = np.linalg.norm(errors @ self.plant.error.weight.T, axis=-1)
        return np.asarray((sizes + bend * weighted) * ROUNDING)

    @cached_property
    def removal_outputs(self) -> dict[str, Matrix]:
        """C of the outputs whose largest one bounds J."""
        nodes, bend = self.removal
        rows = [*nodes, bend * self.plant.error.weight]
        return {f"{number}": np.hstack([0 * C, C]) for number, C in enumerate(rows)}

    @cached_property
    def removal_areas(self) -> Vector:
        """Bound ∫J over each cell, for J as what z = e^{Fr} (B; −B) U causes."""
        kernels = self._response.through_each(Outputs(self.removal_outputs))
        *nodes, weighted = (kernel.area for kernel in kernels.values())
        return np.asarray(np.max(nodes, axis=0) + weighted)

    def at_ends(self, areas: Vector) -> Matrix:
        """Return ∫k(g − r) over each cell of r, for each gap g, (gaps, cells)."""
        distances = self.ends[:, None] - 1 - np.arange(self.cells)
        return np.asarray(np.where(distances >= 0, areas[distances.clip(min=0)], 0.0))

    def within_windows(self, areas: Stack) -> Stack:
        """Sum (…, cells) over the cells of each window, (…, windows)."""
        sums = np.cumsum(areas, axis=-1)
        return np.where(self.windows > 0, sums[..., self.windows - 1], 0.0)

    @cached_property
    def input_responses(self) -> Stack:
        """∫‖C e^{F(s−r)} (B; −B) U‖ over r in each cell, for s in each, (outputs, s, r)."""
        distances = np.subtract.outer(np.arange(self.cells), np.arange(self.cells))
        areas = []
        for kernel in self._response.through_each(Outputs(self.outputs)).values():
            previous = np.append(kernel.highest[:1], kernel.highest[:-1])
            largest = np.maximum(kernel.highest, previous) * self.cell_s * ROUNDING
            areas.append(np.where(distances >= 0, largest[distances.clip(min=0)], 0.0))
        return np.array(areas)

    def norm(self, shape: Matrix) -> GapNorm:
        """Return what one gap makes of ‖Λξ‖ ≤ 1."""
        # ‖w‖ over each cell, from the age of the input.
        inverse = np.asarray(np.linalg.inv(shape))
        bends, curved = self._age_bends(shape, inverse)
        ages = of_cells(_norms(self.aged @ inverse).max(axis=1)) + bends
        ages = ages * ROUNDING
        # J of the next event: the error that its update removes, from ξ and from w.
        lost = self.flows[self.ends, self.n :] @ inverse
        nodes, bend = self.removal
        removal = _norms(nodes @ lost[:, None]).max(axis=1)
        removal = removal + bend * _norms(self.plant.error.weight @ lost)
        removal_aged = self.at_ends(self.removal_areas)
        removal = removal * ROUNDING + removal_aged @ ages
        # ‖Λξ‖ after the gap.
        aged = self.at_ends(self._response.through(np.hstack([shape, 0 * shape])).area)
        stretch = self._stretch(shape, inverse) + aged @ curved
        # The same for S = 1: what the updates in flight add, and what of S remains.
        pulses, removal_pulses = (self.within_windows(areas) / self.shares for areas in (aged, removal_aged))
        remaining = (self.windows - self.ends[:, None]).clip(min=0) / (self.late_cells or 1) / self.shares
        # The θ that lets ‖Λξ‖ + θS grow least.
        least = pulses / (1 - removal_pulses - remaining).clip(min=1e-9)
        thetas = (float(least.max()) * ROUNDING or _LEAST) * _THETAS[:, None]
        weighted_sum = (pulses / thetas[..., None] + removal_pulses + remaining).max(axis=-1)
        gains = np.maximum(stretch + thetas * removal, weighted_sum).max(axis=1)
        best = int(gains.argmin())
        return GapNorm(
            shape, bends, ages, stretch, aged, removal, removal_aged,
            pulses.max(axis=1), removal_pulses.max(axis=1), remaining.max(axis=1), weighted_sum[best],
            float(thetas[best, 0]), float(gains[best]),
        )  # fmt: skip

    def _stretch(self, shape: Matrix, inverse: Matrix) -> Vector:
        """Bound ‖Λξ‖ after each gap with ages to first order, (gaps,).

        w = −τ KHe^{Hr}ξ. In a few pieces of a gap, Ψ(g − r) KHe^{Hr} is replaced by its mean; then
        only the mean of τ counts, and a norm is largest for means of ±σ.
        """
        s, G, F, n = self.conditions.hold_s, self.scaled_H, self.F, self.n
        moved = shape @ self.flows[self.ends, :n] @ inverse
        if s == 0 or not self.H.any():
            return _norms(moved) * ROUNDING
        # By how much the products at the nodes may differ from those between them.
        pushed = self.BK @ self.H
        row = np.hstack([shape, 0 * shape])
        Y = F @ F @ pushed - 2 * F @ pushed @ G + pushed @ G @ G
        bend = response_until(F, Y @ inverse, self.until_s, self.cells).through(row).sup_on_grid()
        models = response_until(G, inverse, self.until_s, self.cells).through(shape).sup_on_grid()
        sag = self.cell_s**2 / 8 * float(bend) * float(models)
        left, right = row @ self._powers(F) @ pushed, self._powers(G) @ inverse
        # For each gap the largest norm over the signs of the means, and the deviations from them.
        signs = np.array(list(itertools.product((-s, s), repeat=_PIECES)))
        stretches = []
        for end, undriven in zip(self.ends.tolist(), moved, strict=True):
            products = left[end::-1] @ right[: end + 1]
            deviation, means = 0.0, np.zeros((_PIECES, n, n))
            for number, piece in enumerate(np.array_split(np.arange(end), _PIECES)):
                if len(piece):
                    nodes = products[piece[0] : piece[-1] + 2]
                    mean = nodes.mean(axis=0)
                    deviations = of_cells(np.linalg.norm(nodes - mean, axis=(1, 2))) + sag
                    deviation += s * self.cell_s * float(deviations.sum())
                    means[number] = mean * self.cell_s * len(piece)
            ends = undriven + np.einsum("sp,pij->sij", signs, means)
            stretches.append((float(_norms(ends).max()) + deviation) * ROUNDING)
            if stretches[-1] >= 1:  # of no use: the other gaps do not matter
                break
        return np.array(stretches + stretches[-1:] * (len(moved) - len(stretches)))

    def _age_bends(self, shape: Matrix, inverse: Matrix) -> tuple[Vector, Vector]:
        """Bound, over each cell, how far ‖w‖ may lie above its nodes, and from the first order."""
        s, H, G = self.conditions.hold_s, self.H, self.scaled_H
        if s == 0:
            return np.zeros(self.cells), np.zeros(self.cells)
        outputs = Outputs({"τ": self.R @ H @ H, "r": self.R @ H @ G @ G})
        kernels = response_until(G, inverse, self.until_s, self.cells).through_each(outputs)
        # e^{−Hτ} commutes with e^{Hr}.
        models = [response_until(generator, inverse, s).through(shape).sup_on_grid() for generator in (H, -H)]
        second = max(map(float, models)) * kernels["τ"].highest
        turned = max(map(float, models)) * kernels["r"].highest
        bends = (s / _AGES) ** 2 / 8 * second + self.cell_s**2 / 8 * s * turned
        return np.asarray(bends), np.asarray(s**2 / 2 * second)


def _norms(matrices: Stack) -> Stack:
    """Return ‖·‖ of matrices, (…, q, n)."""
    return np.asarray(np.linalg.norm(matrices, 2, axis=(-2, -1)))


def of_cells(values: Stack) -> Stack:
    """Return the larger of the values at both ends of each cell."""
    return np.asarray(np.maximum(values[..., :-1], values[..., 1:]))
