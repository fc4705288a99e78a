"""Second moments and quadratic cost of a time-triggered loop under random losses, not bounded but computed.

From one transmission to the next, z = (x, x_c, u, w) becomes M₀z + v₀ if the update is delivered
and M₁z + v₁ if it is lost. With delays of several periods z has what the sensor measured at the
transmissions before, too, and the update is the one that arrives. v has the covariance W₀ or W₁ of
what the disturbances and the noise of the measurement add; it is independent of z and of the losses.
With the outcomes L_ij and P_ij and the probability π_i of the state i
(:mod:`noack.theory.random_losses.mean_square_growth`),

    X_j ← Σ_i L_ij (M₁ X_i M₁ᵀ + π_i W₁) + P_ij (M₀ X_i M₀ᵀ + π_i W₀).

If the spectral radius of the linear part is below 1, there is one fixed point, the stationary
second moments, and the sum over all periods from x(0) on is a system of linear equations, too. The
mean cost of a period is Σ_i Σ_j L_ij (trace(C₁ X_i) + π_i c₁) + P_ij (trace(C₀ X_i) + π_i c₀), with
the cost between the samples.

A period is composed of intervals (:class:`MomentStep`). Over an interval, x becomes M x + w with the
covariance W of w, and the cost ∫ xᵀFx dt of a form F has the mean xᵀCx + c for a given x. A flow of
a length t (:func:`propagation`), ẋ = G x with white noise of intensity R, has

    M = e^{Gt}, W = ∫₀ᵗ e^{Gs} R e^{Gᵀs} ds, C = ∫₀ᵗ e^{Gᵀs} F e^{Gs} ds,
    c = ∫₀ᵗ (t − s) trace(R e^{Gᵀs} F e^{Gs}) ds.

Where ‖G‖t ≤ 1, Gauss's formula with 12 nodes has an error below that of rounding; a longer interval
is composed of its halves. Whatever the units of the states, e^{Gt} is computed in similar ones.
"""

import math
from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np

from netem.core.errors import CallerError
from netem.impairments.loss_prediction import OutcomeChain
from netem.impairments.markov_chain import NotPredictableError
from noack.core.cached_method import cached_method
from noack.core.linear_systems import Matrix, Stack, Vector, balancing_exponents, exponential
from noack.proof.period_times import LoopTimes
from noack.scenario.resolution import LoopMatrices, loop_of
from noack.scenario.scenario import Scenario
from noack.theory.coverage import nonlinear_because
from noack.theory.random_losses.mean_square_growth import (
    from_triangles,
    mean_square_growth,
    require_few_slots,
    second_moments,
    solve_resolvent,
    triangles,
)
from noack.theory.time_triggered.exact_matrices import exactly
from noack.theory.time_triggered.scenario_times import intervals, loop_times, require_idle_watchdog
from noack.theory.time_triggered.time_triggered_loop import Timeline, repeated

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)
"""Of Gauss's formula on [−1, 1]."""
_MOST_PERIODS = 100_000
"""Limit of the periods until a horizon, which are followed one by one or by a power of their map."""


class MomentStep(NamedTuple):
    """An interval of a system of S states, and K quadratic costs."""

    matrix: Matrix
    """M, (S, S)."""
    noise: Matrix
    """W, (S, S)."""
    costs: Stack
    """C of each cost, (K, S, S)."""
    constants: Vector
    """c of each cost, (K,)."""

    def then(self, later: "MomentStep") -> "MomentStep":
        """Return this interval and the one after it."""
        M = self.matrix
        return MomentStep(
            later.matrix @ M,
            later.matrix @ self.noise @ later.matrix.T + later.noise,
            self.costs + M.T @ later.costs @ M,
            self.constants + later.constants + np.einsum("kij,ij->k", later.costs, self.noise),
        )

    def of_states(self, states: Sequence[int]) -> "MomentStep":
        """Leave out all but some states, which do not depend on the others after the interval."""
        rows, columns = np.ix_(states, states)
        M, W, C = self.matrix[rows, columns], self.noise[rows, columns], self.costs[:, rows, columns]
        return MomentStep(M, W, C, self.constants)


