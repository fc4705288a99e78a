"""Bounds of a loop whose events are at most some time apart, by what x can be at a delivery.

Let ξ = Λx at a delivered event. If events are due, the next delivered event is one of finitely many
times g later, and ``delivery_gaps.py`` bounds what g makes of ξ. So of every time t at which there
may be a delivered event, a ball ‖ξ − c‖ ≤ ρ and a bound S of the late effects of the updates in
flight (``delivery_balls.py``) follow from those a time g before:

    ρ(t) = max_g ‖Φ_g c − c(t)‖ + γ_g ρ + ∫‖ΛΨ‖ ‖w‖,      Φ_g = Λ (I 0) e^{Fg} (I; 0) Λ⁻¹

The c are any points; they follow the loop. This goes on until the bounds of the times before are
larger than all later ones. These have two bounds. No step increases ‖ξ‖ + θS. And as the loop is
linear, what follows from ξ(t) = κ c(t − m) + r is κ times what followed from c(t − m), and what
follows from r. If h bounds the outputs before t, and τ what follows from r, the outputs from t on
are at most y = |κ| max(y, h) + τ.
"""

import contextlib
import itertools
import math
from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np

from noack.core.linear_systems import Matrix, Vector, exponential, spectral_abscissa
from noack.core.number_format import apart_from
from noack.theory.bounds.certificate_terms import (
    Constants,
    NetworkConditions,
    NoCertificateError,
    TriggerBound,
)
from noack.theory.bounds.enclosure import KernelBounds, NotDecayingError, Outputs, response_until
from noack.theory.bounds.error_growth import ErrorGrowth
from noack.theory.bounds.gains import Output, PlantGains
from noack.theory.bounds.stacked_norms import ROUNDING, Stack, larger_ends
from noack.theory.certificates.deliveries.delivery_balls import (
    Ball,
    BallHistory,
    BallsAfterGaps,
    RecentBalls,
    lengths,
    squared_lengths,
)
from noack.theory.certificates.deliveries.delivery_gaps import ERROR, INPUT, GapGains, GapLoop, Gaps

MOST_TIMES = 6000
"""Maximum number of steps for which balls are followed; then the norm ‖ξ‖ + θS bounds the rest."""
BALLS_AT_ONCE = 64
"""Number of balls whose outputs are bounded at once, before a test of whether the bounds have settled."""
_DECAY_SHARES = (0.9, 0.7, 0.4)
"""Decay rates of Λ that are tried, as shares of that of the scaled A + BK."""
_LEAST_SHARE = 1e-6
"""Share of the identity in the right side of a Lyapunov equation, which makes it positive definite."""
_CENTRING_ROUNDS = 3
"""Moves of a centre towards the farthest ball, as in Bădoiu and Clarkson's algorithm for the smallest one."""


