"""Bounds of a loop whose events are at most some time apart, by what x can be at a delivery.

Let ξ = Λx at a delivered event. If events are due, the next delivered event is one of finitely many
times g later, and ``delivery_gaps.py`` bounds what g makes of ξ. So of every time t at which there
may be a delivered event, a ball ‖ξ − c‖ ≤ ρ and a bound J of what the update removes follow from
those a time g before:

    ρ(t) = max_g ‖Φ_g c − c(t)‖ + γ_g ρ + ∫‖ΛΨ‖ ‖w‖,      Φ_g = Λ (I 0) e^{Fg} (I; 0) Λ⁻¹

The c are any points; they follow the loop. This goes on until the bounds of the times before are
larger than all later ones. These have two bounds. No step increases ‖ξ‖ + θJ. And as the loop is
linear, what follows from ξ(t) = κ c(t − m) + r is κ times what followed from c(t − m), and what
follows from r. If h bounds the outputs before t, and τ what follows from r, the outputs from t on
are at most y = |κ| max(y, h) + τ.
"""

import contextlib
import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, Vector, exponential, spectral_abscissa
from noack.theory.bounds.certificate_terms import (
    Constants,
    NetworkConditions,
    NoCertificateError,
    TriggerBound,
)
from noack.theory.bounds.contraction import Stack
from noack.theory.bounds.enclosure import KernelBounds, NotDecayingError, Outputs, response_until
from noack.theory.bounds.gains import Output, PlantGains
from noack.theory.bounds.trigger_bounds import ErrorGrowth
from noack.theory.certificates.deliveries.delivery_gaps import ERROR, INPUT, ROUNDING, GapLoop, Gaps, of_cells

_MOST_TIMES = 6000
_SHIFTS, _LEAST = (0.9, 0.7, 0.4), 1e-6
"""Decay rates of Λ that are tried, as shares of that of the scaled A + BK."""
_AT_ONCE, _CENTRED = 64, 3
_RETURNS = 64
"""So many m are tried."""


