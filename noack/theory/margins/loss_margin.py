"""The losses that a loop tolerates whatever its sensor measures: stable for all patterns, or not.

The sensor is time-triggered, or transmits at unknown times with a longest time between two. What
may happen between two deliveries under a guarantee is a graph. Its nodes are the states of the
guarantee's automaton just after a delivery, and the times at which the sensor transmits relative to
the controller's ticks. An edge is the time from a delivered update to the next delivered one. A
pattern of losses, and of such times, is a path. The edges, with the loop's maps over their times
(:mod:`noack.theory.margins.time_triggered_loop`), are a switched system
(:mod:`noack.theory.margins.switched_system`).
"""

import time
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from noack.core.errors import CallerError
from noack.guarantee.loss_guarantee import LongestBurst, LossAutomaton, LossGuarantee, outcome_letters
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack.theory.margins.exact_matrices import IntervalMatrix
from noack.theory.margins.joint_spectral_radius import ACCURACY, MOST_VERTICES, joint_spectral_radius
from noack.theory.margins.scenario_times import intervals, loop_times, require_covered
from noack.theory.margins.switched_system import Edge
from noack.theory.margins.time_triggered_loop import LoopTimes, TimeTriggeredLoop

MOST_EDGES = 5000
"""Limit of the graph of a guarantee: with more, the bounds of its growth would take too long."""
_COARSE_ACCURACY, _QUICK_ACCURACY = 1e-2, 3e-2
"""Wanted upper/lower − 1 of :meth:`LossMargin.coarse_bounds` and :meth:`LossMargin.first_bounds`."""


EVERY_STEP = range(1, 2)
"""The numbers of steps that may be between two transmissions: the sensor transmits at every step."""


class Burst(NamedTuple):
    """Losses between two deliveries, as an edge of the graph."""

    source: int
    target: int
    slot: int
    """Number of the step of the first delivered update, modulo the number of slots."""
    usable: int
    """How long the update before the first one is used after the first one's transmission."""
    losses: int
    steps: int
    """Time between the two deliveries."""

    def intervals(self, between: range) -> list[int]:
        """Return times between the transmissions, (losses + 1,), in steps; the longest first.

        ``between`` are those that are possible.
        """
        intervals, remaining = [], self.steps
        for further in range(self.losses, -1, -1):
            intervals.append(min(between[-1], remaining - further * between[0]))
            remaining -= intervals[-1]
        return intervals


def list_bursts(
    guarantee: LossGuarantee,
    loop: LoopTimes,
    between: range = EVERY_STEP,
) -> list[Burst]:
    """Return the graph of a guarantee between deliveries; node 0 is that of the first delivery.

    States of the automaton that allow the same are one node. Of several edges with the same nodes and
    the same time, only the one with the fewest losses is kept: its map is that of all of them.

    Raises:
        CallerError: there are more than 5,000 edges.
    """
    automaton = LossAutomaton(guarantee)
    first = int(automaton.after_delivery(np.zeros(1, int))[0])
    begin = first, 0, loop.usable(1, loop.delay)
    numbers, pending = {begin: 0}, [begin]
    bursts: dict[tuple[int, int, int], Burst] = {}
    while pending:
        node = state, slot, usable = pending.pop()
        source, losses = numbers[node], 0
        while state >= 0:
            after = int(automaton.after_delivery(np.array([state]))[0])
            sent = losses + 1
            for steps in range(sent * between[0], sent * between[-1] + 1):
                target = after, (slot + steps) % loop.slots, loop.usable(steps, loop.delay)
                if target not in numbers:
                    numbers[target] = len(numbers)
                    pending.append(target)
                burst = Burst(source, numbers[target], slot, usable, losses, steps)
                bursts.setdefault((source, numbers[target], steps), burst)
            if len(bursts) > MOST_EDGES:
                raise CallerError(
                    f"network: {guarantee.meaning}: more than {MOST_EDGES:,} transitions; reduce "
                    "mansd, the windows of the constraints, or the number of measurements between "
                    "two events"
                )
            state, losses = int(automaton.after_loss(np.array([state]))[0]), sent
    return _merged(list(bursts.values()))


