"""Gains of one gap between two delivered events, where events are due.

Let ξ = x at a delivered event, and z = (x, e_c) with e_c = 0 there. Until the next delivered event,
a time g later, and scaled by e^{αt},

    z' = F z + (B; −B) w,   F = [[A + BK, BK], [−E, H − BK]] + αI,   w = u − K(x + e_c)

If events are due, g is one of finitely many times. w is only what lateness adds: the age of the
applied input, ‖w‖ ≤ sup_{|τ|≤σ} ‖K(e^{−Hτ} − I)e^{Hr}ξ‖, and for a time d after the event, while the
update is in flight, the error e⁻ that it removes: ‖w‖ ≤ J = sup ‖K e^{H(r−τ)} e⁻‖ more. J is the
late effect of this update. S is the sum of the late effects of all updates in flight, each counted
by the share μ of its time that is left. All norms over cells of time are enclosed
(:mod:`noack.theory.bounds.enclosure`).
"""

import itertools
import math
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, Vector, exponential
from noack.theory.bounds.certificate_terms import NetworkConditions, NoCertificateError, TriggerBound
from noack.theory.bounds.enclosure import Outputs, response_until
from noack.theory.bounds.gains import Output, PlantGains
from noack.theory.bounds.stacked_norms import ROUNDING, Stack, larger_ends, spectral_norm

_MOST_GAPS, _MOST_CELLS = 256, 640
"""Limits of the times g between two deliveries, and of the cells: the work grows with their product."""
_CELL = 0.04
"""Length of a cell, in time constants of the flow."""
_PIECES = 4
"""Pieces of a gap in which the ages of the input are averaged: each one doubles the number of signs."""
_SIGNS = np.array(list(itertools.product((-1.0, 1.0), repeat=_PIECES)))
"""All signs of the mean ages in the pieces."""
_AGES = 4
"""Cells into which ages of an input from 0 to σ are divided; the sag between them falls with the square."""
_LEAST_THETA, _THETAS = 1e-6, 2.0 ** np.arange(0, 7)
"""θ that are tried, in units of the smallest one that may suit, which is at least ``_LEAST_THETA``."""
ERROR, INPUT = "e_c in W", "e_c in K"
"""Names of outputs of z."""


class Gaps(NamedTuple):
    """The times between two successive delivered events."""

    step_s: float
    """All of them are multiples of it."""
    counts: NDArray[np.int64]
    """The gaps in steps, ascending, (gaps,)."""
    least_s: float
    """The shortest one."""

    @classmethod
    def of(cls, conditions: NetworkConditions, bound: TriggerBound) -> "Gaps":
        """Return the times for events as far apart as a bound says.

        Raises:
            NoCertificateError: they are not covered.
        """
        most_events, step_s = conditions.dropouts + 1, conditions.spacing_s
        least_s = max(bound.times.shortest_s, step_s)
        if step_s == 0 or not math.isfinite(bound.times.longest_s):
            raise NoCertificateError("events are not due at sampling times")
        fewest_steps, most_steps = (
            math.floor(time_s / step_s + 1e-9) for time_s in (least_s, bound.times.longest_s)
        )
        if fewest_steps == most_steps:
            return cls(fewest_steps * step_s, np.arange(1, most_events + 1), fewest_steps * step_s)
        if most_events * most_steps > _MOST_GAPS:
            raise NoCertificateError("too many times between deliveries")
        counts = {n for j in range(1, most_events + 1) for n in range(j * fewest_steps, j * most_steps + 1)}
        return cls(step_s, np.array(sorted(counts)), fewest_steps * step_s)


