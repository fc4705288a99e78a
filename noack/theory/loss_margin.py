"""The losses that a time-triggered loop tolerates: all patterns of a guarantee are stable or not.

A pattern of losses is a path of the guarantee's automaton. Its states just after deliveries are the
nodes of a switched system (:mod:`noack.theory.switched_system`); k losses and the delivery after
them are an edge that lasts k + 1 periods, with the loop's map over that time as its matrix
(:mod:`noack.theory.time_triggered_loop`).
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from noack.config.resolution import loop_of
from noack.config.scenario import Scenario
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.impairments.kinds.delay import Delay
from noack.impairments.loss_guarantee import LongestBurst, LossAutomaton, LossGuarantee
from noack.theory.joint_spectral_radius import ACCURACY, JointSpectralRadius, joint_spectral_radius
from noack.theory.switched_system import Edge
from noack.theory.time_triggered_loop import LoopTimes, TimeTriggeredLoop
from noack.trigger.periodic_trigger import PeriodicSettings

MOST_EDGES = 5000
_TIMELESS = ("loss", "corrupt", "blackout", "duplicate")
_FIRST_ACCURACY = 1e-2
_QUICK_ACCURACY = 3e-2
_LAST_ACCURACY = 1e-8


class Stability(NamedTuple):
    """What is known about all loss patterns of a guarantee."""

    lower: float
    """The pattern grows at least by this factor per period in the long run."""
    upper: float
    """No pattern grows by more than this factor per period in the long run."""
    pattern: tuple[bool, ...]
    """Whether each update is delivered, in a pattern that repeats; it begins with a delivery."""
    vertices: int
    """Number of vertices of the polytopes that prove the upper bound."""

    @property
    def verdict(self) -> str:
        """The verdict in a word: stable, destabilised or undecided."""
        if self.upper < 1:
            return "stable"
        return "destabilised" if self.lower > 1 else "undecided"

    @property
    def text(self) -> str:
        """The pattern, one letter per update: ``D`` delivered, ``L`` lost."""
        return " ".join("D" if delivered else "L" for delivered in self.pattern)


def capped(guarantee: LossGuarantee, losses: int) -> LossGuarantee:
    """Return a guarantee with another maximum number of consecutive losses."""
    others = [rule for rule in guarantee.rules if not isinstance(rule, LongestBurst)]
    return LossGuarantee((LongestBurst(losses), *others))


class Burst(NamedTuple):
    """Losses between two deliveries, as an edge of the guarantee's graph."""

    source: int
    target: int
    slot: int
    """Number of the first delivered update, modulo the number of slots."""
    losses: int


def bursts_of(guarantee: LossGuarantee, slots: int = 1) -> list[Burst]:
    """Return the graph of a guarantee between deliveries; node 0 is that of the first delivery.

    Raises:
        CallerError: there are more than 5,000 edges.
    """
    automaton = LossAutomaton(guarantee)
    found: list[Burst] = []
    first = int(automaton.after_delivery(np.zeros(1, int))[0])
    numbers, pending = {(first, 0): 0}, [(first, 0)]
    while pending:
        state, slot = pending.pop()
        source, losses = numbers[state, slot], 0
        while state >= 0:
            if len(found) == MOST_EDGES:
                raise CallerError(
                    f"network: {guarantee.meaning}: more than {MOST_EDGES:,} transitions; "
                    "reduce mansd or the windows of the constraints"
                )
            after = int(automaton.after_delivery(np.array([state]))[0])
            target = (after, (slot + losses + 1) % slots)
            if target not in numbers:
                numbers[target] = len(numbers)
                pending.append(target)
            found.append(Burst(source, numbers[target], slot, losses))
            state, losses = int(automaton.after_loss(np.array([state]))[0]), losses + 1
    return found


