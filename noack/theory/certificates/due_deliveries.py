"""Bounds of a loop whose events are at most some time apart, by what x can be at a delivery.

Let ξ = x at a delivered event, and z = (x, e_c) with e_c = 0 there. Until the next delivered event,
a time g later, and scaled by e^{αt},

    z' = F z + (B; −B) w,   F = [[A + BK, BK], [−E, H − BK]] + αI,   w = u − K(x + e_c)

If events are due, g is one of finitely many times. w is only what lateness adds: the age of the
applied input, ‖w‖ ≤ sup_{|τ|≤σ} ‖K(e^{−Hτ} − I)e^{Hr}ξ‖, and for a time d after the event the error
e⁻ that the update removes, ‖w‖ ≤ J = sup ‖K e^{H(r−τ)} e⁻‖ more. So of every time t at which there
may be a delivered event a ball ‖Λ(ξ − c)‖ ≤ ρ and a bound J follow from those a time g before:

    ρ(t) = max_g ‖Λ(Φ_g c − c(t))‖ + γ_g ρ + ∫‖ΛΨ‖ ‖w‖,      Φ_g = (I 0) e^{Fg} (I; 0)

The c are any points; they follow the loop. This goes on until ‖Λξ‖ + θJ, which no further step
increases, is so small that the bounds of the times before it are the largest ones. All norms over
cells of time are enclosed (:mod:`noack.theory.bounds.enclosure`).
"""

import contextlib
import itertools
import math
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, Vector, exponential, spectral_abscissa
from noack.theory.bounds.contraction import Stack
from noack.theory.bounds.enclosure import KernelBounds, NotDecayingError, Outputs, response_until
from noack.theory.bounds.gains import Output, PlantGains
from noack.theory.bounds.terms import Constants, NetworkConditions, NoCertificateError, TriggerBound
from noack.theory.bounds.trigger_bounds import ErrorGrowth

_ROUNDING = 1 + 1e-9
_MOST_GAPS, _MOST_CELLS, _MOST_TIMES = 256, 640, 6000
_CELL = 0.04
"""Length of a cell, in time constants of the flow."""
_PIECES = 4
"""In so many pieces of a gap the ages of the input are averaged."""
_AGES = 4
"""Cells into which ages of an input from 0 to σ are divided."""
_SHIFTS, _LEAST, _THETAS = (0.9, 0.7, 0.4), 1e-6, 2.0 ** np.arange(0, 7)
"""Decay rates of Λ that are tried, as shares of that of the scaled A + BK."""
_AT_ONCE, _CENTRED = 64, 3
_ERROR, _INPUT = "e_c in W", "e_c in K"


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


class _Norm(NamedTuple):
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
    late: Vector
    """J of the next event, with the age of the input."""
    late_aged: Matrix
    """The part of J of the next event that a w of 1 in each cell causes."""
    pulse: Vector
    """‖Λξ‖ after a gap, J of the next event, and what is left of S, for S = 1."""
    late_pulse: Vector
    remaining: Vector
    weighted_sum: Vector
    """‖Λξ‖/θ + S after a gap for S = 1."""
    theta: float
    """θ"""
    gain: float
    """‖Λξ‖ + θS after a gap, at most, if it was 1."""