class Deliveries:
    """What x can be at the deliveries of an undisturbed plant's loop, from its x(0) on.

    Raises:
        NoCertificateError: the times between deliveries are not covered, or the loop grows from one
            to the next.
    """

    def __init__(self, plant: PlantGains, conditions: NetworkConditions, bound: TriggerBound) -> None:
        self._bound = bound
        self._loop = loop = GapLoop(plant, conditions, Gaps.of(conditions, bound))
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
        self._inverse = np.linalg.inv(self._norm.shape)
        self._x0 = loop.plant.start[:, 0]
        self._started = 0.0
        """‖w‖ from the start, which goes on after the next events; 0 if it ends before."""
        if loop.starts_late:
            started = response_until(loop.scaled_H, plant.start, conditions.start_s)
            self._started = float(started.through(loop.R).sup_on_grid()) * ROUNDING
        at_rest = np.vstack([self._inverse, np.zeros((n, n))])
        responses = response_until(loop.F, at_rest, loop.until_s, loop.cells)
        C = loop.outputs
        self._ball_outputs = _highest(responses.through_each(Outputs(C)))
        """‖C e^{Fr} (Λ⁻¹; 0)‖ over each cell, (outputs, cells)."""
        curved = {name: output @ loop.F @ loop.F for name, output in C.items()}
        sags = _highest(responses.through_each(Outputs(curved)))
        self._sags = loop.cell_s**2 / 8 * sags
        self._removal_effects = (loop.within_windows(loop.input_responses) / loop.shares).max(axis=-1)
        # What follows from a ball after each gap: linear functions of its centre, of ‖w‖, and of ρ and J.
        norm, at_ends = self._norm, loop.flows[loop.ends]
        removed, bend = loop.removal
        lost = at_ends[:, n:] @ self._inverse
        self._maps = _Maps(
            norm.shape @ at_ends[:, :n] @ self._inverse,
            removed[:, None] @ lost,
            bend * loop.plant.error.weight @ lost,
        )
        self._aged, self._flows = _Maps(loop.aged @ self._inverse), loop.flows @ self._inverse
        self._by_inputs = np.vstack([norm.aged, norm.removal_aged]).T
        rho = [norm.stretch, norm.removal, norm.stretch + norm.theta * norm.removal]
        J = [norm.pulse, norm.removal_pulse + norm.remaining, norm.theta * norm.weighted_sum]
        self._by_ball = np.stack([rho, J], axis=-1)
        self._ages_seen = np.zeros_like(self._ball_outputs)
        self._ages_seen[[*C].index(INPUT)] = 1.0

    @property
    def gain(self) -> float:
        """By what the norm of x grows from one delivery to the next, at most; below 1."""
        return self._norm.gain

    def constants(self, unit: float) -> Constants:
        """Return the constants; ``unit`` is that of Δ and β̃."""
        plant, conditions, bound = self._loop.plant, self._loop.conditions, self._bound
        size = dict(zip(self._loop.outputs, self._sizes().tolist(), strict=True))
        start_error = float(plant.start_up(conditions.start_s)[0])
        by_input, by_mismatch, _ = ErrorGrowth(plant, bound.due_s, TriggerBound(0.0, None)).driven
        sensor = by_input * max(size[INPUT], start_error) + by_mismatch * size[Output.MISMATCH]
        apart_s = max(bound.apart_s, conditions.spacing_s)
        return Constants(
            rate_per_s=plant.alpha_per_s,
            missing_events=conditions.dropouts + math.ceil(conditions.delay_s / apart_s - 1e-9),
            delta=size[ERROR] / unit,
            overshoot=float(sensor) / unit,
            input_error=size[INPUT],
            start_error=start_error,
            state=size[Output.STATE],
            state_weighted=size[Output.WEIGHTED],
            mismatch=size[Output.MISMATCH],
            inter_event_s=apart_s,
            loop_gain=0.0,
            received_input_error=size[INPUT],
        )

    def _sizes(self) -> Vector:
        """Return the bounds of all outputs, (outputs,)."""
        counts, slots = self._loop.gaps.counts, int(self._loop.gaps.counts[-1]) + 1
        # Before, what the start causes is not among the balls yet.
        settled = max(slots, math.ceil(self._loop.conditions.start_s / self._loop.gaps.step_s))
        highest, start_balls = self._start_bounds_and_balls()
        # What follows from the balls of the last times, by their time modulo the longest gap + 1.
        following = _Balls(*(np.zeros((slots, *array.shape[1:])) for array in start_balls))
        has_balls, gaps = np.zeros(slots, dtype=bool), np.arange(len(counts))
        following.store([0], start_balls, has_balls)
        width = int(counts[0])  # so many successive times do not depend on each other
        course = _Course.without_balls(_MOST_TIMES + width, self._loop.n)
        pending, tail = list[_Ball](), np.full_like(highest, np.inf)
        for first_time in range(1, _MOST_TIMES, width):
            new_balls = list[_Ball]()
            for k in range(first_time, first_time + width):
                earlier = (k - counts) % slots
                known = np.flatnonzero(has_balls[earlier])
                if len(known):
                    places = earlier[known], gaps[known]
                    new_balls.append(self._enclosing(following.centres[places], following.sizes[places], k))
            has_balls[np.arange(first_time, first_time + width) % slots] = False
            if new_balls:
                following.store([ball.time for ball in new_balls], self._after_gaps(new_balls), has_balls)
                for ball in new_balls:
                    course.add(ball)
                pending += new_balls
            is_last = first_time + width >= _MOST_TIMES
            if len(pending) >= _AT_ONCE or is_last:
                highest = np.maximum(highest, self._until_next_delivery(pending))
                pending.clear()
                current = first_time + width - 1
                if current < settled:
                    continue
                tail = self._tail(course, current, highest)
                if (tail <= highest).all():
                    break
        return np.asarray(np.maximum(tail, highest) * ROUNDING)

    def _enclosing(self, centres: Matrix, sizes: Matrix, time: int) -> "_Ball":
        """Return a small ball around balls: around their centres, (k, n), of these sizes, (k, 3)."""
        middle, rounding = np.add.reduce(centres) / len(centres), 1e-12 * float(_lengths(centres).max())
        for number in range(1, _CENTRED + 1):
            furthest = int((_lengths(centres - middle) + sizes[:, 2]).argmax())
            middle = middle + (centres[furthest] - middle) / (number + 2)
        sizes[:, ::2] += (_lengths(centres - middle) + rounding)[:, None]
        rho, J, weighted_sum = sizes.max(axis=0).tolist()
        return _Ball(middle, rho * ROUNDING, J, weighted_sum * ROUNDING, self._norm.theta, time)

    def _after_gaps(self, balls: Sequence["_Ball"]) -> "_Balls":
        """Return what follows from balls after each gap, (k, gaps)."""
        centres, removed, weighted = self._maps.of(np.array([ball.c for ball in balls]))
        aged, late = np.split(self._inputs(balls) @ self._by_inputs, 2, axis=1)
        late = late + (_lengths(removed).max(axis=1) + _lengths(weighted)) * ROUNDING
        corners = np.array([ball.corners for ball in balls])[:, None]  # (k, 1, 2, corners)
        sizes = (self._by_ball @ corners).max(axis=-1)  # (k, 3, gaps)
        sizes += np.stack([aged, late, aged + self._norm.theta * late], axis=1)
        return _Balls(centres, sizes.swapaxes(1, 2))

    def _tail(self, course: "_Course", now: int, highest: Vector) -> Vector:
        """Bound all outputs from the last gap on; ``highest`` bounds those before."""
        last = slice(now - int(self._loop.gaps.counts[-1]), now + 1)
        J = float(np.nanmax(course.J[last]))
        tail = self._following(
            float(np.nanmax(_lengths(course.centres[last]) + course.weighted_sums[last])), J
        )
        if (tail > highest).any() and (returned := course.returned(last)) is not None:
            scale, rest = returned
            of_rest = self._following(rest, J)
            tail = np.minimum(tail, np.maximum(scale * highest + of_rest, of_rest / (1 - scale)))
        return tail

    def _following(self, size: float, J: float) -> Vector:
        """Bound all outputs from events on with ‖ξ‖ + θJ of at most ``size``."""
        norm, loop = self._norm, self._loop
        remaining = 1 - float((norm.removal_pulse + norm.remaining).max())
        later_J = float(norm.removal.max()) * size / remaining if remaining > 0 else math.inf
        J = min(max(J, later_J), size / norm.theta)
        of_ball = self._ball_outputs + self._ages_seen * norm.ages + loop.input_responses @ norm.ages
        return np.asarray((of_ball * size + self._removal_effects * J).max(axis=1))

    def _age_inputs(self, points: Matrix) -> Matrix:
        """Bound ‖w‖ over each cell, as far as it comes from the input's age, for centres (k, n)."""
        if self._loop.conditions.hold_s == 0:
            return np.zeros((len(points), self._loop.cells))
        (nodes,) = self._aged.of(points)
        sizes = of_cells(_lengths(nodes).max(axis=-1))
        return np.asarray((sizes + self._norm.age_bends * _lengths(points)[:, None]) * ROUNDING)

    def _inputs(self, balls: Sequence["_Ball"]) -> Matrix:
        """Bound ‖w‖ over each cell for ξ = c of each ball, without J, (k, cells)."""
        loop, ages = self._loop, self._age_inputs(np.array([ball.c for ball in balls]))
        if not self._started:
            return ages
        times = np.array([ball.time for ball in balls])[:, None]
        cells_s = times * loop.gaps.step_s + loop.cell_s * np.arange(loop.cells)
        return np.asarray(ages + self._started * (cells_s < loop.conditions.start_s))

    def _until_next_delivery(self, balls: "list[_Ball]") -> Vector:
        """Bound all outputs from events with these balls until the next delivery."""
        loop, norm = self._loop, self._norm
        points = np.array([ball.c for ball in balls])
        corners = np.array([ball.corners for ball in balls])[..., None]
        nodes = np.einsum("ran,kn->kra", self._flows, points)
        ages, driving = self._age_inputs(points), self._inputs(balls)
        sizes, highest = _lengths(points), []
        for number, C in enumerate(loop.outputs.values()):
            ages_seen, by_input = self._ages_seen[number], loop.input_responses[number]
            of_ball = self._ball_outputs[number] + ages_seen * norm.ages + by_input @ norm.ages
            corner = (of_ball * corners[:, 0] + self._removal_effects[number] * corners[:, 1]).max(axis=1)
            cells = of_cells(np.linalg.norm(nodes @ C.T, axis=-1))
            cells = cells + self._sags[number] * sizes[:, None] + corner
            highest.append((cells + driving @ by_input.T + ages_seen * ages).max())
        return np.array(highest)

    def _start_bounds_and_balls(self) -> tuple[Vector, "_Balls"]:
        """Bound all outputs until the next delivery after t = 0, and return what follows.

        Until some time of at most T the input is 0: w = −K e^{Hr} x(0). What it adds to z, as a
        function of this time, is close to a line from 0 to ``added``.
        """
        loop, norm, x0, T = self._loop, self._norm, self._x0, self._loop.conditions.start_s
        if loop.starts_late:
            start_ball = _Ball(norm.shape @ x0, 0.0, 0.0, 0.0, norm.theta)
            return self._until_next_delivery([start_ball]), self._after_gaps([start_ball])
        # What a w that ends at T has added to z, at the nodes from T on.
        n, alpha = loop.n, loop.plant.alpha_per_s
        free, models = (
            exponential(generator * T) @ x0 for generator in (loop.plant.A + alpha * np.eye(n), loop.scaled_H)
        )
        first_cell = math.ceil(T / loop.cell_s - 1e-9)
        added_at_T = np.append(free, models - free) - exponential(loop.F * T)[:, :n] @ x0
        step = exponential(loop.F * loop.cell_s)
        added = [exponential(loop.F * max(first_cell * loop.cell_s - T, 0.0)) @ added_at_T]
        for _ in range(loop.cells - first_cell):
            added.append(step @ added[-1])
        # The outputs until the next delivery.
        F, BK = loop.F, loop.BK
        turn = F @ BK - BK @ loop.scaled_H
        ages = self._age_inputs(x0[None] @ norm.shape.T)[0]
        nodes, highest = loop.flows @ x0, []
        with_start = nodes[first_cell:] + np.array(added)
        for number, C in enumerate(loop.outputs.values()):
            cells = of_cells(np.linalg.norm(nodes @ C.T, axis=-1))
            later = np.linalg.norm(with_start @ C.T, axis=-1)
            cells[first_cell:] = np.maximum(cells[first_cell:], of_cells(later))
            cells[first_cell:] += T**2 / 8 * self._start_response(C, turn, loop.cells)
            cells[first_cell:] += loop.cell_s**2 / 8 * T * self._start_response(C @ F @ F, BK, loop.cells)
            cells[:first_cell] += T * self._start_response(C, BK, max(first_cell, 1))
            cells += self._sags[number] * np.linalg.norm(norm.shape @ x0)
            cells += loop.input_responses[number] @ ages
            highest.append((cells + self._ages_seen[number] * ages).max())
        # The balls after each gap, with the middle between both ends of the line as their centres.
        ends = np.array(added)[loop.ends - first_cell]
        moved = nodes[loop.ends]
        bent = T**2 / 8 * self._start_response(np.hstack([norm.shape, 0 * norm.shape]), turn, loop.cells)
        half = np.linalg.norm(ends[:, :n] @ norm.shape.T, axis=-1) / 2
        *late, weighted = (
            T**2 / 8 * self._start_response(C, turn, loop.cells) for C in loop.removal_outputs.values()
        )
        J = np.maximum(loop.removal_sizes(moved[:, n:]), loop.removal_sizes((moved + ends)[:, n:]))
        J = J + max(late) + weighted + norm.removal_aged @ ages
        rho = half * ROUNDING + bent + norm.aged @ ages
        centres = (moved[:, :n] + ends[:, :n] / 2) @ norm.shape.T
        sizes = np.stack([rho, J, rho + norm.theta * J], axis=-1)
        return np.array(highest), _Balls(centres[None], sizes[None])

    def _start_response(self, C: Matrix, Y: Matrix, cells: int) -> float:
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
        return (largest + T**2 / 8 * float(bent) * float(whole)) * ROUNDING