class GapGrid(NamedTuple):
    """Cells of the time r since a delivery, from 0 until d after the longest gap."""

    cell_s: float
    cells: int
    late_cells: int
    """The cells up to d, while an update may be in flight."""
    ends: NDArray[np.int64]
    """The node at the end of each gap, (gaps,)."""
    windows: NDArray[np.int64]
    """The number of cells for which an update is still in flight, for each time at which its event may have
    been, (windows,)."""

    @classmethod
    def of(cls, gaps: Gaps, delay_s: float, fastest_per_s: float) -> "GapGrid":
        """Return cells that are short for the fastest mode: as many in each step of the gaps."""
        longest = int(gaps.counts[-1])
        per_step = math.ceil(gaps.step_s / min(_CELL / fastest_per_s, delay_s or math.inf) - 1e-9)
        per_step = max(min(per_step, _MOST_CELLS // (longest + 1)), 1)
        cell_s = gaps.step_s / per_step
        late_cells = math.ceil(delay_s / cell_s - 1e-9)
        event_cells = np.arange(0, late_cells or 1, per_step)
        event_cells = event_cells[(event_cells == 0) | (event_cells >= gaps.least_s / cell_s - 1e-9)]
        cells = longest * per_step + late_cells
        return cls(cell_s, cells, late_cells, gaps.counts * per_step, late_cells - event_cells)

    @property
    def until_s(self) -> float:
        """The end of the last cell."""
        return self.cells * self.cell_s

    @property
    def shares(self) -> Vector:
        """μ, by which J of the event of each window counts in S, (windows,)."""
        return self.windows / self.late_cells if self.late_cells else np.ones(1)

    @property
    def shares_left(self) -> Matrix:
        """μ of the same update after each gap, as a share of that before it, (gaps, windows)."""
        left = (self.windows - self.ends[:, None]).clip(min=0)
        return np.asarray(left / (self.late_cells or 1) / self.shares)

    def until_ends(self, areas: Vector) -> Matrix:
        """Return ∫k(g − r) over each cell of r, for each gap g, (gaps, cells); ``areas`` is ∫k."""
        distances = self.ends[:, None] - 1 - np.arange(self.cells)
        return np.asarray(np.where(distances >= 0, areas[distances.clip(min=0)], 0.0))

    def within_windows(self, areas: Stack) -> Stack:
        """Sum (…, cells) over the cells of each window, and divide by μ, (…, windows)."""
        sums = np.cumsum(areas, axis=-1)
        return np.asarray(np.where(self.windows > 0, sums[..., self.windows - 1], 0.0) / self.shares)


class GapGains(NamedTuple):
    """Gains of each gap: bounds after it, per unit of what they come from before it.

    ======  =============  ======================  ================================================
    Symbol  Bounds         Per unit of             Field
    ======  =============  ======================  ================================================
    γ_g     ‖Λξ‖           ‖Λξ‖                    ``state_from_state``
    k_g     ‖Λξ‖           S                       ``state_from_late_effects``
    j_g     J              ‖Λξ‖                    ``late_effect_from_state``
    l_g     S              S                       ``late_effect_from_late_effects``, of the next
                                                   update, + ``late_effects_left``, of earlier ones
    θ       weight of S in ‖Λξ‖ + θS               ``theta``
    ======  =============  ======================  ================================================

    The gains from ‖Λξ‖ include the age of the input. Arrays are (gaps,), unless a shape is given.
    """

    scaling: Matrix
    """Λ, (n, n)."""
    age_sags: Vector
    """How far ‖w‖ may lie above its values at nodes, from the age of the input, (cells,)."""
    age_input: Vector
    """‖w‖ in each cell from the age of the input, (cells,)."""
    state_from_state: Vector
    state_from_input: Matrix
    """∫‖ΛΨ‖ over each cell: ‖Λξ‖ for a ‖w‖ of 1 in this cell, (gaps, cells)."""
    state_from_late_effects: Vector
    late_effect_from_state: Vector
    late_effect_from_input: Matrix
    """J for a ‖w‖ of 1 in each cell, (gaps, cells)."""
    late_effect_from_late_effects: Vector
    late_effects_left: Vector
    weighted_sum_from_late_effects: Vector
    """‖Λξ‖/θ + S for S = 1."""
    theta: float
    largest: float
    """‖Λξ‖ + θS after any gap, at most, if it was 1."""


class GapLoop:
    """The loop between two deliveries; cells divide the time r since the first of them."""

    def __init__(self, plant: PlantGains, conditions: NetworkConditions, gaps: Gaps) -> None:
        self.plant, self.conditions, self.gaps, self.n = plant, conditions, gaps, len(plant.A)
        self.H, self.R = plant.error.H, plant.error.split_K[1]
        self.scaled_H = self.H + plant.alpha_per_s * np.eye(self.n)
        M, BK = plant.closed_loop, plant.B @ plant.error.K
        self.F = np.block([[M, BK], [self.scaled_H - M, self.scaled_H - BK]])
        self.input_by_state = np.vstack([BK, -BK])
        """(B; −B) K"""
        self.starts_late = conditions.start_s > gaps.least_s * ROUNDING
        # An update may be in flight for d; what is delivered before the first input, until then.
        d = conditions.delay_s
        self.delay_s = max(d, conditions.start_s) if self.starts_late else d
        self.grid = GapGrid.of(gaps, self.delay_s, float(np.abs(np.linalg.eigvals(self.F)).max()))
        self.flows = self._powers(self.F)[:, :, : self.n]
        """e^{Fr} (I; 0) at all nodes, (cells + 1, 2n, n)."""
        no_state, no_input = np.zeros((self.n, self.n)), np.zeros_like(self.R)
        self.outputs = {
            ERROR: np.hstack([no_state, plant.error.weight]),
            INPUT: np.hstack([no_input, self.R]),
        }
        """C of the outputs C z that are bounded."""
        for name in (Output.STATE, Output.WEIGHTED, Output.MISMATCH):
            self.outputs[name] = np.hstack([plant.outputs[name], 0 * plant.outputs[name]])
        self.feedthrough = np.array([[float(name == INPUT)] for name in self.outputs])
        """1 for the output that contains w itself, (outputs, 1)."""
        # What drives z: a w at any time, and the age of the input for each τ from −σ to σ.
        BU = plant.input_matrix
        self._response = response_until(self.F, np.vstack([BU, -BU]), self.grid.until_s, self.grid.cells)
        s = conditions.hold_s
        at_event = [
            self.R @ (exponential(-self.H * (s * k / _AGES)) - np.eye(self.n))
            for k in range(-_AGES, _AGES + 1)
        ]
        self.input_by_age = np.array(at_event) @ self._powers(self.scaled_H)[:, None]
        """R(e^{−Hτ} − I)e^{Hr} at nodes of r and τ, (cells + 1, ages, q, n)."""

    def _powers(self, generator: Matrix) -> Stack:
        """Return the exponentials at all nodes, (cells + 1, …)."""
        step, powers = exponential(generator * self.grid.cell_s), [np.eye(len(generator))]
        for _ in range(self.grid.cells):
            powers.append(step @ powers[-1])
        return np.array(powers)

    @cached_property
    def late_effect_rows(self) -> tuple[Stack, float]:
        """C and b with J ≤ max_i ‖C_i e⁻‖ + b ‖e⁻‖_W, (nodes, q, n) and a number.

        C_i = e^{αd} R e^{Hu} at nodes of u from −σ to d + σ; b is for u between two nodes.
        """
        d, s, H = self.delay_s, self.conditions.hold_s, self.H
        grown = math.exp(self.plant.alpha_per_s * d)
        nodes_s = np.linspace(-s, d + s, 4 * _AGES + 1)
        bend = 0.0
        for G, until_s in ((H, d + s), (-H, s)):
            response = response_until(G, self.plant.error.inverse_weight, until_s or 1e-9)
            bend = max(bend, float(response.through(self.R @ H @ H).sup_on_grid()))
        sag = grown * float(nodes_s[1] - nodes_s[0]) ** 2 / 8 * bend
        nodes = [grown * self.R @ exponential(H * u_s) for u_s in nodes_s.tolist()]
        return np.array(nodes), sag * ROUNDING

    def late_effects(self, errors: Matrix) -> Vector:
        """Bound J for errors e⁻, (k, n)."""
        nodes, sag = self.late_effect_rows
        at_nodes = np.linalg.norm(np.einsum("iqn,kn->kiq", nodes, errors), axis=-1).max(axis=-1)
        weighted = np.linalg.norm(errors @ self.plant.error.weight.T, axis=-1)
        return np.asarray((at_nodes + sag * weighted) * ROUNDING)

    @cached_property
    def late_effect_outputs(self) -> dict[str, Matrix]:
        """C of outputs of z; J is at most the largest of all but the last one, plus the last one."""
        nodes, sag = self.late_effect_rows
        rows = [*nodes, sag * self.plant.error.weight]
        return {f"{number}": np.hstack([0 * C, C]) for number, C in enumerate(rows)}

    @cached_property
    def late_effect_areas(self) -> Vector:
        """Bound ∫J over each cell, for J as what z = e^{Fr} (B; −B) U causes."""
        kernels = self._response.through_each(Outputs(self.late_effect_outputs))
        *nodes, weighted = (kernel.area for kernel in kernels.values())
        return np.asarray(np.max(nodes, axis=0) + weighted)

    @cached_property
    def input_responses(self) -> Stack:
        """∫‖C e^{F(s−r)} (B; −B) U‖ over r in each cell, for s in each, (outputs, s, r)."""
        distances = np.subtract.outer(np.arange(self.grid.cells), np.arange(self.grid.cells))
        areas = []
        for kernel in self._response.through_each(Outputs(self.outputs)).values():
            previous = np.append(kernel.highest[:1], kernel.highest[:-1])
            largest = np.maximum(kernel.highest, previous) * self.grid.cell_s * ROUNDING
            areas.append(np.where(distances >= 0, largest[distances.clip(min=0)], 0.0))
        return np.array(areas)

    def gains(self, scaling: Matrix) -> GapGains:
        """Return the gains of each gap for a Λ."""
        grid, inverse = self.grid, np.asarray(np.linalg.inv(scaling))
        # ‖w‖ from the age of the input.
        age_sags, second_order = self._age_sags(scaling, inverse)
        age_input = (
            larger_ends(spectral_norm(self.input_by_age @ inverse).max(axis=1)) + age_sags
        ) * ROUNDING
        # From any w.
        state_from_input = grid.until_ends(self._response.through(np.hstack([scaling, 0 * scaling])).area)
        late_effect_from_input = grid.until_ends(self.late_effect_areas)
        # From ξ: J is that of the error at the end of the gap, which the next update removes.
        state_from_state = self._state_gains(scaling, inverse) + state_from_input @ second_order
        errors = self.flows[grid.ends, self.n :] @ inverse
        nodes, sag = self.late_effect_rows
        without_ages = spectral_norm(nodes @ errors[:, None]).max(axis=1)
        without_ages = without_ages + sag * spectral_norm(self.plant.error.weight @ errors)
        late_effect_from_state = without_ages * ROUNDING + late_effect_from_input @ age_input
        # From the update of each window, (gaps, windows), of which the largest counts.
        state_by_window = grid.within_windows(state_from_input)
        late_effect_by_window = grid.within_windows(late_effect_from_input)
        theta, largest, weighted_sums = _best_theta(
            state_from_state, late_effect_from_state, state_by_window, late_effect_by_window, grid.shares_left
        )
        return GapGains(
            scaling=scaling,
            age_sags=age_sags,
            age_input=age_input,
            state_from_state=state_from_state,
            state_from_input=state_from_input,
            state_from_late_effects=state_by_window.max(axis=1),
            late_effect_from_state=late_effect_from_state,
            late_effect_from_input=late_effect_from_input,
            late_effect_from_late_effects=late_effect_by_window.max(axis=1),
            late_effects_left=grid.shares_left.max(axis=1),
            weighted_sum_from_late_effects=weighted_sums,
            theta=theta,
            largest=largest,
        )

    def _state_gains(self, scaling: Matrix, inverse: Matrix) -> Vector:
        """Bound ‖Λξ‖ after each gap with ages to first order, (gaps,).

        w = −τ KHe^{Hr}ξ. In a few pieces of a gap, Ψ(g − r) KHe^{Hr} is replaced by its mean; then
        only the mean of τ counts, and a norm is largest for means of ±σ.
        """
        grid, F, G = self.grid, self.F, self.scaled_H
        without_ages = scaling @ self.flows[grid.ends, : self.n] @ inverse
        if self.conditions.hold_s == 0 or not self.H.any():
            return spectral_norm(without_ages) * ROUNDING
        # By how much the products at the nodes may differ from those between them.
        input_rate = self.input_by_state @ self.H
        row = np.hstack([scaling, 0 * scaling])
        Y = F @ F @ input_rate - 2 * F @ input_rate @ G + input_rate @ G @ G
        bend = response_until(F, Y @ inverse, grid.until_s, grid.cells).through(row).sup_on_grid()
        models = response_until(G, inverse, grid.until_s, grid.cells).through(scaling).sup_on_grid()
        sag = grid.cell_s**2 / 8 * float(bend) * float(models)
        # The products Ψ(g − r) KHe^{Hr} at the nodes of each gap.
        left = row @ self._powers(F) @ input_rate
        right = self._powers(G) @ inverse
        gains = list[float]()
        for end, map_without_ages in zip(grid.ends.tolist(), without_ages, strict=True):
            products = left[end::-1] @ right[: end + 1]
            gains.append(self._gain_with_mean_ages(map_without_ages, products, sag))
            if gains[-1] >= 1:  # of no use: the other gaps do not matter
                break
        return np.array(gains + gains[-1:] * (len(without_ages) - len(gains)))

    def _gain_with_mean_ages(self, without_ages: Matrix, products: Stack, sag: float) -> float:
        """Bound ‖Λξ‖ after one gap by the products at its nodes: by their means, and the deviations."""
        s, cell_s = self.conditions.hold_s, self.grid.cell_s
        deviation = 0.0
        means = np.zeros((_PIECES, self.n, self.n))
        for number, piece in enumerate(np.array_split(np.arange(len(products) - 1), _PIECES)):
            if len(piece):
                nodes = products[piece[0] : piece[-1] + 2]
                mean = nodes.mean(axis=0)
                deviations = larger_ends(np.linalg.norm(nodes - mean, axis=(1, 2))) + sag
                deviation += s * cell_s * float(deviations.sum())
                means[number] = mean * cell_s * len(piece)
        ends = without_ages + np.einsum("sp,pij->sij", s * _SIGNS, means)
        return (float(spectral_norm(ends).max()) + deviation) * ROUNDING

    def _age_sags(self, scaling: Matrix, inverse: Matrix) -> tuple[Vector, Vector]:
        """Bound, over each cell, how far ‖w‖ may lie above its nodes, and from the first order."""
        s, grid = self.conditions.hold_s, self.grid
        H, G = self.H, self.scaled_H
        if s == 0:
            return np.zeros(grid.cells), np.zeros(grid.cells)
        outputs = Outputs({"τ": self.R @ H @ H, "r": self.R @ H @ G @ G})
        kernels = response_until(G, inverse, grid.until_s, grid.cells).through_each(outputs)
        # e^{−Hτ} commutes with e^{Hr}.
        models = [
            response_until(generator, inverse, s).through(scaling).sup_on_grid() for generator in (H, -H)
        ]
        bend_by_age = max(map(float, models)) * kernels["τ"].highest
        bend_by_time = max(map(float, models)) * kernels["r"].highest
        sags = (s / _AGES) ** 2 / 8 * bend_by_age + grid.cell_s**2 / 8 * s * bend_by_time
        return np.asarray(sags), np.asarray(s**2 / 2 * bend_by_age)


def _best_theta(
    state_from_state: Vector,
    late_effect_from_state: Vector,
    state_by_window: Matrix,
    late_effect_by_window: Matrix,
    shares_left: Matrix,
) -> tuple[float, float, Vector]:
    """Return the θ that lets ‖Λξ‖ + θS grow least, by how much, and ‖Λξ‖/θ + S for S = 1, (gaps,).

    The gains from ξ are (gaps,), those from S (gaps, windows).
    """
    # ‖Λξ‖/θ + S for each θ: S = 1 is the effect of the worst window.
    least = state_by_window / (1 - late_effect_by_window - shares_left).clip(min=1e-9)
    thetas = (float(least.max()) * ROUNDING or _LEAST_THETA) * _THETAS[:, None]
    by_window = state_by_window / thetas[..., None] + late_effect_by_window + shares_left
    weighted_sums = by_window.max(axis=-1)
    gains = np.maximum(state_from_state + thetas * late_effect_from_state, weighted_sums).max(axis=1)
    best = int(gains.argmin())
    return float(thetas[best, 0]), float(gains[best]), weighted_sums[best]