class Deliveries:
    """The deliveries of an undisturbed plant's loop, from its x(0) on.

    Raises:
        NoCertificateError: the times between deliveries are not covered, or the loop grows from one
            to the next.
    """

    def __init__(self, plant: PlantGains, conditions: NetworkConditions, bound: TriggerBound) -> None:
        self._bound = bound
        self.loop = loop = GapLoop(plant, conditions, Gaps.of(conditions, bound))
        self.gains = gains = _contracting_gains(loop)
        self._x0 = loop.plant.start[:, 0]
        self._start_input = 0.0
        """Bound of ‖w‖ from the start, if it goes on after the next events; otherwise 0."""
        if loop.starts_late:
            responses = response_until(loop.scaled_H, plant.start, conditions.start_s)
            self._start_input = float(responses.through(loop.R).sup_on_grid()) * ROUNDING
        inverse = np.asarray(np.linalg.inv(gains.scaling))
        # The outputs until the next delivery, for ‖Λξ‖ ≤ 1 and for S = 1, (outputs, cells).
        self._flows = loop.flows @ inverse
        without_ages, self._output_sags = _outputs_without_ages(loop, inverse)
        from_ages = loop.input_responses @ gains.age_input
        self._outputs_from_state = without_ages + loop.feedthrough * gains.age_input + from_ages
        self._outputs_from_late_effects = loop.grid.within_windows(loop.input_responses).max(axis=-1)
        # What follows after each gap: linear functions of a ball's centre, of ‖w‖, and of ρ and S.
        self._age_maps = _StackedMaps(loop.input_by_age @ inverse)
        self._centre_maps = _centre_maps(loop, gains.scaling, inverse)
        self._from_input = np.vstack([gains.state_from_input, gains.late_effect_from_input]).T
        self._from_extent = _maps_of_extents(gains)

    @property
    def gain(self) -> float:
        """By what the norm of x grows from one delivery to the next, at most; below 1."""
        return self.gains.largest

    def constants(self, unit: float) -> Constants:
        """Return the constants; ``unit`` is that of Δ and β̃."""
        plant, conditions, bound = self.loop.plant, self.loop.conditions, self._bound
        sup = dict(zip(self.loop.outputs, self._output_bounds().tolist(), strict=True))
        start_error = float(plant.start_up(conditions.start_s)[0])
        by_input, by_mismatch, _ = ErrorGrowth(plant, bound.times.longest_s, TriggerBound(0.0, None)).driven
        sensor = by_input * max(sup[INPUT], start_error) + by_mismatch * sup[Output.MISMATCH]
        inter_event_s = max(bound.times.shortest_s, conditions.spacing_s)
        return Constants(
            rate_per_s=plant.alpha_per_s,
            missing_events=conditions.dropouts + math.ceil(conditions.delay_s / inter_event_s - 1e-9),
            delta=sup[ERROR] / unit,
            overshoot=float(sensor) / unit,
            input_error=sup[INPUT],
            start_error=start_error,
            state=sup[Output.STATE],
            state_weighted=sup[Output.WEIGHTED],
            mismatch=sup[Output.MISMATCH],
            inter_event_s=inter_event_s,
            loop_gain=0.0,
            received_input_error=sup[INPUT],
            present_input_error=sup[INPUT],
        )

    def _output_bounds(self) -> Vector:
        """Follow balls until all later bounds are smaller; return those of all outputs, (outputs,)."""
        loop = self.loop
        longest, batch = int(loop.gaps.counts[-1]), int(loop.gaps.counts[0])
        # Before, what the start causes is not among the balls yet.
        settled = max(longest + 1, math.ceil(loop.conditions.start_s / loop.gaps.step_s))
        history = BallHistory.without_balls(MOST_TIMES + batch, loop.n)
        pending = list[Ball]()
        highest = self._outputs_from_start()
        later = np.full_like(highest, np.inf)
        for times, balls in self.balls():
            pending += balls
            is_last = times.stop >= MOST_TIMES
            if len(pending) >= BALLS_AT_ONCE or is_last:
                history.add(pending)
                highest = np.maximum(highest, self.outputs_until_next_delivery(pending))
                pending.clear()
                if times[-1] >= settled:
                    last = slice(times[-1] - longest, times[-1] + 1)
                    later = self._outputs_of_rest(history, last, highest)
                if is_last or (later <= highest).all():
                    break
        return np.asarray(np.maximum(later, highest) * ROUNDING)

    def balls(self) -> Iterator[tuple[range, list[Ball]]]:
        """Yield successive times, and a ball for each at which an event may be delivered, without end.

        Each batch of times is short enough that its balls do not depend on each other.
        """
        batch = int(self.loop.gaps.counts[0])
        recent = RecentBalls(self.loop.gaps.counts, self._balls_from_start())
        for first_time in itertools.count(1, batch):
            times = range(first_time, first_time + batch)
            balls = [self._enclosing(*parts, time) for time in times if (parts := recent.leading_to(time))]
            with_balls = [ball.time for ball in balls]
            if len(balls) < batch:
                recent.forget([time for time in times if time not in with_balls])
            if balls:
                recent.store(with_balls, self._after_gaps(balls))
            yield times, balls

    def _enclosing(self, centres: Matrix, extents: Matrix, time: int) -> Ball:
        """Return a small ball around balls with these centres, (k, n), and extents, (k, 3)."""
        middle = np.add.reduce(centres) / len(centres)
        rounding = 1e-12 * math.sqrt(squared_lengths(centres).max())
        # The middle of several centres moves towards the ball that is furthest from it.
        weighted_sums = extents[:, 2]
        for number in range(1, _CENTRING_ROUNDS + 1) if len(centres) > 1 else ():
            offsets = centres - middle
            furthest = (lengths(offsets) + weighted_sums).argmax()
            middle = middle + offsets[furthest] / (number + 2)
        added = lengths(centres - middle) + rounding
        radius_and_sum = extents[:, ::2]  # ρ, and ρ + θS
        np.add(radius_and_sum, added[:, None], out=radius_and_sum)
        radius, late_effects, weighted_sum = np.maximum.reduce(extents).tolist()
        return Ball(middle, radius * ROUNDING, late_effects, weighted_sum * ROUNDING, self.gains.theta, time)

    def _after_gaps(self, balls: Sequence[Ball]) -> BallsAfterGaps:
        """Return what follows from balls after each gap, (k, gaps)."""
        centres = np.array([ball.centre for ball in balls])
        later_centres, late_at_nodes, late_sags = self._centre_maps.apply(centres)
        # From ρ and S, from c, and from ‖w‖.
        corners = np.array([ball.corners for ball in balls])[:, None]  # (k, 1, 2, corners)
        extents = np.maximum.reduce(self._from_extent @ corners, axis=-1)  # (k, 3, gaps)
        at_nodes = np.sqrt(np.maximum.reduce(squared_lengths(late_at_nodes), axis=1))
        late_effects = (at_nodes + lengths(late_sags)) * ROUNDING
        if self.loop.conditions.hold_s > 0 or self._is_start(balls):
            by_input = self._inputs(balls, self._age_inputs(centres)) @ self._from_input
            gaps = len(self.gains.state_from_state)
            radius, late_effects = by_input[:, :gaps], by_input[:, gaps:] + late_effects
        else:  # ‖w‖ is 0
            radius = np.zeros(1)
        extents[:, 0] += radius
        extents[:, 1] += late_effects
        extents[:, 2] += radius + self.gains.theta * late_effects
        return BallsAfterGaps(later_centres, extents.swapaxes(1, 2))

    def outputs_until_next_delivery(self, balls: Sequence[Ball]) -> Vector:
        """Bound all outputs from events with these balls until the next delivery, (outputs,)."""
        loop = self.loop
        centres = np.array([ball.centre for ball in balls])
        corners = np.array([ball.corners for ball in balls])[..., None]
        at_nodes = np.einsum("ran,kn->kra", self._flows, centres)
        by_age = self._age_inputs(centres)
        inputs = self._inputs(balls, by_age)
        highest = []
        for number, C in enumerate(loop.outputs.values()):
            # From c, from ρ and S, and from ‖w‖.
            cells = larger_ends(np.linalg.norm(at_nodes @ C.T, axis=-1))
            from_radius = self._outputs_from_state[number] * corners[:, 0]
            from_late_effects = self._outputs_from_late_effects[number] * corners[:, 1]
            from_extent = (from_radius + from_late_effects).max(axis=1)
            cells = cells + self._output_sags[number] * lengths(centres)[:, None] + from_extent
            cells = cells + inputs @ loop.input_responses[number].T
            highest.append((cells + loop.feedthrough[number] * by_age).max())
        return np.array(highest)

    def _outputs_of_rest(self, history: BallHistory, last: slice, highest: Vector) -> Vector:
        """Bound all outputs from the last longest gap on; ``highest`` bounds those before."""
        late_effects = float(np.nanmax(history.late_effects[last]))
        weighted_sum = float(np.nanmax(lengths(history.centres[last]) + history.weighted_sums[last]))
        later = self._later_outputs(weighted_sum, late_effects)
        if (later > highest).any() and (last_return := history.last_return(last)) is not None:
            kappa, rest = last_return
            of_rest = self._later_outputs(rest, late_effects)
            later = np.minimum(later, outputs_after_return(kappa, highest, of_rest))
        return later

    def _later_outputs(self, weighted_sum: float, late_effects: float) -> Vector:
        """Bound all outputs from events on at which ‖ξ‖ + θS is at most ``weighted_sum``."""
        gains = self.gains
        decrease = 1 - float((gains.late_effect_from_late_effects + gains.late_effects_left).max())
        from_state = float(gains.late_effect_from_state.max()) * weighted_sum
        later_late_effects = from_state / decrease if decrease > 0 else math.inf
        late_effects = min(max(late_effects, later_late_effects), weighted_sum / gains.theta)
        from_state_and_late_effects = (
            self._outputs_from_state * weighted_sum + self._outputs_from_late_effects * late_effects
        )
        return np.asarray(from_state_and_late_effects.max(axis=1))

    def _age_inputs(self, centres: Matrix) -> Matrix:
        """Bound ‖w‖ over each cell, as far as it comes from the input's age, for centres (k, n)."""
        if self.loop.conditions.hold_s == 0:
            return np.zeros((len(centres), self.loop.grid.cells))
        (nodes,) = self._age_maps.apply(centres)
        at_nodes = np.sqrt(larger_ends(np.maximum.reduce(squared_lengths(nodes), axis=-1)))
        return np.asarray((at_nodes + self.gains.age_sags * lengths(centres)[:, None]) * ROUNDING)

    def _inputs(self, balls: Sequence[Ball], by_age: Matrix) -> Matrix:
        """Bound ‖w‖ over each cell for ξ = c of each ball, without S, (k, cells)."""
        if not self._is_start(balls):
            return by_age
        gaps, grid = self.loop.gaps, self.loop.grid
        times = np.array([ball.time for ball in balls])[:, None]
        cells_s = times * gaps.step_s + grid.cell_s * np.arange(grid.cells)
        return np.asarray(by_age + self._start_input * (cells_s < self.loop.conditions.start_s))

    def _is_start(self, balls: Sequence[Ball]) -> bool:
        """Return whether ‖w‖ from the start goes on at the first of these balls."""
        loop = self.loop
        return self._start_input > 0 and balls[0].time * loop.gaps.step_s < loop.conditions.start_s

    @property
    def _start_ball(self) -> Ball:
        return Ball(self.gains.scaling @ self._x0, 0.0, 0.0, 0.0, self.gains.theta)

    @cached_property
    def _first_gap(self) -> "_FirstGap":
        age_input = self._age_inputs(self._x0[None] @ self.gains.scaling.T)[0]
        return _FirstGap(self.loop, self.gains, self._output_sags, age_input)

    def _outputs_from_start(self) -> Vector:
        """Bound all outputs until the next delivery after t = 0, (outputs,)."""
        if self.loop.starts_late:
            return self.outputs_until_next_delivery([self._start_ball])
        return self._first_gap.outputs()

    def _balls_from_start(self) -> BallsAfterGaps:
        """Return the balls after each gap from t = 0."""
        return self._after_gaps([self._start_ball]) if self.loop.starts_late else self._first_gap.balls()