class _Ball(NamedTuple):
    """‖ξ − c‖ ≤ ρ, J, and ρ + θJ at a delivered event, at most."""

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
        return np.array([[rho, max(partners[1], 0.0)], [max(partners[0], 0.0), J]]) * ROUNDING


class _Course(NamedTuple):
    """The balls of all times; NaN where there is none."""

    centres: Matrix
    J: Vector
    weighted_sums: Vector

    @classmethod
    def without_balls(cls, times: int, n: int) -> "_Course":
        return cls(*(np.full(shape, np.nan) for shape in ((times, n), times, times)))

    def add(self, ball: _Ball) -> None:
        self.centres[ball.time], self.J[ball.time] = ball.c, ball.J
        self.weighted_sums[ball.time] = ball.weighted_sum

    def returned(self, last: slice) -> tuple[float, float] | None:
        """Return |κ|, and ‖r‖ + θJ at most, of ξ(t) = κ c(t − m) + r at the last times t.

        Of the m that are tried, it is that with the smallest (‖r‖ + θJ)/(1 − |κ|); None if there is none.
        """
        times = np.arange(last.start, last.stop)[~np.isnan(self.J[last])]
        delays = np.unique(np.linspace(len(self.J[last]), last.start - 1, _RETURNS).astype(int))
        before, now = self.centres[times - delays[delays > 0, None]], self.centres[times]  # (m, times, n)
        scales = (before * now).sum(axis=(1, 2)) / np.square(before).sum(axis=(1, 2))
        rests = _lengths(now - scales[:, None, None] * before) + 1e-12 * _lengths(now)
        sizes, scales = (rests + self.weighted_sums[times]).max(axis=1), np.abs(scales)
        worst = np.where(scales < 1, sizes / (1 - scales), np.nan)
        if np.isnan(worst).all():
            return None
        best = int(np.nanargmin(worst))
        return float(scales[best]), float(sizes[best])


