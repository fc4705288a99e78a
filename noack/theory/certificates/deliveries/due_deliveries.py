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
from noack.theory.bounds.enclosure import KernelBounds, NotDecayingError, Outputs, response_until
from noack.theory.bounds.error_growth import ErrorGrowth
from noack.theory.bounds.gains import Output, PlantGains
from noack.theory.bounds.stacked_norms import Stack
from noack.theory.certificates.deliveries.delivery_gaps import (
    ERROR,
    INPUT,
    ROUNDING,
    GapGains,
    GapLoop,
    Gaps,
    of_cells,
)

_MOST_TIMES = 6000
_DECAY_SHARES, _LEAST_SHARE = (0.9, 0.7, 0.4), 1e-6
"""Decay rates of Λ that are tried, as shares of that of the scaled A + BK."""
_AT_ONCE = 64
"""Outputs are bounded for so many balls at once."""
_CENTRING_ROUNDS = 3
_DELAYS = 64
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
        self._gains = gains = _contracting_gains(loop)
        self._x0 = loop.plant.start[:, 0]
        self._start_input = 0.0
        """Bound of ‖w‖ from the start, if it goes on after the next events; otherwise 0."""
        if loop.starts_late:
            responses = response_until(loop.scaled_H, plant.start, conditions.start_s)
            self._start_input = float(responses.through(loop.R).sup_on_grid()) * ROUNDING
        inverse = np.asarray(np.linalg.inv(gains.shape))
        # The outputs until the next delivery, for ‖Λξ‖ ≤ 1 and for S = 1, (outputs, cells).
        self._flows = loop.flows @ inverse
        self._feedthrough = np.array([[float(name == INPUT)] for name in loop.outputs])
        """1 for the output that contains w itself."""
        without_ages, self._output_sags = _outputs_without_ages(loop, inverse)
        by_age = self._feedthrough * gains.age_input, loop.input_responses @ gains.age_input
        self._outputs_from_state = without_ages + by_age[0] + by_age[1]
        self._outputs_from_removals = loop.grid.within_windows(loop.input_responses).max(axis=-1)
        # What follows after each gap: linear functions of a ball's centre, of ‖w‖, and of ρ and J.
        self._age_maps = _StackedMaps(loop.input_by_age @ inverse)
        self._centre_maps = _centre_maps(loop, gains.shape, inverse)
        self._from_input = np.vstack([gains.state_from_input, gains.removal_from_input]).T
        gamma, j, theta = gains.state_from_state, gains.removal_from_state, gains.theta
        removals = gains.removal_from_removals + gains.removals_left
        from_rho = [gamma, j, gamma + theta * j]
        from_J = [gains.state_from_removals, removals, theta * gains.sum_from_removals]
        self._from_extent = np.stack([from_rho, from_J], axis=-1)
        """Of ρ, J, and ρ + θJ, (3, gaps, 2)."""

    @property
    def gain(self) -> float:
        """By what the norm of x grows from one delivery to the next, at most; below 1."""
        return self._gains.largest

    def constants(self, unit: float) -> Constants:
        """Return the constants; ``unit`` is that of Δ and β̃."""
        plant, conditions, bound = self._loop.plant, self._loop.conditions, self._bound
        sup = dict(zip(self._loop.outputs, self._output_bounds().tolist(), strict=True))
        start_error = float(plant.start_up(conditions.start_s)[0])
        by_input, by_mismatch, _ = ErrorGrowth(plant, bound.times.longest_s, TriggerBound(0.0, None)).driven
        sensor = by_input * max(sup[INPUT], start_error) + by_mismatch * sup[Output.MISMATCH]
        apart_s = max(bound.times.shortest_s, conditions.spacing_s)
        return Constants(
            rate_per_s=plant.alpha_per_s,
            missing_events=conditions.dropouts + math.ceil(conditions.delay_s / apart_s - 1e-9),
            delta=sup[ERROR] / unit,
            overshoot=float(sensor) / unit,
            input_error=sup[INPUT],
            start_error=start_error,
            state=sup[Output.STATE],
            state_weighted=sup[Output.WEIGHTED],
            mismatch=sup[Output.MISMATCH],
            inter_event_s=apart_s,
            loop_gain=0.0,
            received_input_error=sup[INPUT],
        )

    def _output_bounds(self) -> Vector:
        """Follow balls until all later bounds are smaller; return those of all outputs, (outputs,)."""
        loop, counts = self._loop, self._loop.gaps.counts
        highest, start_balls = self._start_bounds_and_balls()
        recent = _RecentBalls(counts, start_balls)
        batch = int(counts[0])  # so many successive times do not depend on each other
        history = _BallHistory.without_balls(_MOST_TIMES + batch, loop.n)
        # Before, what the start causes is not among the balls yet.
        settled = max(int(counts[-1]) + 1, math.ceil(loop.conditions.start_s / loop.gaps.step_s))
        pending, tail = list[_Ball](), np.full_like(highest, np.inf)
        for first_time in range(1, _MOST_TIMES, batch):
            times = range(first_time, first_time + batch)
            new_balls = [
                self._enclosing(*balls, time) for time in times if (balls := recent.leading_to(time))
            ]
            recent.forget(times)
            if new_balls:
                recent.store([ball.time for ball in new_balls], self._after_gaps(new_balls))
                history.add(new_balls)
                pending += new_balls
            is_last = times.stop >= _MOST_TIMES
            if len(pending) >= _AT_ONCE or is_last:
                highest = np.maximum(highest, self._until_next_delivery(pending))
                pending.clear()
                if times[-1] < settled:
                    continue
                tail = self._tail(history, times[-1], highest)
                if (tail <= highest).all():
                    break
        return np.asarray(np.maximum(tail, highest) * ROUNDING)

    def _enclosing(self, centres: Matrix, extents: Matrix, time: int) -> "_Ball":
        """Return a small ball around balls with these centres, (k, n), and extents, (k, 3)."""
        middle, rounding = np.add.reduce(centres) / len(centres), 1e-12 * float(_lengths(centres).max())
        for number in range(1, _CENTRING_ROUNDS + 1):
            furthest = int((_lengths(centres - middle) + extents[:, 2]).argmax())
            middle = middle + (centres[furthest] - middle) / (number + 2)
        extents[:, ::2] += (_lengths(centres - middle) + rounding)[:, None]  # ρ, and ρ + θJ
        rho, J, weighted_sum = extents.max(axis=0).tolist()
        return _Ball(middle, rho * ROUNDING, J, weighted_sum * ROUNDING, self._gains.theta, time)

    def _after_gaps(self, balls: Sequence["_Ball"]) -> "_Balls":
        """Return what follows from balls after each gap, (k, gaps)."""
        centres, removals, weighted = self._centre_maps.apply(np.array([ball.centre for ball in balls]))
        rho, J = np.split(self._inputs(balls) @ self._from_input, 2, axis=1)  # from ‖w‖
        J = J + (_lengths(removals).max(axis=1) + _lengths(weighted)) * ROUNDING
        corners = np.array([ball.corners for ball in balls])[:, None]  # (k, 1, 2, corners)
        extents = (self._from_extent @ corners).max(axis=-1)  # (k, 3, gaps)
        extents += np.stack([rho, J, rho + self._gains.theta * J], axis=1)
        return _Balls(centres, extents.swapaxes(1, 2))

    def _tail(self, history: "_BallHistory", now: int, highest: Vector) -> Vector:
        """Bound all outputs from the last gap on; ``highest`` bounds those before."""
        last = slice(now - int(self._loop.gaps.counts[-1]), now + 1)
        J = float(np.nanmax(history.J[last]))
        weighted_sum = float(np.nanmax(_lengths(history.centres[last]) + history.weighted_sums[last]))
        tail = self._later_outputs(weighted_sum, J)
        if (tail > highest).any() and (last_return := history.last_return(last)) is not None:
            kappa, rest = last_return
            of_rest = self._later_outputs(rest, J)
            tail = np.minimum(tail, np.maximum(kappa * highest + of_rest, of_rest / (1 - kappa)))
        return tail

    def _later_outputs(self, weighted_sum: float, J: float) -> Vector:
        """Bound all outputs from events on at which ‖ξ‖ + θJ is at most ``weighted_sum``."""
        gains = self._gains
        decrease = 1 - float((gains.removal_from_removals + gains.removals_left).max())
        from_state = float(gains.removal_from_state.max()) * weighted_sum
        later_J = from_state / decrease if decrease > 0 else math.inf
        J = min(max(J, later_J), weighted_sum / gains.theta)
        return np.asarray(
            (self._outputs_from_state * weighted_sum + self._outputs_from_removals * J).max(axis=1)
        )

    def _age_inputs(self, centres: Matrix) -> Matrix:
        """Bound ‖w‖ over each cell, as far as it comes from the input's age, for centres (k, n)."""
        if self._loop.conditions.hold_s == 0:
            return np.zeros((len(centres), self._loop.grid.cells))
        (nodes,) = self._age_maps.apply(centres)
        at_nodes = of_cells(_lengths(nodes).max(axis=-1))
        return np.asarray((at_nodes + self._gains.age_sags * _lengths(centres)[:, None]) * ROUNDING)

    def _inputs(self, balls: Sequence["_Ball"]) -> Matrix:
        """Bound ‖w‖ over each cell for ξ = c of each ball, without J, (k, cells)."""
        loop, by_age = self._loop, self._age_inputs(np.array([ball.centre for ball in balls]))
        if not self._start_input:
            return by_age
        times = np.array([ball.time for ball in balls])[:, None]
        cells_s = times * loop.gaps.step_s + loop.grid.cell_s * np.arange(loop.grid.cells)
        return np.asarray(by_age + self._start_input * (cells_s < loop.conditions.start_s))

    def _until_next_delivery(self, balls: Sequence["_Ball"]) -> Vector:
        """Bound all outputs from events with these balls until the next delivery."""
        loop, highest = self._loop, []
        centres = np.array([ball.centre for ball in balls])
        corners = np.array([ball.corners for ball in balls])[..., None]
        nodes = np.einsum("ran,kn->kra", self._flows, centres)
        by_age, inputs = self._age_inputs(centres), self._inputs(balls)
        lengths = _lengths(centres)
        for number, C in enumerate(loop.outputs.values()):
            from_rho, from_J = self._outputs_from_state[number], self._outputs_from_removals[number]
            from_extent = (from_rho * corners[:, 0] + from_J * corners[:, 1]).max(axis=1)
            cells = of_cells(np.linalg.norm(nodes @ C.T, axis=-1))
            cells = cells + self._output_sags[number] * lengths[:, None] + from_extent
            cells = cells + inputs @ loop.input_responses[number].T
            highest.append((cells + self._feedthrough[number] * by_age).max())
        return np.array(highest)

    def _start_bounds_and_balls(self) -> tuple[Vector, "_Balls"]:
        """Bound all outputs until the next delivery after t = 0, and return what follows."""
        loop, x0, T = self._loop, self._x0, self._loop.conditions.start_s
        if loop.starts_late:
            start_ball = _Ball(self._gains.shape @ x0, 0.0, 0.0, 0.0, self._gains.theta)
            return self._until_next_delivery([start_ball]), self._after_gaps([start_ball])
        # What a w that ends at T has added to z, at the nodes from T on.
        F, cell_s, n, alpha = loop.F, loop.grid.cell_s, loop.n, loop.plant.alpha_per_s
        x, x_c = (
            exponential(generator * T) @ x0 for generator in (loop.plant.A + alpha * np.eye(n), loop.scaled_H)
        )
        first_node = math.ceil(T / cell_s - 1e-9)
        added_at_T = np.append(x, x_c - x) - exponential(F * T)[:, :n] @ x0
        step = exponential(F * cell_s)
        added = [exponential(F * max(first_node * cell_s - T, 0.0)) @ added_at_T]
        for _ in range(loop.grid.cells - first_node):
            added.append(step @ added[-1])
        age_input = self._age_inputs(x0[None] @ self._gains.shape.T)[0]
        start = _StartFlow(loop.flows @ x0, np.array(added), first_node, age_input)
        return self._outputs_from_start(start), self._balls_from_start(start)

    def _outputs_from_start(self, start: "_StartFlow") -> Vector:
        """Bound all outputs until the next delivery after t = 0, (outputs,)."""
        loop, T, F, first = self._loop, self._loop.conditions.start_s, self._loop.F, start.first_node
        BK, cells, cell_s = loop.BK, loop.grid.cells, loop.grid.cell_s
        with_input = start.free[first:] + start.added
        highest = []
        for number, C in enumerate(loop.outputs.values()):
            bounds = of_cells(np.linalg.norm(start.free @ C.T, axis=-1))
            later = np.linalg.norm(with_input @ C.T, axis=-1)
            bounds[first:] = np.maximum(bounds[first:], of_cells(later))
            bounds[first:] += T**2 / 8 * self._start_response(C, self._start_bend, cells)
            bounds[first:] += cell_s**2 / 8 * T * self._start_response(C @ F @ F, BK, cells)
            bounds[:first] += T * self._start_response(C, BK, max(first, 1))
            bounds += self._output_sags[number] * np.linalg.norm(self._gains.shape @ self._x0)
            bounds += loop.input_responses[number] @ start.age_input
            highest.append((bounds + self._feedthrough[number] * start.age_input).max())
        return np.array(highest)

    def _balls_from_start(self, start: "_StartFlow") -> "_Balls":
        """Return the balls after each gap from t = 0; the middle of the line is their centre."""
        loop, gains, T, n = self._loop, self._gains, self._loop.conditions.start_s, self._loop.n
        cells, bend = loop.grid.cells, self._start_bend
        added = start.added[loop.grid.ends - start.first_node]
        at_ends = start.free[loop.grid.ends]
        sag = T**2 / 8 * self._start_response(np.hstack([gains.shape, 0 * gains.shape]), bend, cells)
        half = np.linalg.norm(added[:, :n] @ gains.shape.T, axis=-1) / 2
        rho = half * ROUNDING + sag + gains.state_from_input @ start.age_input
        *J_sags, weighted = (
            T**2 / 8 * self._start_response(C, bend, cells) for C in loop.removal_outputs.values()
        )
        J = np.maximum(loop.removals(at_ends[:, n:]), loop.removals((at_ends + added)[:, n:]))
        J = J + max(J_sags) + weighted + gains.removal_from_input @ start.age_input
        centres = (at_ends[:, :n] + added[:, :n] / 2) @ gains.shape.T
        extents = np.stack([rho, J, rho + gains.theta * J], axis=-1)
        return _Balls(centres[None], extents[None])

    @property
    def _start_bend(self) -> Matrix:
        """Y: what w has added bends by e^{Fr} Y e^{Hs} x(0) where it ends at s, r ago."""
        loop = self._loop
        return loop.F @ loop.BK - loop.BK @ loop.scaled_H

    def _start_response(self, C: Matrix, Y: Matrix, cells: int) -> float:
        """Bound ‖C e^{Fr} Y e^{Hs} x(0)‖ over cells of r, and s up to T."""
        loop, T = self._loop, self._loop.conditions.start_s
        if T == 0:
            return 0.0
        until_s, G, largest = cells * loop.grid.cell_s, loop.scaled_H, 0.0
        for x in (self._x0, exponential(G * T) @ self._x0):
            kernel = response_until(loop.F, (Y @ x)[:, None], until_s, cells).through(C)
            largest = max(largest, float(kernel.sup_on_grid()))
        model_bend = response_until(G, self._x0[:, None], T).through(G @ G).sup_on_grid()
        gain = response_until(loop.F, Y, until_s, cells).through(C).sup_on_grid()
        return (largest + T**2 / 8 * float(model_bend) * float(gain)) * ROUNDING