class _Loop:
    """The loop between two deliveries; cells divide the time r since the first of them."""

    def __init__(self, plant: PlantGains, conditions: NetworkConditions, gaps: Gaps) -> None:
        self.plant, self.conditions, self.gaps, self.n = plant, conditions, gaps, len(plant.A)
        self.H, self.R = plant.error.H, plant.error.split_K[1]
        self.scaled_H = self.H + plant.alpha_per_s * np.eye(self.n)
        M, BK = plant.closed_loop, plant.B @ plant.error.K
        self.F = np.block([[M, BK], [self.scaled_H - M, self.scaled_H - BK]])
        self.BK = np.vstack([BK, -BK])
        fastest = float(np.abs(np.linalg.eigvals(self.F)).max())
        d, longest = conditions.delay_s, int(gaps.counts[-1])
        self.starts_late = conditions.start_s > gaps.least_s * _ROUNDING
        if self.starts_late:  # what is delivered before the first input stays in flight until then
            d = max(d, conditions.start_s)
        self.delay_s = d
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
        no_state, no_input = np.zeros((self.n, self.n)), np.zeros_like(self.R)
        self.outputs = {
            _ERROR: np.hstack([no_state, plant.error.weight]),
            _INPUT: np.hstack([no_input, self.R]),
        }
        for name in (Output.STATE, Output.WEIGHTED, Output.MISMATCH):
            self.outputs[name] = np.hstack([plant.outputs[name], 0 * plant.outputs[name]])
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
    def late(self) -> tuple[Matrix, float]:
        """C and b with J ≤ max_i ‖C_i e⁻‖ + b ‖e⁻‖_W, C of shape (nodes, q, n).

        C_i = e^{αd} R e^{Hu} at nodes of u from −σ to d + σ.
        """
        d, s, H = self.delay_s, self.conditions.hold_s, self.H
        grown = math.exp(self.plant.alpha_per_s * d)
        nodes_s = np.linspace(-s, d + s, 4 * _AGES + 1)
        curvature = 0.0
        for G, until_s in ((H, d + s), (-H, s)):
            response_ = response_until(G, self.plant.error.inverse_weight, until_s or 1e-9)
            curvature = max(curvature, float(response_.through(self.R @ H @ H).sup_on_grid()))
        bend = grown * float(nodes_s[1] - nodes_s[0]) ** 2 / 8 * curvature
        nodes = [grown * self.R @ exponential(H * u_s) for u_s in nodes_s.tolist()]
        return np.array(nodes), bend * _ROUNDING

    def late_sizes(self, errors: Matrix) -> Vector:
        """Bound J for errors e⁻, (k, n)."""
        nodes, bend = self.late
        sizes = np.linalg.norm(np.einsum("iqn,kn->kiq", nodes, errors), axis=-1).max(axis=-1)
        weighted = np.linalg.norm(errors @ self.plant.error.weight.T, axis=-1)
        return np.asarray((sizes + bend * weighted) * _ROUNDING)

    @cached_property
    def late_outputs(self) -> dict[str, Matrix]:
        """C of the outputs whose largest one bounds J."""
        nodes, bend = self.late
        rows = [*nodes, bend * self.plant.error.weight]
        return {f"{number}": np.hstack([0 * C, C]) for number, C in enumerate(rows)}

    @cached_property
    def late_areas(self) -> Vector:
        """Bound ∫J over each cell, for J as what z = e^{Fr} (B; −B) U causes."""
        kernels = self._response.through_each(Outputs(self.late_outputs))
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
    def driven(self) -> Stack:
        """∫‖C e^{F(s−r)} (B; −B) U‖ over r in each cell, for s in each, (outputs, s, r)."""
        distances = np.subtract.outer(np.arange(self.cells), np.arange(self.cells))
        areas = []
        for kernel in self._response.through_each(Outputs(self.outputs)).values():
            previous = np.append(kernel.highest[:1], kernel.highest[:-1])
            largest = np.maximum(kernel.highest, previous) * self.cell_s * _ROUNDING
            areas.append(np.where(distances >= 0, largest[distances.clip(min=0)], 0.0))
        return np.array(areas)

    def norm(self, shape: Matrix) -> _Norm:
        """Return what one gap makes of ‖Λξ‖ ≤ 1."""
        inverse = np.asarray(np.linalg.inv(shape))
        bends, curved = self._age_bends(shape, inverse)
        ages = _of_cells(_norms(self.aged @ inverse).max(axis=1)) + bends
        ages = ages * _ROUNDING
        lost = self.flows[self.ends, self.n :] @ inverse
        nodes, bend = self.late
        late = _norms(nodes @ lost[:, None]).max(axis=1)
        late = late + bend * _norms(self.plant.error.weight @ lost)
        late_aged = self.at_ends(self.late_areas)
        late = late * _ROUNDING + late_aged @ ages
        aged = self.at_ends(self._response.through(np.hstack([shape, 0 * shape])).area)
        stretch = self._stretch(shape, inverse) + aged @ curved
        pulses, late_pulses = (self.within_windows(areas) / self.shares for areas in (aged, late_aged))
        remaining = (self.windows - self.ends[:, None]).clip(min=0) / (self.late_cells or 1) / self.shares
        least = pulses / (1 - late_pulses - remaining).clip(min=1e-9)
        thetas = (float(least.max()) * _ROUNDING or _LEAST) * _THETAS[:, None]
        weighted_sum = (pulses / thetas[..., None] + late_pulses + remaining).max(axis=-1)
        gains = np.maximum(stretch + thetas * late, weighted_sum).max(axis=1)
        best = int(gains.argmin())
        return _Norm(
            shape, bends, ages, stretch, aged, late, late_aged,
            pulses.max(axis=1), late_pulses.max(axis=1), remaining.max(axis=1), weighted_sum[best],
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
            return _norms(moved) * _ROUNDING
        pushed = self.BK @ self.H
        row = np.hstack([shape, 0 * shape])
        Y = F @ F @ pushed - 2 * F @ pushed @ G + pushed @ G @ G
        bend = response_until(F, Y @ inverse, self.until_s, self.cells).through(row).sup_on_grid()
        models = response_until(G, inverse, self.until_s, self.cells).through(shape).sup_on_grid()
        sag = self.cell_s**2 / 8 * float(bend) * float(models)
        left, right = row @ self._powers(F) @ pushed, self._powers(G) @ inverse
        signs = np.array(list(itertools.product((-s, s), repeat=_PIECES)))
        stretches = []
        for end, undriven in zip(self.ends.tolist(), moved, strict=True):
            products = left[end::-1] @ right[: end + 1]
            deviation, means = 0.0, np.zeros((_PIECES, n, n))
            for number, piece in enumerate(np.array_split(np.arange(end), _PIECES)):
                if len(piece):
                    nodes = products[piece[0] : piece[-1] + 2]
                    mean = nodes.mean(axis=0)
                    deviations = _of_cells(np.linalg.norm(nodes - mean, axis=(1, 2))) + sag
                    deviation += s * self.cell_s * float(deviations.sum())
                    means[number] = mean * self.cell_s * len(piece)
            ends = undriven + np.einsum("sp,pij->sij", signs, means)
            stretches.append((float(_norms(ends).max()) + deviation) * _ROUNDING)
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


def _lengths(vectors: Matrix) -> Vector:
    """Return ‖·‖ of vectors, (k, n)."""
    return np.asarray(np.sqrt(np.einsum("kn,kn->k", vectors, vectors)))


def _of_cells(values: Stack) -> Stack:
    """Return the larger of the values at both ends of each cell."""
    return np.asarray(np.maximum(values[..., :-1], values[..., 1:]))


class Deliveries:
    """What x can be at the deliveries of an undisturbed plant's loop, from its x(0) on.

    Raises:
        NoCertificateError: the times between deliveries are not covered, or the loop grows from one
            to the next.
    """

    def __init__(self, plant: PlantGains, conditions: NetworkConditions, bound: TriggerBound) -> None:
        self._bound = bound
        self._loop = loop = _Loop(plant, conditions, Gaps.of(conditions, bound))
        n = loop.n
        gain = math.inf
        for shape in _shapes(loop.plant):
            self._norm = loop.norm(shape)
            if (gain := min(gain, self._norm.gain)) < 1:
                break
        else:
            raise NoCertificateError(
                f"in a norm the loop grows from delivery to delivery: {gain:.3g}, not below 1", gain
            )
        self._x0 = loop.plant.start[:, 0]
        self._started = 0.0
        """‖w‖ from the start, which goes on after the next events; 0 if it ends before."""
        if loop.starts_late:
            started = response_until(loop.scaled_H, plant.start, conditions.start_s)
            self._started = float(started.through(loop.R).sup_on_grid()) * _ROUNDING
        at_rest = np.vstack([np.linalg.inv(self._norm.shape), np.zeros((n, n))])
        followed = response_until(loop.F, at_rest, loop.until_s, loop.cells)
        C = loop.outputs
        self._of_ball = _highest(followed.through_each(Outputs(C)))
        """‖C e^{Fr} (Λ⁻¹; 0)‖ over each cell, (outputs, cells)."""
        curved = {name: output @ loop.F @ loop.F for name, output in C.items()}
        sags = _highest(followed.through_each(Outputs(curved)))
        self._sags = loop.cell_s**2 / 8 * sags
        self._of_late = (loop.within_windows(loop.driven) / loop.shares).max(axis=-1)
        self._ages_seen = np.zeros_like(self._of_ball)
        self._ages_seen[[*C].index(_INPUT)] = 1.0

    @property
    def rate_per_s(self) -> float:
        """The rate at which all bounds decay."""
        return self._loop.plant.alpha_per_s

    @property
    def gain(self) -> float:
        """By what the norm of x grows from one delivery to the next, at most; below 1."""
        return self._norm.gain

    def constants(self, unit: float) -> Constants:
        """Return the constants; ``unit`` is that of Δ and β̃."""
        plant, conditions, bound = self._loop.plant, self._loop.conditions, self._bound
        size = dict(zip(self._loop.outputs, self._sizes().tolist(), strict=True))
        start_error = float(plant.start_up(conditions.start_s)[0])
        pushed, moved, _ = ErrorGrowth(plant, bound.due_s, TriggerBound(0.0, None)).driven
        sensor = pushed * max(size[_INPUT], start_error) + moved * size[Output.MISMATCH]
        apart_s = max(bound.apart_s, conditions.spacing_s)
        return Constants(
            rate_per_s=plant.alpha_per_s,
            missing_events=conditions.dropouts + math.ceil(conditions.delay_s / apart_s - 1e-9),
            delta=size[_ERROR] / unit,
            overshoot=float(sensor) / unit,
            input_error=size[_INPUT],
            start_error=start_error,
            state=size[Output.STATE],
            state_weighted=size[Output.WEIGHTED],
            mismatch=size[Output.MISMATCH],
            inter_event_s=apart_s,
            loop_gain=0.0,
            received_input_error=size[_INPUT],
        )

    def _sizes(self) -> Vector:
        """Return the bounds of all outputs, (outputs,)."""
        counts, slots = self._loop.gaps.counts, int(self._loop.gaps.counts[-1]) + 1
        # Before, what the start causes is not among the balls yet.
        settled = max(slots, math.ceil(self._loop.conditions.start_s / self._loop.gaps.step_s))
        highest, start_balls = self._start()
        # What follows from the balls of the last times, by their time modulo the longest gap + 1.
        following = [np.zeros((slots, *array.shape)) for array in start_balls]
        has_balls, gaps = np.zeros(slots, dtype=bool), np.arange(len(counts))
        _store(following, has_balls, [0], start_balls)
        balls, pending, tail = dict[int, _Ball](), list[_Ball](), np.full_like(highest, np.inf)
        width = int(counts[0])  # so many successive times do not depend on each other
        for first_time in range(1, _MOST_TIMES, width):
            new_balls = list[_Ball]()
            for k in range(first_time, first_time + width):
                earlier = (k - counts) % slots
                is_known = has_balls[earlier]
                if is_known.any():
                    ball = self._enclosing(*(array[earlier[is_known], gaps[is_known]] for array in following))
                    new_balls.append(ball._replace(time=k))
            has_balls[np.arange(first_time, first_time + width) % slots] = False
            if new_balls:
                _store(following, has_balls, [ball.time for ball in new_balls], self._after_gaps(new_balls))
                balls |= {ball.time: ball for ball in new_balls}
                pending += new_balls
            is_last = first_time + width >= _MOST_TIMES
            if len(pending) >= _AT_ONCE or is_last:
                highest = np.maximum(highest, self._until_next_delivery(pending))
                pending.clear()
                current = first_time + width - 1
                if current < settled:
                    continue
                tail = self._tail([balls[s] for s in range(current - slots + 1, current + 1) if s in balls])
                if (tail <= highest).all():
                    break
        return np.asarray(np.maximum(tail, highest) * _ROUNDING)

    def _enclosing(self, c: Matrix, rho: Vector, J: Vector, weighted_sum: Vector) -> "_Ball":
        """Return a small ball around balls."""
        shape = self._norm.shape
        middle, rounding = c.mean(axis=0), 1e-12 * float(_lengths(c @ shape.T).max())
        for number in range(1, _CENTRED + 1):
            furthest = int((_lengths((c - middle) @ shape.T) + weighted_sum).argmax())
            middle = middle + (c[furthest] - middle) / (number + 2)
        away = _lengths((c - middle) @ shape.T) + rounding
        largest_rho, largest_sum = (float((away + size).max()) * _ROUNDING for size in (rho, weighted_sum))
        return _Ball(middle, largest_rho, float(J.max()), largest_sum, self._norm.theta)

    def _after_gaps(self, balls: Sequence["_Ball"]) -> "_Balls":
        """Return what follows from balls after each gap, (k, gaps)."""
        loop, norm, n = self._loop, self._norm, self._loop.n
        points, ages = np.array([ball.c for ball in balls]), self._driving(balls)
        moved = np.einsum("gan,kn->kga", loop.flows[loop.ends], points)
        late = loop.late_sizes(moved[..., n:].reshape(-1, n)).reshape(moved.shape[:2])
        late, aged = (late + ages @ norm.late_aged.T)[..., None], (ages @ norm.aged.T)[..., None]
        corners = np.array([ball.corners for ball in balls])  # (k, 2, corners)
        rho, J = corners[:, None, 0], corners[:, None, 1]
        stretch, late_of_rho, carried = (
            factor[:, None] for factor in (norm.stretch, norm.late, norm.late_pulse + norm.remaining)
        )
        weighted_sum = (
            stretch * rho + aged + norm.theta * (late_of_rho * rho + norm.weighted_sum[:, None] * J + late)
        )
        rho, J = stretch * rho + norm.pulse[:, None] * J + aged, late_of_rho * rho + carried * J + late
        return _Balls(moved[..., :n], rho.max(axis=-1), J.max(axis=-1), weighted_sum.max(axis=-1))

    def _tail(self, balls: "list[_Ball]") -> Vector:
        """Bound all outputs from now on, given the balls within a longest gap."""
        norm, loop = self._norm, self._loop
        size = max(float(np.linalg.norm(norm.shape @ ball.c)) + ball.weighted_sum for ball in balls)
        remaining = 1 - float((norm.late_pulse + norm.remaining).max())
        J = float(norm.late.max()) * size / remaining if remaining > 0 else math.inf
        J = min(max(J, *(ball.J for ball in balls)), size / norm.theta)
        of_ball = self._of_ball + self._ages_seen * norm.ages + loop.driven @ norm.ages
        return np.asarray((of_ball * size + self._of_late * J).max(axis=1))

    def _ages_of(self, points: Matrix) -> Matrix:
        """Bound ‖w‖ over each cell, as far as it comes from the input's age, for ξ (k, n)."""
        nodes = np.einsum("rtqn,kn->krtq", self._loop.aged, points)
        sizes = _of_cells(np.linalg.norm(nodes, axis=-1).max(axis=-1))
        weighted = np.linalg.norm(points @ self._norm.shape.T, axis=-1)
        return np.asarray((sizes + self._norm.age_bends * weighted[:, None]) * _ROUNDING)

    def _driving(self, balls: Sequence["_Ball"]) -> Matrix:
        """Bound ‖w‖ over each cell for ξ = c of each ball, without J, (k, cells)."""
        loop, times = self._loop, np.array([ball.time for ball in balls])[:, None]
        cells_s = times * loop.gaps.step_s + loop.cell_s * np.arange(loop.cells)
        ages = self._ages_of(np.array([ball.c for ball in balls]))
        return np.asarray(ages + self._started * (cells_s < loop.conditions.start_s))

    def _until_next_delivery(self, balls: "list[_Ball]") -> Vector:
        """Bound all outputs from events with these balls until the next delivery."""
        loop, norm = self._loop, self._norm
        points = np.array([ball.c for ball in balls])
        corners = np.array([ball.corners for ball in balls])[..., None]
        nodes = np.einsum("ran,kn->kra", loop.flows, points)
        ages, driving = self._ages_of(points), self._driving(balls)
        sizes = np.linalg.norm(points @ norm.shape.T, axis=-1)
        highest = []
        for number, C in enumerate(loop.outputs.values()):
            ages_seen, pushed = self._ages_seen[number], loop.driven[number]
            of_ball = self._of_ball[number] + ages_seen * norm.ages + pushed @ norm.ages
            corner = (of_ball * corners[:, 0] + self._of_late[number] * corners[:, 1]).max(axis=1)
            cells = _of_cells(np.linalg.norm(nodes @ C.T, axis=-1))
            cells = cells + self._sags[number] * sizes[:, None] + corner
            highest.append((cells + driving @ pushed.T + ages_seen * ages).max())
        return np.array(highest)

    def _start(self) -> tuple[Vector, "_Balls"]:
        """Bound all outputs until the next delivery after t = 0, and return what follows.

        Until some time of at most T the input is 0: w = −K e^{Hr} x(0). What it adds to z, as a
        function of this time, is close to a line from 0 to ``added``.
        """
        loop, norm, x0, T = self._loop, self._norm, self._x0, self._loop.conditions.start_s
        if loop.starts_late:
            start_ball = _Ball(x0, 0.0, 0.0, 0.0, norm.theta)
            return self._until_next_delivery([start_ball]), _Balls(
                *(array[0] for array in self._after_gaps([start_ball]))
            )
        n, alpha = loop.n, loop.plant.alpha_per_s
        free, models = (
            exponential(generator * T) @ x0 for generator in (loop.plant.A + alpha * np.eye(n), loop.scaled_H)
        )
        first_cell = math.ceil(T / loop.cell_s - 1e-9)
        pushed = np.append(free, models - free) - exponential(loop.F * T)[:, :n] @ x0
        step = exponential(loop.F * loop.cell_s)
        added = [exponential(loop.F * max(first_cell * loop.cell_s - T, 0.0)) @ pushed]
        for _ in range(loop.cells - first_cell):
            added.append(step @ added[-1])
        F, BK = loop.F, loop.BK
        turn = F @ BK - BK @ loop.scaled_H
        ages = self._ages_of(x0[None])[0]
        nodes, highest = loop.flows @ x0, []
        with_start = nodes[first_cell:] + np.array(added)
        for number, C in enumerate(loop.outputs.values()):
            cells = _of_cells(np.linalg.norm(nodes @ C.T, axis=-1))
            later = np.linalg.norm(with_start @ C.T, axis=-1)
            cells[first_cell:] = np.maximum(cells[first_cell:], _of_cells(later))
            cells[first_cell:] += T**2 / 8 * self._carried(C, turn, loop.cells)
            cells[first_cell:] += loop.cell_s**2 / 8 * T * self._carried(C @ F @ F, BK, loop.cells)
            cells[:first_cell] += T * self._carried(C, BK, max(first_cell, 1))
            cells += self._sags[number] * np.linalg.norm(norm.shape @ x0)
            cells += loop.driven[number] @ ages
            highest.append((cells + self._ages_seen[number] * ages).max())
        ends = np.array(added)[loop.ends - first_cell]
        moved = nodes[loop.ends]
        bent = T**2 / 8 * self._carried(np.hstack([norm.shape, 0 * norm.shape]), turn, loop.cells)
        half = np.linalg.norm(ends[:, :n] @ norm.shape.T, axis=-1) / 2
        *late, weighted = (T**2 / 8 * self._carried(C, turn, loop.cells) for C in loop.late_outputs.values())
        J = np.maximum(loop.late_sizes(moved[:, n:]), loop.late_sizes((moved + ends)[:, n:]))
        J = J + max(late) + weighted + norm.late_aged @ ages
        rho = half * _ROUNDING + bent + norm.aged @ ages
        weighted_sum = rho + norm.theta * J
        return np.array(highest), _Balls(moved[:, :n] + ends[:, :n] / 2, rho, J, weighted_sum)

    def _carried(self, C: Matrix, Y: Matrix, cells: int) -> float:
        """Bound ‖C e^{Fr} Y e^{Hs} x(0)‖ over cells of r, and s up to T."""
        loop, T = self._loop, self._loop.conditions.start_s
        if T == 0:
            return 0.0
        until_s, G, largest = cells * loop.cell_s, loop.scaled_H, 0.0
        for x in (self._x0, exponential(G * T) @ self._x0):
            kernel = response_until(loop.F, (Y @ x)[:, None], until_s, cells).through(C)
            largest = max(largest, float(kernel.sup_on_grid()))
        bent = response_until(G, self._x0[:, None], T).through(G @ G).sup_on_grid()
        whole = response_until(loop.F, Y, until_s, cells).through(C).sup_on_grid()
        return (largest + T**2 / 8 * float(bent) * float(whole)) * _ROUNDING


class _Ball(NamedTuple):
    """‖Λ(ξ − c)‖ ≤ ρ, J, and ρ + θJ at a delivered event, at most."""

    c: Vector
    rho: float
    J: float
    weighted_sum: float
    theta: float
    time: int = 0

    @property
    def corners(self) -> Matrix:
        """ρ and J where linear functions of both, that do not fall, are largest, (2, corners)."""
        rho, J = min(self.rho, self.weighted_sum), min(self.J, self.weighted_sum / self.theta)
        partners = (
            min(J, (self.weighted_sum - rho) / self.theta),
            min(rho, self.weighted_sum - self.theta * J),
        )
        return np.array([[rho, partners[1]], [partners[0], J]]).clip(min=0.0) * _ROUNDING


class _Balls(NamedTuple):
    """The balls a time after a delivered event, for each gap."""

    c: Matrix
    rho: Vector
    J: Vector
    weighted_sum: Vector


def _shapes(plant: PlantGains) -> Iterator[Matrix]:
    """Yield matrices Λ that may suit: ‖Λx‖ decays while e_c is 0."""
    from scipy.linalg import solve_continuous_lyapunov  # slow to import

    decay_per_s, identity = -spectral_abscissa(plant.closed_loop), np.eye(len(plant.A))
    if decay_per_s <= 0:
        raise NotDecayingError(f"a mode of the loop grows at {-decay_per_s:.3g} /s")
    rate = plant.error.split_K[1] @ plant.error.H
    rate_form = rate.T @ rate + _LEAST * np.linalg.norm(rate) ** 2 * identity
    for share, right in itertools.product(_SHIFTS, (rate_form, identity)):
        shifted = plant.closed_loop + share * decay_per_s * identity
        form = solve_continuous_lyapunov(shifted.T, -right)
        with contextlib.suppress(np.linalg.LinAlgError):
            yield np.linalg.cholesky(0.5 * (form + form.T)).T


def _store(following: list[Stack], has_balls: NDArray[np.bool_], times: list[int], balls: _Balls) -> None:
    """Remember what follows from the balls of some times."""
    slots = np.array(times) % len(has_balls)
    for store, array in zip(following, balls, strict=True):
        store[slots] = array
    has_balls[slots] = True


def _highest(kernels: dict[str, KernelBounds]) -> Matrix:
    """Return the highest values over each cell, (outputs, cells)."""
    return np.array([kernel.highest for kernel in kernels.values()])