def _merged(bursts: list[Burst]) -> list[Burst]:
    """Return the graph with one node for all that have the same paths, the lowest of them.

    Nodes are divided as long as edges of one class differ in their losses, times or targets' class.
    """
    leaving: dict[int, list[Burst]] = {}
    for burst in bursts:
        leaving.setdefault(burst.source, []).append(burst)
    classes, count = dict.fromkeys(leaving, 0), 0
    while len(set(classes.values())) > count:
        count = len(set(classes.values()))
        merged = {
            node: frozenset((*burst[2:], classes[burst.target]) for burst in group)
            for node, group in leaving.items()
        }
        numbers = {future: number for number, future in enumerate(dict.fromkeys(merged.values()))}
        classes = {node: numbers[future] for node, future in merged.items()}
    lowest: dict[int, int] = {}
    for node in sorted(classes):
        lowest.setdefault(classes[node], node)
    return [
        burst._replace(target=lowest[classes[burst.target]])
        for node in lowest.values()
        for burst in leaving[node]
    ]


class Stability(NamedTuple):
    """Bounds of the growth of all loss patterns of a guarantee."""

    lower: float
    """The pattern grows at least by this factor per longest interval, in the long run."""
    upper: float
    """No pattern grows by more than this factor per longest interval, in the long run."""
    pattern: tuple[bool, ...]
    """Whether each update is delivered, in a pattern that repeats from the first update on; mostly
    it begins with a delivery."""
    intervals_s: tuple[float, ...]
    """The time from each update of the pattern to the next one."""
    vertices: int
    """Number of vertices of the polytopes that prove the upper bound; 0: it has another proof."""
    needed_effort: float = 0.0
    """If undecided: an estimate of the effort (1: the default) that would prove stability, if the
    growth is the lower bound; infinite if that is too close to 1."""
    took_s: float = 0.0
    """CPU time."""

    @property
    def verdict(self) -> str:
        """The verdict in a word: stable, destabilised or undecided."""
        if self.upper < 1:
            return "stable"
        return "destabilised" if self.lower > 1 else "undecided"

    def with_upper_of(self, other: "Stability") -> "Stability":
        """Return the same, with the upper bound of a guarantee that allows all these patterns."""
        if other.upper >= self.upper:
            return self
        return self._replace(upper=other.upper, vertices=other.vertices)

    def with_lower_of(self, other: "Stability") -> "Stability":
        """Return the same, with the lower bound of a guarantee whose patterns are among these."""
        if other.lower <= self.lower:
            return self
        return self._replace(lower=other.lower, pattern=other.pattern, intervals_s=other.intervals_s)

    @property
    def is_periodic(self) -> bool:
        """Whether the updates of the pattern are equally far apart."""
        return len(set(self.intervals_s)) <= 1

    @property
    def text(self) -> str:
        """The pattern, one letter per update: ``D`` delivered, ``L`` lost.

        If they differ, the times to the next update stand between.
        """
        letters = outcome_letters(self.pattern)
        if self.is_periodic:
            return letters
        return " ".join(
            f"{letter} ({interval_s:g} s)"
            for letter, interval_s in zip(letters, self.intervals_s, strict=True)
        )


def uncapped(guarantee: LossGuarantee) -> LossGuarantee:
    """Return the rules besides the maximum number of consecutive losses."""
    return LossGuarantee(tuple(rule for rule in guarantee.rules if not isinstance(rule, LongestBurst)))


def capped(guarantee: LossGuarantee, losses: int) -> LossGuarantee:
    """Return a guarantee with another maximum number of consecutive losses."""
    return LossGuarantee((LongestBurst(losses), *uncapped(guarantee).rules))