class _StartFlow(NamedTuple):
    """z after t = 0, if the input is 0 until some time of at most T: w = −K e^{Hr} x(0) until then.

    What w adds to z, as a function of this time, is close to a line from 0 to ``added``.
    """

    free: Matrix
    """z without w at the nodes, (cells + 1, 2n)."""
    added: Matrix
    """What a w that ends at T has added, at the nodes from ``first_node`` on."""
    first_node: int
    """The first node from T on."""
    age_input: Vector
    """‖w‖ over each cell from the age of the input."""


class _Ball(NamedTuple):
    """‖ξ − c‖ ≤ ρ, J, and ρ + θJ at a delivered event, at most."""

    centre: Vector
    """c"""
    rho: float
    J: float
    weighted_sum: float
    theta: float
    time: int = 0
    """In steps of the gaps."""

    @property
    def corners(self) -> Matrix:
        """ρ and J where linear functions of both, that do not fall, are largest, (2, corners)."""
        rho, J = min(self.rho, self.weighted_sum), min(self.J, self.weighted_sum / self.theta)
        J_at_rho = max(min(J, (self.weighted_sum - rho) / self.theta), 0.0)
        rho_at_J = max(min(rho, self.weighted_sum - self.theta * J), 0.0)
        return np.array([[rho, rho_at_J], [J_at_rho, J]]) * ROUNDING