class _Balls(NamedTuple):
    """The balls after each gap, for delivered events at some times."""

    centres: Stack
    """c, (times, gaps, n)"""
    sizes: Stack
    """ρ, J, and ρ + θJ, (times, gaps, 3)"""

    def store(self, times: list[int], balls: "_Balls", has_balls: NDArray[np.bool_]) -> None:
        """Remember those of some times here, at the remainders of the times."""
        slots = np.array(times) % len(has_balls)
        self.centres[slots], self.sizes[slots] = balls
        has_balls[slots] = True


class _Maps:
    """Matrices, stacks of (…, n), that one product applies to points."""

    def __init__(self, *stacks: Stack) -> None:
        self._shapes = [stack.shape[:-1] for stack in stacks]
        self._rows = np.vstack([stack.reshape(-1, stack.shape[-1]) for stack in stacks]).T.copy()
        ends = np.cumsum([math.prod(shape) for shape in self._shapes]).tolist()
        self._slices = [*map(slice, [0, *ends], ends)]

    def of(self, points: Matrix) -> list[Stack]:
        """Return the products of each stack with points (k, n), of shape (k, …)."""
        products = points @ self._rows
        parts = zip(self._slices, self._shapes, strict=True)
        return [products[:, part].reshape(-1, *shape) for part, shape in parts]


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


def _lengths(vectors: Stack) -> Stack:
    """Return ‖·‖ of vectors, (…, n)."""
    return np.asarray(np.sqrt(np.einsum("...n,...n->...", vectors, vectors)))


def _highest(kernels: dict[str, KernelBounds]) -> Matrix:
    """Return the highest values over each cell, (outputs, cells)."""
    return np.array([kernel.highest for kernel in kernels.values()])