class LossMargin:
    """The time-triggered loop of a scenario, with its own or another period.

    Args:
        resolved: the resolved scenario.
        period_ns: time between two transmissions, a multiple of the time between measurements; by
            default the scenario's.

    Raises:
        CallerError: the loop is not covered; the message names the setting.
    """

    def __init__(self, resolved: Scenario, period_ns: int | None = None) -> None:
        require_covered(resolved)
        loop, timing = loop_of(resolved), resolved.timing
        self.guarantee = resolved.network.guarantee
        self.period_ns = period_ns or transmission_period_ns(resolved)
        times = LoopTimes(
            timing.plant_period_ns,
            timing.controller_period_ns,
            timing.controller_phase_ns,
            self.period_ns,
            update_delay_ns(resolved),
        )
        if times.delay_ns >= self.period_ns:
            raise CallerError(
                f"network.impairments: a delay of {times.delay_ns / NS_PER_S:g} s; expected less "
                f"than the period between two updates, {self.period_ns / NS_PER_S:g} s"
            )
        self.loop = TimeTriggeredLoop(loop.A, loop.B, loop.K, loop.H, times)
        self._maps = cache(self.loop.map)

    def stability(
        self,
        guarantee: LossGuarantee | None = None,
        accuracy: float = ACCURACY,
        *,
        refine: bool = True,
    ) -> Stability:
        """Bound the growth of all patterns of a guarantee, by default the scenario's.

        Args:
            guarantee: the guarantee.
            accuracy: wanted upper/lower − 1.
            refine: whether the accuracy is refined if the bounds are on both sides of 1.
        """
        bursts = bursts_of(guarantee or self.guarantee, self.loop.times.slots)
        try:
            edges = [
                Edge(one.source, one.target, self._maps(one.slot, one.losses), one.losses + 1)
                for one in bursts
            ]
        except OverflowError:
            raise CallerError(
                "the loop between two deliveries exceeds 1e308; reduce mansd or the period"
            ) from None
        while True:
            found = joint_spectral_radius(edges, accuracy=accuracy)
            decided = not found.lower <= 1 <= found.upper
            if decided or not refine or accuracy < _LAST_ACCURACY:
                return _stability(found, bursts)
            accuracy = min(accuracy / 10, (1 - found.lower) / 2)

    def is_stable(self, guarantee: LossGuarantee | None = None) -> Stability:
        """Return coarser bounds, which decide whether all patterns are stable."""
        return self.stability(guarantee, _FIRST_ACCURACY)

    def first_bounds(self) -> Stability:
        """Return bounds that take less than a second; they may leave stability undecided."""
        return self.stability(accuracy=_QUICK_ACCURACY, refine=False)


def _stability(found: JointSpectralRadius, bursts: list[Burst]) -> Stability:
    pattern = [one for edge in found.cycle for one in (*[False] * bursts[edge].losses, True)]
    # The last update of an edge is delivered, and so is the one before the first edge.
    return Stability(found.lower, found.upper, (*pattern[-1:], *pattern[:-1]), found.vertices)


def require_covered(resolved: Scenario) -> None:
    """Raise CallerError unless the loop is linear, time-triggered, and the watchdog idle."""
    resolved.coverage.require_exact()
    resolved.coverage.require_unchanging()
    if not isinstance(resolved.trigger, PeriodicSettings):
        raise CallerError(
            f'trigger.policy = "{resolved.trigger.policy}": the margin is that of a '
            "time-triggered loop; use e.g. --set 'trigger={policy=\"periodic\", period_s=0.5}'"
        )
    timing = resolved.timing
    if timing.plant_period_ns + timing.controller_period_ns > timing.actuation_timeout_ns:
        raise CallerError(
            "plant.watchdog.timeout_s: shorter than the age of the actuations without any delay"
        )


def transmission_period_ns(resolved: Scenario) -> int:
    """Return the time between two updates: whole measurement periods, at least ``period_s``."""
    trigger, step_ns = resolved.trigger, resolved.timing.measurement_period_ns
    assert isinstance(trigger, PeriodicSettings)
    return -(-round(trigger.period_s * NS_PER_S) // step_ns) * step_ns


def update_delay_ns(resolved: Scenario) -> int:
    """Return the constant delay of the updates; raise CallerError if it may vary."""
    delay_ns = 0
    for number, one in enumerate(resolved.network.impairments):
        constant = isinstance(one, Delay) and not (one.jitter_s or one.samples_s or one.file)
        if isinstance(one, Delay) and constant:
            delay_ns += round(one.delay_s * NS_PER_S)
        elif one.kind not in _TIMELESS:
            raise CallerError(
                f"network.impairments.{number}: {one.kind}: the margin is for a constant delay; "
                "use delay_s alone"
            )
    return delay_ns