class _BallHistory(NamedTuple):
    """The balls of all times; NaN where there is none."""

    centres: Matrix
    J: Vector
    weighted_sums: Vector
    """ρ + θJ"""

    @classmethod
    def without_balls(cls, times: int, n: int) -> "_BallHistory":
        return cls(*(np.full(shape, np.nan) for shape in ((times, n), times, times)))

    def add(self, balls: Sequence[_Ball]) -> None:
        for ball in balls:
            self.centres[ball.time], self.J[ball.time] = ball.centre, ball.J
            self.weighted_sums[ball.time] = ball.weighted_sum

    def last_return(self, last: slice) -> tuple[float, float] | None:
        """Return |κ|, and ‖r‖ + ρ + θJ at most, of ξ(t) = κ c(t − m) + r at the last times t.

        Of the m that are tried, it is that with the smallest (‖r‖ + ρ + θJ)/(1 − |κ|); None if there is none.
        """
        times = np.arange(last.start, last.stop)[~np.isnan(self.J[last])]
        delays = np.unique(np.linspace(len(self.J[last]), last.start - 1, _DELAYS).astype(int))
        earlier, now = self.centres[times - delays[delays > 0, None]], self.centres[times]  # (m, times, n)
        kappas = (earlier * now).sum(axis=(1, 2)) / np.square(earlier).sum(axis=(1, 2))
        residuals = _lengths(now - kappas[:, None, None] * earlier) + 1e-12 * _lengths(now)
        rests, kappas = (residuals + self.weighted_sums[times]).max(axis=1), np.abs(kappas)
        bounds = np.where(kappas < 1, rests / (1 - kappas), np.nan)
        if np.isnan(bounds).all():
            return None
        best = int(np.nanargmin(bounds))
        return float(kappas[best]), float(rests[best])


