"""Bounds of a loop whose events are at most some time apart, by what x can be at a delivery.

Let ξ = x at a delivered event. If events are due, the next delivered event is one of finitely many
times g later, and ``delivery_gaps.py`` bounds what g makes of ξ. So of every time t at which there
may be a delivered event, a ball ‖Λ(ξ − c)‖ ≤ ρ and a bound J of what the update removes follow from
those a time g before:

    ρ(t) = max_g ‖Λ(Φ_g c − c(t))‖ + γ_g ρ + ∫‖ΛΨ‖ ‖w‖,      Φ_g = (I 0) e^{Fg} (I; 0)

The c are any points; they follow the loop. This goes on until ‖Λξ‖ + θJ, which no further step
increases, is so small that the bounds of the times before it are the largest ones.
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
        self._x0 = loop.plant.start[:, 0]
        self._started = 0.0
        """‖w‖ from the start, which goes on after the next events; 0 if it ends before."""
        if loop.starts_late:
            started = response_until(loop.scaled_H, plant.start, conditions.start_s)
            self._started = float(started.through(loop.R).sup_on_grid()) * ROUNDING
        at_rest = np.vstack([np.linalg.inv(self._norm.shape), np.zeros((n, n))])
        responses = response_until(loop.F, at_rest, loop.until_s, loop.cells)
        C = loop.outputs
        self._ball_outputs = _highest(responses.through_each(Outputs(C)))
        """‖C e^{Fr} (Λ⁻¹; 0)‖ over each cell, (outputs, cells)."""
        curved = {name: output @ loop.F @ loop.F for name, output in C.items()}
        sags = _highest(responses.through_each(Outputs(curved)))
        self._sags = loop.cell_s**2 / 8 * sags
        self._removal_effects = (loop.within_windows(loop.input_responses) / loop.shares).max(axis=-1)
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
        return np.asarray(np.maximum(tail, highest) * ROUNDING)

    def _enclosing(self, c: Matrix, rho: Vector, J: Vector, weighted_sum: Vector) -> "_Ball":
        """Return a small ball around balls."""
        shape = self._norm.shape
        middle, rounding = c.mean(axis=0), 1e-12 * float(_lengths(c @ shape.T).max())
        for number in range(1, _CENTRED + 1):
            furthest = int((_lengths((c - middle) @ shape.T) + weighted_sum).argmax())
            middle = middle + (c[furthest] - middle) / (number + 2)
        away = _lengths((c - middle) @ shape.T) + rounding
        largest_rho, largest_sum = (float((away + size).max()) * ROUNDING for size in (rho, weighted_sum))
        return _Ball(middle, largest_rho, float(J.max()), largest_sum, self._norm.theta)

    def _after_gaps(self, balls: Sequence["_Ball"]) -> "_Balls":
        """Return what follows from balls after each gap, (k, gaps)."""
        loop, norm, n = self._loop, self._norm, self._loop.n
        points, ages = np.array([ball.c for ball in balls]), self._inputs(balls)
        moved = np.einsum("gan,kn->kga", loop.flows[loop.ends], points)
        late = loop.removal_sizes(moved[..., n:].reshape(-1, n)).reshape(moved.shape[:2])
        late, aged = (late + ages @ norm.removal_aged.T)[..., None], (ages @ norm.aged.T)[..., None]
        corners = np.array([ball.corners for ball in balls])  # (k, 2, corners)
        rho, J = corners[:, None, 0], corners[:, None, 1]
        stretch, late_of_rho, carried = (
            factor[:, None] for factor in (norm.stretch, norm.removal, norm.removal_pulse + norm.remaining)
        )
        late_sum = late_of_rho * rho + norm.weighted_sum[:, None] * J + late
        weighted_sum = stretch * rho + aged + norm.theta * late_sum
        rho, J = stretch * rho + norm.pulse[:, None] * J + aged, late_of_rho * rho + carried * J + late
        return _Balls(moved[..., :n], rho.max(axis=-1), J.max(axis=-1), weighted_sum.max(axis=-1))

    def _tail(self, balls: "list[_Ball]") -> Vector:
        """Bound all outputs from now on, given the balls within a longest gap."""
        norm, loop = self._norm, self._loop
        size = max(float(np.linalg.norm(norm.shape @ ball.c)) + ball.weighted_sum for ball in balls)
        remaining = 1 - float((norm.removal_pulse + norm.remaining).max())
        J = float(norm.removal.max()) * size / remaining if remaining > 0 else math.inf
        J = min(max(J, *(ball.J for ball in balls)), size / norm.theta)
        of_ball = self._ball_outputs + self._ages_seen * norm.ages + loop.input_responses @ norm.ages
        return np.asarray((of_ball * size + self._removal_effects * J).max(axis=1))

    def _age_inputs(self, points: Matrix) -> Matrix:
        """Bound ‖w‖ over each cell, as far as it comes from the input's age, for ξ (k, n)."""
        nodes = np.einsum("rtqn,kn->krtq", self._loop.aged, points)
        sizes = of_cells(np.linalg.norm(nodes, axis=-1).max(axis=-1))
        weighted = np.linalg.norm(points @ self._norm.shape.T, axis=-1)
        return np.asarray((sizes + self._norm.age_bends * weighted[:, None]) * ROUNDING)

    def _inputs(self, balls: Sequence["_Ball"]) -> Matrix:
        """Bound ‖w‖ over each cell for ξ = c of each ball, without J, (k, cells)."""
        loop, times = self._loop, np.array([ball.time for ball in balls])[:, None]
        cells_s = times * loop.gaps.step_s + loop.cell_s * np.arange(loop.cells)
        ages = self._age_inputs(np.array([ball.c for ball in balls]))
        return np.asarray(ages + self._started * (cells_s < loop.conditions.start_s))

    def _until_next_delivery(self, balls: "list[_Ball]") -> Vector:
        """Bound all outputs from events with these balls until the next delivery."""
        loop, norm = self._loop, self._norm
        points = np.array([ball.c for ball in balls])
        corners = np.array([ball.corners for ball in balls])[..., None]
        nodes = np.einsum("ran,kn->kra", loop.flows, points)
        ages, driving = self._age_inputs(points), self._inputs(balls)
        sizes = np.linalg.norm(points @ norm.shape.T, axis=-1)
        highest = []
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
            start_ball = _Ball(x0, 0.0, 0.0, 0.0, norm.theta)
            following = self._after_gaps([start_ball])
            return self._until_next_delivery([start_ball]), _Balls(*(array[0] for array in following))
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
        ages = self._age_inputs(x0[None])[0]
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
        weighted_sum = rho + norm.theta * J
        return np.array(highest), _Balls(moved[:, :n] + ends[:, :n] / 2, rho, J, weighted_sum)

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
        return np.array([[rho, partners[1]], [partners[0], J]]).clip(min=0.0) * ROUNDING


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


def _lengths(vectors: Matrix) -> Vector:
    """Return ‖·‖ of vectors, (k, n)."""
    return np.asarray(np.sqrt(np.einsum("kn,kn->k", vectors, vectors)))


def _highest(kernels: dict[str, KernelBounds]) -> Matrix:
    """Return the highest values over each cell, (outputs, cells)."""
    return np.array([kernel.highest for kernel in kernels.values()])