def outputs_after_return(kappa: float, highest: Vector, of_rest: Vector) -> Vector:
    """Bound y ≤ |κ| max(y, h) + τ: all later outputs, for h before and what follows from the rest, τ."""
    return np.asarray(np.maximum(kappa * highest + of_rest, of_rest / (1 - kappa)))


class _FirstGap:
    """The gap from t = 0 to the next delivery, if updates act before the next event.

    Until some time of at most T the input is 0: w = −K e^{Hr} x(0) until then. What w adds to z, as a
    function of this time, is close to a line from 0 to what a w that ends at T adds.
    """

    def __init__(self, loop: GapLoop, gains: GapGains, output_sags: Matrix, age_input: Vector) -> None:
        self.loop, self.gains, self._x0 = loop, gains, loop.plant.start[:, 0]
        self._output_sags = output_sags
        self._age_input = age_input
        """‖w‖ over each cell from the age of the input."""
        self._free = loop.flows @ self._x0
        """z without w at the nodes, (cells + 1, 2n)."""
        self._bend = loop.F @ loop.input_by_state - loop.input_by_state @ loop.scaled_H
        """Y: what w has added bends by e^{Fr} Y e^{Hs} x(0) where it ends at s, r ago."""
        self._first_node = math.ceil(loop.conditions.start_s / loop.grid.cell_s - 1e-9)
        """The first node from T on."""
        self._added = self._added_by_input()
        """What a w that ends at T has added, at the nodes from ``_first_node`` on."""

    def _added_by_input(self) -> Matrix:
        loop, x0, T = self.loop, self._x0, self.loop.conditions.start_s
        # At T: z with an input of 0, minus z with w = 0.
        drift = loop.plant.A + loop.plant.alpha_per_s * np.eye(loop.n)
        x = exponential(drift * T) @ x0
        x_c = exponential(loop.scaled_H * T) @ x0
        added_at_T = np.append(x, x_c - x) - exponential(loop.F * T)[:, : loop.n] @ x0
        # At the nodes from T on.
        cell_s = loop.grid.cell_s
        step = exponential(loop.F * cell_s)
        added = [exponential(loop.F * max(self._first_node * cell_s - T, 0.0)) @ added_at_T]
        for _ in range(loop.grid.cells - self._first_node):
            added.append(step @ added[-1])
        return np.array(added)

    def outputs(self) -> Vector:
        """Bound all outputs until the next delivery, (outputs,)."""
        loop, first = self.loop, self._first_node
        T, cells = loop.conditions.start_s, loop.grid.cells
        with_input = self._free[first:] + self._added
        highest = []
        for number, C in enumerate(loop.outputs.values()):
            # At the nodes: without w, and with a w until T.
            bounds = larger_ends(np.linalg.norm(self._free @ C.T, axis=-1))
            later = np.linalg.norm(with_input @ C.T, axis=-1)
            bounds[first:] = np.maximum(bounds[first:], larger_ends(later))
            # A w until an earlier time, and times between two nodes.
            bounds[first:] += T**2 / 8 * self._response(C, self._bend, cells)
            second_derivative = self._response(C @ loop.F @ loop.F, loop.input_by_state, cells)
            bounds[first:] += loop.grid.cell_s**2 / 8 * T * second_derivative
            bounds[:first] += T * self._response(C, loop.input_by_state, max(first, 1))
            bounds += self._output_sags[number] * np.linalg.norm(self.gains.scaling @ self._x0)
            # The age of the input.
            bounds += loop.input_responses[number] @ self._age_input
            highest.append((bounds + loop.feedthrough[number] * self._age_input).max())
        return np.array(highest)

    def balls(self) -> BallsAfterGaps:
        """Return the balls after each gap; the middle of the line is their centre."""
        loop, gains = self.loop, self.gains
        T, n, cells = loop.conditions.start_s, loop.n, loop.grid.cells
        at_ends = self._free[loop.grid.ends]
        added = self._added[loop.grid.ends - self._first_node]
        centres = (at_ends[:, :n] + added[:, :n] / 2) @ gains.scaling.T
        # ρ: half of the line, its bend, and the age of the input.
        half = np.linalg.norm(added[:, :n] @ gains.scaling.T, axis=-1) / 2
        scaling_rows = np.hstack([gains.scaling, 0 * gains.scaling])
        sag = T**2 / 8 * self._response(scaling_rows, self._bend, cells)
        radius = half * ROUNDING + sag + gains.state_from_input @ self._age_input
        # S: the larger one of both ends of the line, and the same.
        *late_sags, weighted_sag = (
            T**2 / 8 * self._response(C, self._bend, cells) for C in loop.late_effect_outputs.values()
        )
        without_w, with_w = (loop.late_effects(errors[:, n:]) for errors in (at_ends, at_ends + added))
        late_effects = np.maximum(without_w, with_w)
        late_effects = late_effects + max(late_sags) + weighted_sag
        late_effects = late_effects + gains.late_effect_from_input @ self._age_input
        extents = np.stack([radius, late_effects, radius + gains.theta * late_effects], axis=-1)
        return BallsAfterGaps(centres[None], extents[None])

    def _response(self, C: Matrix, Y: Matrix, cells: int) -> float:
        """Bound ‖C e^{Fr} Y e^{Hs} x(0)‖ over cells of r, and s up to T."""
        loop, T, G = self.loop, self.loop.conditions.start_s, self.loop.scaled_H
        if T == 0:
            return 0.0
        until_s = cells * loop.grid.cell_s
        # At s = 0 and s = T.
        largest = 0.0
        for x in (self._x0, exponential(G * T) @ self._x0):
            kernel = response_until(loop.F, (Y @ x)[:, None], until_s, cells).through(C)
            largest = max(largest, float(kernel.sup_on_grid()))
        # Between them.
        model_bend = response_until(G, self._x0[:, None], T).through(G @ G).sup_on_grid()
        gain = response_until(loop.F, Y, until_s, cells).through(C).sup_on_grid()
        return (largest + T**2 / 8 * float(model_bend) * float(gain)) * ROUNDING


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