def propagation(generator: Matrix, intensity: Matrix, forms: Stack, duration_s: float) -> MomentStep:
    """Return the propagation by ẋ = G x + white noise.

    Args:
        generator: G, (S, S).
        intensity: R, (S, S).
        forms: F of each cost, (K, S, S).
        duration_s: t.
    """
    units = np.ldexp(1.0, balancing_exponents(np.abs(generator)))
    per_unit, squares = units[:, None] / units, np.outer(units, units)
    generator, intensity, forms = generator * per_unit, intensity * squares, forms / squares
    # Gauss's formula over a short interval, which is then doubled.
    size = float(np.linalg.norm(generator)) * duration_s
    halvings = max(math.ceil(math.log2(size)), 0) if size > 1 else 0
    t_s = duration_s / 2**halvings
    times_s, weights = (_NODES + 1) / 2 * t_s, _WEIGHTS / 2 * t_s
    E = np.array([exponential(generator * time_s) for time_s in times_s])
    costs = np.einsum("t,tji,kjl,tlm->tkim", weights, E, forms, E, optimize=True)
    short = MomentStep(
        exponential(generator * t_s) / per_unit,
        np.einsum("t,tij,jl,tml->im", weights, E, intensity, E, optimize=True) / squares,
        costs.sum(axis=0) * squares,
        np.einsum("t,tkij,ij->k", t_s - times_s, costs, intensity),
    )
    return repeated(short, 2**halvings)


def jump(matrix: Matrix, costs: int, noise: Matrix | None = None) -> MomentStep:
    """Return a change at an instant, without a cost: x becomes M x + w."""
    size = len(matrix)
    W = np.zeros((size, size)) if noise is None else noise
    return MomentStep(matrix, W, np.zeros((costs, size, size)), np.zeros(costs))


class SecondMoments(NamedTuple):
    """At a transmission: X_i, (modes, S, S), and π_i, (modes,)."""

    moments: Stack
    shares: Vector


class LoopPeriods:
    """The periods of a loop, of which each is a ``MomentStep`` of z = (x, x_c, u, w, older states).

    Args:
        loop: the loop's matrices.
        times: its times; a period is from a transmission to the next one.
        disturbance: covariance of what is added to ẋ, held over each step of the plant, (n, n).
        noise: covariance of the noise of a measurement, (n, n).
        forms: quadratic forms of (x, u), u the input of the controller, (K, n + m, n + m).
    """

    def __init__(
        self, loop: LoopMatrices, times: LoopTimes, disturbance: Matrix, noise: Matrix, forms: Stack
    ) -> None:
        n, m, behind = loop.n, loop.m, times.behind
        # z, the held disturbance d, and the measurements on their way, the newest one first.
        sizes = np.cumsum([n, n, m, m, *[n] * behind, n])
        x, x_c, u, w, *older, d, newest = np.split(np.eye(sizes[-1] + n), sizes)
        nothing, loop_rows, sent = 0 * d, [x, x_c, u, w], [newest, *older]
        self.times, self.size = times, 2 * (n + m) + behind * n
        generator = x.T @ (loop.A @ x + loop.B @ u + d) + x_c.T @ (loop.H @ x_c)
        xu = np.vstack([x, u])
        forms = np.einsum("ia,kij,jb->kab", xu, forms, xu, optimize=True)
        count, fresh = len(forms), d.T @ disturbance @ d

        def change(rows: Sequence[Matrix], held: Matrix = d, noise: Matrix | None = None) -> MomentStep:
            return jump(np.vstack([*rows, *older, held, newest]), count, noise)

        self._fresh = change(loop_rows, nothing, fresh)
        latch, tick = change([x, x_c, w, w], nothing, fresh), change([x, x_c, u, loop.K @ x_c])

        def flow_of(dt: int) -> MomentStep:
            return propagation(generator, 0 * generator, forms, times.seconds(dt))

        self._between = Timeline(times, flow_of, latch, tick, tick).between
        measured = np.vstack([*loop_rows, *older, d, x])
        self._send = jump(measured, count, newest.T @ noise @ newest)
        during_delay = propagation(
            loop.H, 0 * loop.H, np.zeros((0, n, n)), times.seconds(times.whole_delay)
        ).matrix
        self._receive = change([x, during_delay @ sent[-1], u, w])
        self._shift = jump(np.vstack([*loop_rows, *sent[:-1], d, newest]), count)

    def step(self, slot: int, delivered: bool, duration: int | None = None) -> MomentStep:
        """Return a period, or its first part, from just before its transmission.

        Args:
            slot: number of the transmission, modulo the number of slots.
            delivered: whether the update arrives that is due in this period.
            duration: length of this part; by default the period.
        """
        begin, duration = slot * self.times.period, duration or self.times.period
        end, arrival = begin + duration, begin + self.times.delay
        part = self._fresh.then(self._send)
        if delivered and arrival <= end:
            part = part.then(self._between(begin, arrival)).then(self._receive)
            part = part.then(self._between(arrival, end))
        else:
            part = part.then(self._between(begin, end))
        return part.then(self._shift).of_states(range(self.size))


