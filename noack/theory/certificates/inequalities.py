"""The inequalities (I1) of a certificate, solved for an assumed spacing of events.

Assumptions: the trigger ‖e_s‖_W > βe^{−αt} is tested at least every h seconds, the network keeps
its guarantee about losses, and the input is held. With all signals scaled by e^{αt}:

    sup‖C e_c‖  ≤ (‖C W⁻¹‖ + Σ_{j<N} sup_{τ≥jδ} ‖C e^{(H+αI)τ} W⁻¹‖) β̃ = D_C β̃          (I1)
    sup‖C x‖    ≤ free_C + gain_C q + Γ_C β̃,   Γ_C ≤ gain_C D_K       (plant, input error p)
    q           ≤ Σ_{C = σKH, ½σ²KH², r(σ)W} (sup‖C x‖ + D_C β̃)       (input of age ≤ σ)
    π = sup‖p‖  ≤ D_K β̃ + q
    β̃ = sup‖e_s‖_W ≤ ḡβ + I_E sup‖R_E x‖ + I_B π                      (between two tests)

with at most N missing events: the longest burst of losses, and ⌈d/δ⌉ in flight. A policy's
threshold may contain more than β (:mod:`noack.theory.bounds.trigger_bounds`). These inequalities
are linear in q and β̃ and hold on every [0, T]. So their solution bounds the run if the loop gain
is below 1.

**Solution.** For v ≤ F v + g with F, g ≥ 0: if some w > 0 has F w < w, the spectral radius of F is
below 1, and v ≤ x for every x with x − F x ≥ g. Both are checked with a bound of all rounding, so
nothing depends on how w and x were computed. x begins as the computed (I − F)⁻¹ g. Where x − F x
misses g by r, adding w max r/(w − F w) is enough.

**Losses in windows.** Γ_C is smaller if few updates may be lost in a window. A lost event k moves
the input error by K e^{(H+αI)(s−t_k)} e_s(t_k⁻) until an update arrives, so it moves C x by at most
β̃ c(t − t_k), with

    c(τ) = ∫_d^τ k(τ−s) g(s) ds,   k(τ) = ‖C e^{(A+BK+αI)τ} B U‖,   g(τ) = ‖R e^{(H+αI)τ} W⁻¹‖

Its first d seconds count as those of an update in flight. Events are at least δ apart: n·δ seconds
contain at most n of them. If at most m of n consecutive updates are lost, the sum of c(t − t_k) is
at most, in each n·δ seconds of age, the sum of the m largest of the suprema over δ seconds. The
kernels are enclosed on a common grid of equal cells. For τ in a cell, a cell of k meets the ages of
two cells of g. Beyond the grid, c(τ) is at most sup_{s ≥ τ/2} g(s) ∫k + sup g ∫_{s ≥ τ/2} k, and
both kernels fall exponentially there.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Vector
from noack.impairments.loss_guarantee import LossWindow
from noack.theory.bounds.enclosure import KernelBounds
from noack.theory.bounds.gains import Coefficients, Output, PlantGains
from noack.theory.bounds.terms import Constants, NetworkConditions, NoCertificateError, Part
from noack.theory.bounds.trigger_bounds import (
    COARSE_CELLS,
    ErrorGrowth,
    first_passage_s,
    list_growths,
)

_SIGNALS = 6
_CELLS = 2048
_MOST_BINS = 1 << 16
_ROUNDING = 1 + 1e-9
_EPSILON = float(np.finfo(float).eps)


class Solution(NamedTuple):
    """The bound of v, if there is one."""

    loop_gain: float
    """1 minus the smallest leading principal minor of I − F; below 1 if and only if ρ(F) < 1. If it
    is not below 1: at least the largest entry of the diagonal."""
    bound: Vector | None
    """Upper bound of v, (k,); None if ρ(F) < 1 was not confirmed."""


def solve_inequalities(F: Matrix, g: Vector) -> Solution:
    """Return the smallest bound of v that follows, for F of shape (k, k) and g of shape (k,)."""
    F = np.where(F.any(axis=1) | (g > 0), F, 0.0)  # a signal that is 0 affects nothing
    sizes = g + F @ (g + F @ g)  # a right side of the size of x makes w/x dimensionless
    least = sizes[sizes > 0].min(initial=math.inf)
    least = least if math.isfinite(least) else 1.0
    remainder = np.eye(len(g)) - F
    minors, (x, w) = _eliminated(remainder, g, np.where(sizes > 0, sizes, least))
    loop_gain = 1 - min(minors)
    if not loop_gain < 1:
        minors = [np.linalg.det(remainder[:k, :k]) for k in range(1, len(g) + 1)]
        gains = [1 - min(minors), *np.diagonal(F)]
        return Solution(max(1.0, *gains) if np.isfinite(gains).all() else math.inf, None)
    rounding = (len(g) + 4) * _EPSILON
    moved_x, moved_w = F @ x, F @ w
    slack = w - moved_w - rounding * (w + moved_w)
    if not (w > 0).all() or not (slack > 0).all():
        return Solution(loop_gain, None)
    missing = moved_x + g - x + rounding * (moved_x + g + x)
    bound = x + w * max(float((missing / slack).max()), 0.0) * (1 + rounding)
    return Solution(loop_gain, np.where(F.any(axis=1), bound, g))


def _eliminated(matrix: Matrix, *right_sides: Vector) -> tuple[list[float], list[Vector]]:
    """Return the leading principal minors up to the first one not above 0, and the solutions.

    The elimination is that of Gauss without exchanges, in floats: the matrices are tiny.
    """
    size, minors = len(matrix), [1.0]
    rows = np.column_stack([matrix, *right_sides]).tolist()
    for k in range(size):
        minors.append(minors[-1] * rows[k][k])
        if not minors[-1] > 0:
            return minors, [np.full(size, np.nan) for _ in right_sides]
        rows[k] = [value / rows[k][k] for value in rows[k]]
        for i in range(size):
            if i != k and (share := rows[i][k]):
                rows[i] = [value - share * own for value, own in zip(rows[i], rows[k], strict=True)]
    return minors[1:], list(np.array(rows)[:, size:].T)


@dataclass(frozen=True)
class LossAccumulation:
    """The bounds of one plant for lost updates that count from the age ``delay_s`` on."""

    plant: PlantGains
    delay_s: float

    def total(self, output: str, spacing_s: float, windows: Sequence[LossWindow]) -> float:
        """Return the bound of sup‖C x‖ / β̃ from all lost updates; infinite if it is not found."""
        bins = math.ceil(self._until_s / spacing_s) if spacing_s > 0 else _MOST_BINS
        if bins >= _MOST_BINS:
            return math.inf
        highest = _over_bins(self._effects[output], spacing_s / self._cell_s, bins)
        return min(self._total(output, highest, spacing_s, window) for window in windows)

    def _total(self, output: str, highest: Vector, spacing_s: float, window: LossWindow) -> float:
        most, packets = window
        if most == 0:
            return 0.0
        blocks = -(-len(highest) // packets)
        padded = np.zeros(blocks * packets)
        padded[: len(highest)] = highest
        ranked = np.sort(padded.reshape(blocks, packets), axis=1)[:, ::-1]
        beyond = self._beyond(output, most, packets * spacing_s)
        return float(ranked[:, :most].sum()) * _ROUNDING + beyond

    @cached_property
    def _kernels(self) -> tuple[KernelBounds, Mapping[str, KernelBounds]]:
        """The kernel g and the k of every output, over all times."""
        return self.plant.error.kernels[Output.GAIN], self.plant.forced

    @cached_property
    def _until_s(self) -> float:
        """End of the grid: beyond half of it, all kernels are bounded by exponentials."""
        g, forced = self._kernels
        ends_s = [g.edges_s[-1], *(k.edges_s[-1] for k in forced.values())]
        return 2 * float(max(ends_s))

    @property
    def _cell_s(self) -> float:
        return self._until_s / _CELLS

    @cached_property
    def _effects(self) -> Mapping[str, Vector]:
        """The bound of c over each cell, for every output."""
        g, areas = self.plant.on_grid(self._until_s, _CELLS)
        g = np.where(np.arange(1, _CELLS + 1) * self._cell_s > self.delay_s, g, 0.0)
        ages = np.maximum(g, np.append(0.0, g[:-1]))
        return {output: np.convolve(area, ages)[:_CELLS] for output, area in areas.items()}

    def _beyond(self, output: str, most: int, block_s: float) -> float:
        """Bound the sum over the losses that are older than the grid: a falling function f of age.

        The blocks that begin beyond it contribute at most m f(T) + m/block ∫_T^∞ f.
        """
        g, forced = self._kernels
        k, half_s = forced[output], self._until_s / 2
        total = 0.0
        for kernel, level in (
            (g, g.tail_highest * k.integral()),
            (k, k.tail_area * g.sup()),
        ):
            rate = kernel.tail_rate_per_s
            first = level * math.exp(-rate * (half_s - float(kernel.edges_s[-1])))
            total += most * first * (1 + 2 / (rate * block_s))
        return total


def _over_bins(cells: Vector, per_bin: float, bins: int) -> Vector:
    """Return the largest value of the cells that meet each bin; a bin has ``per_bin`` cells."""
    edges = np.minimum(np.floor(np.arange(bins + 1) * per_bin), len(cells) - 1).astype(np.int64)
    return np.asarray(np.maximum(np.maximum.reduceat(cells, edges[:-1]), cells[edges[1:]]))


class BoundMethod(Enum):
    """How e_c is bounded. Bounds of parts may be added only if they use the same method."""

    MISSING = "by e_s and by the errors of all missing events"
    DRIFTING = "by its value d ago, and by what has driven it since"


class ErrorInequalities:
    """The inequalities of one part, and their solution for an assumed spacing of events."""

    def __init__(self, part: Part, conditions: NetworkConditions, earlier_error: float) -> None:
        self._error, self._plant, self._bound, self._estimation = error, plant, bound, _ = part
        self._conditions = conditions
        self._lost: LossAccumulation | None = None
        self._remainder = error.hold_remainder(conditions.hold_s)
        self._start_error, start = plant.start_up(conditions.start_s)
        self._beyond = max(self._start_error, earlier_error)
        self._states = {
            output: Coefficients(free + start[output], gain)
            for output, (free, gain) in plant.states.items()
        }
        self._growths = [
            list_growths(plant, conditions.sampling_s, part_bound) for part_bound in bound.every
        ]

    def use_windows(self) -> None:
        """Use how many updates may be lost in a window, too."""
        if self._error.decays:
            self._lost = LossAccumulation(self._plant, self._conditions.delay_s)

    @property
    def methods(self) -> Sequence[BoundMethod]:
        """The methods by which e_c can be bounded."""
        if self._conditions.delay_s > 0 and self._error.decays:
            return [*BoundMethod]
        return [BoundMethod.MISSING]

    def constants(self, spacing_s: float, method: BoundMethod) -> Constants:
        """Return all constants but δ, given inter-event times of at least ``spacing_s``.

        Raises:
            NoCertificateError: the loop gain is not below 1.
        """
        events = self._missing(spacing_s)
        if method is BoundMethod.DRIFTING:
            return self._constants(self._drifting(spacing_s), events, spacing_s)
        error = self._error
        bound = _ErrorBound(
            {output: error.now(output) for output in error.outputs},
            {output: self._missing_gain(output, events, spacing_s) for output in error.outputs},
            self._missing_gain(Output.GAIN, events - self._conditions.dropouts, spacing_s),
        )
        return self._constants(bound, events, spacing_s)

    def _drifting(self, spacing_s: float) -> "_ErrorBound":
        """Return the bound of e_c by its value d ago, and by what has driven it since.

        d ago, e_c consisted of e_s and of the errors of events that are lost.
        """
        error, dropouts, kernels = self._error, self._conditions.dropouts, self._error.kernels
        return _ErrorBound(
            {output: kernel.sup() for output, kernel in kernels.items()},
            {output: error.missing(output, dropouts, spacing_s) for output in kernels},
            0.0,
            self._drift,
        )

    @cached_property
    def _drift(self) -> Mapping[Output, tuple[float, float, float]]:
        growths = self._plant.growths(self._conditions.delay_s, COARSE_CELLS)
        return {output: growth.totals for output, growth in growths.items()}

    def _constants(self, bound: "_ErrorBound", events: int, spacing_s: float) -> Constants:
        from_errors = self._from_errors(bound, spacing_s)
        signals = self._signals(bound, from_errors)
        loop_gain, solved = self._solved(signals)
        sensor_error = float(solved[1] + solved[2])
        state = dict(zip(self._states, signals.free + signals.states @ solved, strict=True))
        return Constants(
            self._error.alpha_per_s,
            events,
            float(signals.errors[Output.WEIGHTED] @ solved + solved[2]) / self.unit,
            sensor_error / self.unit,
            float(signals.errors[Output.GAIN] @ solved + solved[0]),
            self._start_error,
            float(state[Output.STATE]),
            float(state[Output.WEIGHTED]),
            float(state[Output.MISMATCH]),
            None,
            loop_gain,
            float(solved[2]),
            float(self._error.now(Output.GAIN) * solved[1] + solved[0]),
        )

    @property
    def unit(self) -> float:
        """The unit of Δ and β̃/β."""
        return self._bound.beta if self._bound.unit is None else self._bound.unit

    def _signals(self, bound: "_ErrorBound", from_errors: Mapping[str, float]) -> "_Signals":
        """Return how all outputs depend on (q, β̃, η, π, sup‖R_E x‖, 1).

        An event's x_s − x̂ is at most β̃ + η, the present x_s − x at most β̃.
        """
        free = np.array([state.free for state in self._states.values()])
        still = (0.0, 0.0, 0.0)
        by_input = np.array(bound.drift.get(Output.GAIN, still))
        present = bound.present[Output.GAIN]
        states = [
            (gain, from_errors[name], from_errors[name] - gain * present, *(gain * by_input))
            for name, (_, gain) in self._states.items()
        ]
        errors = {
            output: np.array([0.0, now + gone, gone, *bound.drift.get(output, still)])
            for (output, now), gone in zip(
                bound.present.items(), bound.missing.values(), strict=True
            )
        }
        return _Signals(list(self._states), free, np.array(states), errors)

    def _solved(self, signals: "_Signals") -> tuple[float, Vector]:
        """Return the loop gain and the bounds of the signals.

        Raises:
            NoCertificateError: the loop gain is not below 1.
        """
        free, errors = signals.free, signals.errors
        hold_s = self._conditions.hold_s
        held: dict[str, float] = {
            Output.GAIN_RATE: hold_s,
            Output.GAIN_CURVATURE: hold_s**2 / 2,
            Output.WEIGHTED: self._remainder,
        }
        beyond = self._beyond
        held_input, _, estimated, *_ = np.eye(_SIGNALS)
        input_error = errors[Output.GAIN] + held_input

        through = signals.row(held)
        from_errors = sum(gain * errors[Output(output)] for output, gain in held.items())
        of_age = (through @ signals.states + from_errors, float(through @ free))
        estimation = self._estimation
        through = signals.row(estimation.shares)
        of_estimate = (
            through @ signals.states + estimation.from_input * input_error,
            estimation.fixed + float(through @ free) + estimation.from_input * beyond,
        )
        through = signals.row({Output.MISMATCH: 1.0})
        of_mismatch = (through @ signals.states, float(through @ free))
        others = ((input_error, beyond), of_mismatch, (0.0 * input_error, 1.0))

        def solved(growing: ErrorGrowth) -> Solution:
            through = signals.row(growing.shares)
            F = through @ signals.states + growing.input_error * input_error
            F += growing.estimation * estimated
            fixed = growing.fixed + through @ free + growing.input_error * beyond
            rows = (of_age, (F, fixed), of_estimate, *others)
            return solve_inequalities(*map(np.array, zip(*rows, strict=True)))

        # Of each bound one growth applies, and all bounds hold.
        solutions = [_largest([solved(growth) for growth in growths]) for growths in self._growths]
        gain = min(solution.loop_gain for solution in solutions)
        bounds = [solution.bound for solution in solutions if solution.bound is not None]
        if not bounds:
            raise NoCertificateError(
                f"the loop gain of the errors is {gain:.3g}, not below 1", gain
            )
        return gain, np.min(bounds, axis=0)

    def _missing_gain(self, output: Output, events: int, spacing_s: float) -> float:
        if self._error.decays or math.isinf(self._bound.due_s):
            return self._error.missing(output, events, spacing_s)
        return self._error.missing_until(output, events, self._bound.due_s)

    def _from_errors(self, bound: "_ErrorBound", spacing_s: float) -> Mapping[str, float]:
        """Return Γ_C for every output, from D_K and from the losses in windows.

        The second is computed only where it can be smaller: where all lost updates together have
        less effect than the longest burst at its largest.
        """
        present = bound.present[Output.GAIN] + bound.in_flight
        share = bound.present[Output.GAIN] + bound.missing[Output.GAIN]
        sizes = {output: gain * share for output, (_, gain) in self._states.items()}
        if self._lost is None:
            return sizes
        windows = self._conditions.guarantee.windows
        density = min(window.losses / window.packets for window in windows)
        lasting = density * self._error.kernels[Output.GAIN].integral()
        if not lasting < (share - present) * spacing_s:
            return sizes
        for output, (_, gain) in self._states.items():
            together = gain * present + self._lost.total(output, spacing_s, windows)
            sizes[output] = min(sizes[output], together)
        return sizes

    def inter_event_s(self, constants: Constants, method: BoundMethod) -> float:
        """Return the time that ‖e_s‖_W needs to the next event, given the constants until then."""
        # The part of D_K that is the e_s of now.
        own = 0.0 if method is BoundMethod.DRIFTING else self._error.now(Output.GAIN)
        sensor_error = constants.overshoot * self.unit - constants.estimation_error
        others = constants.input_error - own * sensor_error
        estimation = constants.estimation_error
        # After an event e_s is the estimation error, and x_s − x̂ differs from e_s by one, too.
        passages_s = [
            first_passage_s(
                self._plant,
                bound.reached - estimation,
                constants.mismatch,
                max(others, self._beyond),
                own,
                estimation,
            )
            for bound in self._bound.every
            if bound.reached is not None
        ]
        limits_s = [
            bound.ago_s or math.inf for bound in self._bound.every if bound.reached is not None
        ]
        found_s = max(map(min, passages_s, limits_s))
        found_s = max(min(found_s, self._bound.due_s), self._bound.apart_s)
        grid_s = self._conditions.spacing_s
        return found_s if grid_s == 0 else grid_s * max(1, math.ceil(found_s / grid_s - 1e-9))

    def _missing(self, spacing_s: float) -> int:
        dropouts, delay_s = self._conditions.dropouts, self._conditions.delay_s
        if delay_s == 0:
            return dropouts
        if spacing_s == 0:
            raise NoCertificateError(
                "events may be arbitrarily close, so that any number may be in flight"
            )
        return dropouts + math.ceil(delay_s / spacing_s)


class _ErrorBound(NamedTuple):
    """sup‖C e_c‖ ≤ (present_C + missing_C) β̃ + drift_C · (π, sup‖R_E x‖, 1), for every output C."""

    present: Mapping[Output, float]
    """The gain of e_s, now or where the drift begins."""
    missing: Mapping[Output, float]
    """The gain of the events that are missing then."""
    in_flight: float
    """The part of missing_K that is not lost."""
    drift: Mapping[Output, tuple[float, float, float]] = MappingProxyType({})
    """The gains of what has driven e_c since then; none without a delay."""


class _Signals(NamedTuple):
    """The outputs of x and e_c as linear functions of (q, β̃, η, π, sup‖R_E x‖, 1).

    η = sup‖x̂ − x‖_W.
    """

    names: list[str]
    free: Vector
    """(k,) the constant part of sup‖C x‖."""
    states: Matrix
    """(k, 6)"""
    errors: Mapping[Output, Vector]
    """(6,) of sup‖C e_c‖."""

    def row(self, gains: Mapping[str, float]) -> Vector:
        """Return gains of the outputs, by name, as an array (k,)."""
        return np.array([gains.get(name, 0.0) for name in self.names])


def _largest(solutions: Sequence[Solution]) -> Solution:
    """Return the larger of several solutions; no bound if one has none."""
    bounds = [solution.bound for solution in solutions if solution.bound is not None]
    gain = max(solution.loop_gain for solution in solutions)
    return Solution(gain, np.max(bounds, axis=0) if len(bounds) == len(solutions) else None)