class _Balls(NamedTuple):
    """The balls after each gap, for delivered events at some times."""

    centres: Stack
    """c, (times, gaps, n)"""
    extents: Stack
    """ρ, J, and ρ + θJ, (times, gaps, 3)"""


class _RecentBalls:
    """What follows from the balls of the last times, as far back as the longest gap."""

    def __init__(self, counts: NDArray[np.int64], start_balls: _Balls) -> None:
        self._counts, slots = counts, int(counts[-1]) + 1
        self._balls = _Balls(*(np.zeros((slots, *array.shape[1:])) for array in start_balls))
        """By their time modulo the number of slots."""
        self._has_balls = np.zeros(slots, dtype=bool)
        self.store([0], start_balls)

    def leading_to(self, time: int) -> tuple[Matrix, Matrix] | None:
        """Return centres and extents of the balls at a time, one for each gap; None if there is none."""
        slots = (time - self._counts) % len(self._has_balls)
        gaps = np.flatnonzero(self._has_balls[slots])
        if not len(gaps):
            return None
        return self._balls.centres[slots[gaps], gaps], self._balls.extents[slots[gaps], gaps]

    def forget(self, times: range) -> None:
        self._has_balls[np.array(times) % len(self._has_balls)] = False

    def store(self, times: list[int], balls: _Balls) -> None:
        slots = np.array(times) % len(self._has_balls)
        self._balls.centres[slots], self._balls.extents[slots] = balls
        self._has_balls[slots] = True