class LoopMoments:
    """Moments of the loop of some periods under random outcomes.

    Args:
        periods: the periods.
        outcomes: the outcomes.
        states: components of z, which do not depend on the others; None: all.

    Raises:
        NotPredictableError: loop and losses have too many states.
    """

    def __init__(
        self, periods: LoopPeriods, outcomes: OutcomeChain, states: Sequence[int] | None = None
    ) -> None:
        require_few_slots(periods.times)
        self._periods, self._outcomes = periods, outcomes
        self.states = [*range(periods.size)] if states is None else [*states]
        self._slots = [
            (self._step(slot, delivered=True), self._step(slot, delivered=False))
            for slot in range(periods.times.slots)
        ]
        maps = [(exactly(delivered.matrix), exactly(lost.matrix)) for delivered, lost in self._slots]
        self.growth = mean_square_growth(maps, outcomes)
        """Of √E‖z‖² per period."""

    def _step(self, number: int, *, delivered: bool, duration: int | None = None) -> MomentStep:
        """Return a period; number 0 is the first one in which an update may arrive."""
        times = self._periods.times
        slot = (number + times.behind) % times.slots
        return self._periods.step(slot, delivered, duration).of_states(self.states)

    @cached_method
    def of_cost(self, number: int) -> "LoopMoments":
        """Return the moments of the components of z on which a cost depends, now or later.

        If all moments are bounded, these are the moments of all components.
        """
        steps = [step for slot in self._slots for step in slot]
        acts_on = np.any([step.matrix != 0 for step in steps], axis=0)
        matters = np.any([step.costs[number] != 0 for step in steps], axis=(0, 1))
        for _ in self.states:  # each round has the components that act on those before
            matters = matters | acts_on[matters].any(axis=0)
        if self.growth < 1 or matters.all():
            return self
        return LoopMoments(self._periods, self._outcomes, np.compress(matters, self.states).tolist())

    def _sum(self, entries: Vector) -> Vector:
        """Return the sum of what becomes of moments over all cycles of the slots.

        It is computed in units in which no component of z is much larger than others.
        """
        maps = [(delivered.matrix, lost.matrix) for delivered, lost in self._slots]
        exponents = balancing_exponents(np.abs(maps).max(axis=(0, 1)))
        i, j = np.triu_indices(len(self.states))
        units = np.tile(exponents[i] + exponents[j], len(self._outcomes.lost))
        scaled = np.ldexp(maps, exponents[:, None] - exponents)
        steps = [second_moments(delivered, lost, self._outcomes) for delivered, lost in scaled]
        cycle = reduce(lambda before, step: step @ before, steps)
        return np.ldexp(solve_resolvent(cycle, 1.0, np.ldexp(entries, units)), -units)

    @cached_method
    def stationary(self) -> tuple[SecondMoments, Vector] | None:
        """Return the moments at the transmissions of slot 0, and the mean costs per second.

        For periodic losses they are means over the periods. None: they grow without a bound.
        """
        if self.growth >= 1:
            return None
        shares = self._outcomes.distribution(len(self._slots))
        size = len(self.states)
        added, _ = self._cycle(SecondMoments(np.zeros((len(shares), size, size)), shares))
        entries = self._sum(triangles(added.moments))
        start = SecondMoments(from_triangles(entries, size), shares)
        times = self._periods.times
        return start, self._cycle(start)[1] / times.seconds(len(self._slots) * times.period)

    def transient(self, start: SecondMoments) -> Vector | None:
        """Return the costs of all periods from a start of z without noise; None: infinite."""
        if self.growth >= 1:
            return None
        rows, columns = np.ix_(self.states, self.states)
        first = SecondMoments(start.moments[:, rows, columns], 0 * start.shares)
        first, costs = self._before_arrivals(first, self._before_first)
        all_cycles = from_triangles(self._sum(triangles(first.moments)), len(self.states))
        return costs + self._cycle(SecondMoments(all_cycles, 0 * start.shares))[1]

    @property
    def _before_first(self) -> int:
        """Time from the first transmission to the beginning of the first period with an arrival."""
        return self._periods.times.behind * self._periods.times.period

    def _before_arrivals(self, start: SecondMoments, duration: int) -> tuple[SecondMoments, Vector]:
        """Return the moments after a time before the first arrival, and the mean costs until then."""
        times, current, costs = self._periods.times, start, np.zeros_like(self._slots[0][0].constants)
        for number in range(-(-duration // times.period)):
            part = min(duration - number * times.period, times.period)
            step = self._step(number - times.behind, delivered=False, duration=part)
            costs = costs + np.einsum("kab,jab->k", step.costs, current.moments)
            costs = costs + current.shares.sum() * step.constants
            moments = step.matrix @ current.moments @ step.matrix.T
            current = current._replace(moments=moments + current.shares[:, None, None] * step.noise)
        return current, costs

    def from_start(self, start: SecondMoments, duration: int) -> tuple[SecondMoments, Vector]:
        """Return the moments a time after the first transmission, and the mean costs until then.

        Raises:
            NotPredictableError: there are too many periods.
        """
        before = min(duration, self._before_first)
        current, costs = self._before_arrivals(start, before)
        if duration == before:
            return current, costs
        current, further = self.until(current, duration - before)
        return current, costs + further

    def until(self, start: SecondMoments, duration: int) -> tuple[SecondMoments, Vector]:
        """Return the moments after a time, in the unit of the loop's, and the mean costs until then.

        It starts with a period in which an update may arrive.

        Raises:
            NotPredictableError: there are too many periods.
        """
        number, rest = divmod(duration, self._periods.times.period)
        if number > _MOST_PERIODS:
            raise NotPredictableError("there are too many periods until the horizon")
        current, costs = start, np.zeros_like(self._slots[0][0].constants)
        cycles, single_periods = divmod(number, len(self._slots))
        count = len(triangles(start.moments)) + len(start.shares) + len(costs)
        if number > count * (len(self._slots) + count // 100):  # a power is computed in less time
            current, costs = self._after_cycles(start, cycles, count)
        else:
            single_periods = number
        for k in range(single_periods):
            current, added = self._advance(current, self._slots[k % len(self._slots)])
            costs = costs + added
        if rest:
            slot = number % len(self._slots)
            last = tuple(
                self._step(slot, delivered=is_delivered, duration=rest) for is_delivered in (True, False)
            )
            current, added = self._advance(current, last)
            costs = costs + added
        return current, costs

    def _after_cycles(self, start: SecondMoments, cycles: int, count: int) -> tuple[SecondMoments, Vector]:
        """Return the moments and costs after a number of cycles, by a power of the cycle's map.

        It maps ``count`` numbers: moments, shares, and the costs so far.
        """
        size = len(self.states)
        cuts = np.cumsum([len(triangles(start.moments)), len(start.shares)])

        def after(entries: Vector) -> Vector:
            moments, shares, costs = np.split(entries, cuts)
            end, added = self._cycle(SecondMoments(from_triangles(moments, size), shares))
            return np.concatenate([triangles(end.moments), end.shares, costs + added])

        cycle = np.transpose([after(entries) for entries in np.eye(count)])
        entries = np.zeros(count)
        entries[: cuts[-1]] = np.concatenate([triangles(start.moments), start.shares])
        moments, shares, costs = np.split(np.linalg.matrix_power(cycle, cycles) @ entries, cuts)
        return SecondMoments(from_triangles(moments, size), shares), costs

    def _cycle(self, current: SecondMoments) -> tuple[SecondMoments, Vector]:
        return self.until(current, len(self._slots) * self._periods.times.period)

    def _advance(self, current: SecondMoments, slot: tuple[MomentStep, ...]) -> tuple[SecondMoments, Vector]:
        """Return the moments after a period, and its mean costs."""
        moments, shares = np.zeros_like(current.moments), np.zeros_like(current.shares)
        costs = np.zeros_like(slot[0].constants)
        for step, transitions in zip(slot, (self._outcomes.delivered, self._outcomes.lost), strict=True):
            before, weights = (
                np.einsum("ij,iab->jab", transitions, current.moments),
                current.shares @ transitions,
            )
            moments += step.matrix @ before @ step.matrix.T + weights[:, None, None] * step.noise
            shares += weights
            costs += np.einsum("kab,jab->k", step.costs, before) + weights.sum() * step.constants
        return SecondMoments(moments, shares), costs


def require_predictable(resolved: Scenario) -> None:
    """Raise CallerError unless the loop's second moments follow linear equations."""
    resolved.coverage.require_direct_inputs()
    resolved.coverage.require_unchanging()
    if (why := nonlinear_because(resolved)) is not None:
        raise CallerError(f"{why}; the mean cost needs a linear plant with u = K x_c")
    if resolved.observer is not None:
        raise CallerError(f'observer.kind = "{resolved.observer.kind}": the mean cost needs none')
    for number, disturbance in enumerate(resolved.plant.disturbances):
        if any(disturbance.entries) and not disturbance.variance.any():
            raise CallerError(
                f"plant.disturbances.{number}: {disturbance.kind} is not random; the mean cost needs "
                "disturbances of kind gaussian or uniform"
            )
    if any(resolved.controller.safe_input or ()):
        raise CallerError("controller.safe_input: the mean cost needs the input 0 at the start")
    require_idle_watchdog(resolved)
    if len(intervals(resolved)) > 1:
        raise CallerError(
            f'trigger.policy = "{resolved.trigger.policy}": the mean cost needs a time-triggered '
            "sensor: --set 'trigger={policy=\"periodic\", period_s=0.5}'"
        )


def periods_of(resolved: Scenario, forms: Stack) -> LoopPeriods:
    """Return the periods of a scenario's loop.

    Raises:
        CallerError: the loop is not covered; the message names the setting.
    """
    require_predictable(resolved)
    loop, noise = loop_of(resolved), resolved.plant.noise_variances(*resolved.model.dimensions)
    disturbance = np.diag(noise.at_state) + loop.B @ np.diag(noise.at_input) @ loop.B.T
    times = loop_times(resolved, intervals(resolved)[0])
    return LoopPeriods(loop, times, disturbance, np.diag(noise.output), forms)


def start_of(resolved: Scenario, outcomes: OutcomeChain, size: int) -> SecondMoments:
    """Return the moments of z, of this size, before the first packet: x = x(0), and the input is 0."""
    loop, n = loop_of(resolved), resolved.model.dimensions[0]
    z = np.zeros(size)
    z[:n] = loop.x0
    if resolved.network.initial_sync == "known_state":
        z[n : 2 * n] = loop.x0
    shares = np.eye(len(outcomes.lost))[-1]
    return SecondMoments(np.multiply.outer(shares, np.outer(z, z)), shares)