def _centre_maps(loop: GapLoop, scaling: Matrix, inverse: Matrix) -> _StackedMaps:
    """Return the maps of Λξ to Λξ after each gap, and to what bounds J: at nodes, and between them."""
    at_ends = loop.flows[loop.grid.ends]
    nodes, sag = loop.late_effect_rows
    errors = at_ends[:, loop.n :] @ inverse
    return _StackedMaps(
        scaling @ at_ends[:, : loop.n] @ inverse,
        nodes[:, None] @ errors,
        sag * loop.plant.error.weight @ errors,
    )


def _maps_of_extents(gains: GapGains) -> Stack:
    """Return the maps of ρ and S to ρ, S, and ρ + θS after each gap, (3, gaps, 2)."""
    from_radius = [
        gains.state_from_state,
        gains.late_effect_from_state,
        gains.state_from_state + gains.theta * gains.late_effect_from_state,
    ]
    from_late_effects = [
        gains.state_from_late_effects,
        gains.late_effect_from_late_effects + gains.late_effects_left,
        gains.theta * gains.weighted_sum_from_late_effects,
    ]
    return np.stack([from_radius, from_late_effects], axis=-1)


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
    for scaling in _scalings(loop.plant):
        gains = loop.gains(scaling)
        if gains.largest < 1:
            return gains
        smallest = min(smallest, gains.largest)
    raise NoCertificateError(
        f"in a norm the loop grows from delivery to delivery: {apart_from(1, smallest)}, not below 1",
        smallest,
    )


def _scalings(plant: PlantGains) -> Iterator[Matrix]:
    """Yield matrices Λ that may suit: ‖Λx‖ decays while e_c is 0."""
    from scipy.linalg import solve_continuous_lyapunov  # slow to import

    decay_per_s = -spectral_abscissa(plant.closed_loop)
    identity = np.eye(len(plant.A))
    if decay_per_s <= 0:
        raise NotDecayingError(f"a mode of the loop grows at {-decay_per_s:.3g} /s")
    rate = plant.error.split_K[1] @ plant.error.H
    rate_form = rate.T @ rate + _LEAST_SHARE * np.linalg.norm(rate) ** 2 * identity
    for share, right in itertools.product(_DECAY_SHARES, (rate_form, identity)):
        shifted = plant.closed_loop + share * decay_per_s * identity
        form = solve_continuous_lyapunov(shifted.T, -right)
        with contextlib.suppress(np.linalg.LinAlgError):
            yield np.linalg.cholesky(0.5 * (form + form.T)).T


def _highest(kernels: dict[str, KernelBounds]) -> Matrix:
    """Return the highest values over each cell, (outputs, cells)."""
    return np.array([kernel.highest for kernel in kernels.values()])