class _StackedMaps:
    """Matrices, stacks of (…, n), that one product applies to points."""

    def __init__(self, *stacks: Stack) -> None:
        self._shapes = [stack.shape[:-1] for stack in stacks]
        self._rows = np.vstack([stack.reshape(-1, stack.shape[-1]) for stack in stacks]).T.copy()
        ends = np.cumsum([math.prod(shape) for shape in self._shapes]).tolist()
        self._slices = [*map(slice, [0, *ends], ends)]

    def apply(self, points: Matrix) -> list[Stack]:
        """Return the products of each stack with points (k, n), of shape (k, …)."""
        products = points @ self._rows
        parts = zip(self._slices, self._shapes, strict=True)
        return [products[:, part].reshape(-1, *shape) for part, shape in parts]


def _centre_maps(loop: GapLoop, shape: Matrix, inverse: Matrix) -> _StackedMaps:
    """Return what maps Λξ to itself after each gap, and to what bounds J: at nodes, and between them."""
    at_ends, (nodes, sag) = loop.flows[loop.grid.ends], loop.removal_rows
    errors = at_ends[:, loop.n :] @ inverse
    return _StackedMaps(
        shape @ at_ends[:, : loop.n] @ inverse,
        nodes[:, None] @ errors,
        sag * loop.plant.error.weight @ errors,
    )