class LossMargin:
    """The loop of a scenario, with its own or another longest time between two transmissions.

    Args:
        resolved: the resolved scenario.
        longest: longest time between two transmissions, in measurements; by default the scenario's.

    Raises:
        CallerError: the loop is not covered; the message names the setting.
    """

    def __init__(self, resolved: Scenario, longest: int | None = None) -> None:
        require_covered(resolved)
        loop = loop_of(resolved)
        self.guarantee = resolved.network.guarantee
        between = intervals(resolved)
        self.shortest, self.longest = between[0], between[-1]
        if longest is not None:
            is_regular = self.shortest == self.longest
            self.shortest = longest if is_regular else min(self.shortest, longest)
            self.longest = longest
        is_periodic = self.shortest == self.longest
        self._unit = unit = self.longest if is_periodic else 1
        self._measurement = resolved.timing.measurement_period
        self._between = range(self.shortest // unit, self.longest // unit + 1)
        """The numbers of steps that may be between two transmissions."""
        times = loop_times(resolved, unit)
        self.loop = TimeTriggeredLoop(loop.A, loop.B, loop.K, loop.H, times)
        # A controller that knows x(0) gets its first update after a period.
        knows_start = resolved.network.initial_sync == "known_state"
        # Where updates are on their way for several periods, the first one arrives so much later.
        self._first_slot = (int(knows_start) + times.behind) % times.slots
        self.maps: Callable[[int, int, int], IntervalMatrix] = cache(self.loop.map)
        """The loop's maps by slot, use of the update before, and number of lost updates."""

    def seconds(self, measurements: int) -> float:
        """Return the time of a number of measurements."""
        return self._measurement.times(measurements).seconds

    def bursts(self, guarantee: LossGuarantee) -> list[Burst]:
        """Return the graph of a guarantee; raise CallerError if it has too many edges."""
        return list_bursts(guarantee, self.loop.times, self._between)

    def edges(self, bursts: list[Burst]) -> list[Edge]:
        """Return a graph with the loop's maps."""
        maps = [self.maps(burst.slot, burst.usable, burst.steps - 1) for burst in bursts]
        return [
            Edge(burst.source, burst.target, matrix, burst.steps)
            for burst, matrix in zip(bursts, maps, strict=True)
        ]

    def stability(
        self,
        guarantee: LossGuarantee | None = None,
        accuracy: float = ACCURACY,
        *,
        decide: bool = True,
        effort: float = 1.0,
    ) -> Stability:
        """Bound the growth of all patterns of a guarantee, by default the scenario's.

        Args:
            guarantee: the guarantee.
            accuracy: wanted upper/lower − 1.
            decide: whether bounds on both sides of 1 are improved.
            effort: factor of the limits of the work for that.

        Raises:
            CallerError: the loop grows so much between deliveries that products overflow.
        """
        bursts = self.bursts(guarantee or self.guarantee)
        begun_s = time.process_time()
        try:
            with np.errstate(over="raise"):
                stability = self._bounded(bursts, accuracy, decide=decide, effort=effort)
        except (OverflowError, FloatingPointError):
            raise CallerError(
                "the loop grows beyond 1e308 within some deliveries, or the units of its states and "
                "inputs are too different; reduce mansd or the period, or use other units"
            ) from None
        return stability._replace(took_s=time.process_time() - begun_s)

    def _bounded(self, bursts: list[Burst], accuracy: float, *, decide: bool, effort: float) -> Stability:
        # Short steps would need many vertices.
        vertices = MOST_VERTICES if self._between == EVERY_STEP else 0
        radius = joint_spectral_radius(
            self.edges(bursts),
            accuracy=accuracy / self._between[-1],
            most_vertices=vertices,
            threshold=1.0 if decide else None,
            effort=effort,
        )
        path = [bursts[number] for number in radius.cycle]
        # In another slot than the first update's the pattern may grow less.
        slots = [burst.slot for burst in path]
        begin = slots.index(self._first_slot) if self._first_slot in slots else 0
        path = path[begin:] + path[:begin]
        pattern = [delivered for burst in path for delivered in (True, *[False] * burst.losses)]
        if path and self._between == EVERY_STEP:
            begin = (self._first_slot - path[0].slot) % self.loop.times.slots
            pattern = pattern[begin:] + pattern[:begin]
        intervals_s = (
            self.seconds(steps * self._unit) for burst in path for steps in burst.intervals(self._between)
        )
        return Stability(
            radius.lower ** self._between[-1],
            radius.upper ** self._between[-1],
            tuple(pattern),
            tuple(intervals_s),
            radius.vertices,
            radius.needed_effort,
        )

    def coarse_bounds(self, guarantee: LossGuarantee | None = None) -> Stability:
        """Return coarser bounds, which decide whether all patterns are stable."""
        return self.stability(guarantee, _COARSE_ACCURACY)

    def first_bounds(self) -> Stability:
        """Return bounds that take less than a second; they may leave stability undecided."""
        return self.stability(accuracy=_QUICK_ACCURACY, decide=False)