def _outputs_without_ages(loop: GapLoop, inverse: Matrix) -> tuple[Matrix, Matrix]:
    """Bound ‖C e^{Fr} (Λ⁻¹; 0)‖ over each cell, and how far it may lie above its nodes, (outputs, cells)."""
    grid, C = loop.grid, loop.outputs
    at_rest = np.vstack([inverse, np.zeros((loop.n, loop.n))])
    responses = response_until(loop.F, at_rest, grid.until_s, grid.cells)
    bends = {name: output @ loop.F @ loop.F for name, output in C.items()}
    highest, curvature = (_highest(responses.through_each(Outputs(rows))) for rows in (C, bends))
    return highest, grid.cell_s**2 / 8 * curvature


def _contracting_gains(loop: GapLoop) -> GapGains:
    """Return the gains in the first norm ‖Λξ‖ in which the loop decays from delivery to delivery.

    Raises:
        NoCertificateError: it grows in all norms that are tried.
    """
    smallest = math.inf
    for shape in _shapes(loop.plant):
        gains = loop.gains(shape)
        if gains.largest < 1:
            return gains
        smallest = min(smallest, gains.largest)
    raise NoCertificateError(
        f"in a norm the loop grows from delivery to delivery: {smallest:.3g}, not below 1", smallest
    )


def _shapes(plant: PlantGains) -> Iterator[Matrix]:
    """Yield matrices Λ that may suit: ‖Λx‖ decays while e_c is 0."""
    from scipy.linalg import solve_continuous_lyapunov  # slow to import

    decay_per_s, identity = -spectral_abscissa(plant.closed_loop), np.eye(len(plant.A))
    if decay_per_s <= 0:
        raise NotDecayingError(f"a mode of the loop grows at {-decay_per_s:.3g} /s")
    rate = plant.error.split_K[1] @ plant.error.H
    rate_form = rate.T @ rate + _LEAST_SHARE * np.linalg.norm(rate) ** 2 * identity
    for share, right in itertools.product(_DECAY_SHARES, (rate_form, identity)):
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
