"""The losses that a loop tolerates whatever its sensor measures: stable for all patterns, or not.

The sensor is time-triggered, or transmits at unknown times with a longest time between two. A document
without motions says what may happen from one transmission to the next (:mod:`noack.proof.period_document`),
and every bound of the growth is one that the kernel has proven. Loops that transmit at unknown times while
updates are on their way, or expire, have no such document: there the search encloses the growth in balls
itself (:mod:`noack.proof.search.growth`, :mod:`noack.theory.witnesses.growth`), and no document shows it.
"""

import math
from collections.abc import Mapping, Sequence
from fractions import Fraction
from functools import cached_property
from types import MappingProxyType
from typing import NamedTuple

from netem.core.errors import CallerError
from netem.guarantee.loss_guarantee import LossGuarantee, outcome_letters
from noack.proof.elaborate.errors import RefusedError
from noack.proof.elaborate.scenario import read_linear_loop
from noack.proof.loop_document import NoDocumentError
from noack.proof.search.growth import PeriodicLoop
from noack.scenario.arrival_ties import LATENCY_NS
from noack.scenario.scenario import Scenario
from noack.theory.time_triggered.scenario_times import intervals, require_covered, require_usable_updates
from noack.theory.witnesses.growth import GrowthBounds, enclose_growth, intervals_of
from noack.theory.witnesses.period_loops import Entry, ProvenGrowth, period_loop, prove_growth

ACCURACY = 4e-3
"""Wanted upper/lower − 1 over the longest time between two transmissions."""
_MOST_STEPS, _MOST_SLOTS = 20_000, 64
"""Steps and ticks, and transmissions, after which the times of a loop repeat."""
_COARSE_ACCURACY, _QUICK_ACCURACY = 1e-2, 3e-2
"""Wanted upper/lower − 1 of :meth:`LossMargin.coarse_bounds` and :meth:`LossMargin.first_bounds`."""


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
    entries: Mapping[str, Entry] = MappingProxyType({})
    """Entries of a proof of both bounds, "most" and "least"; none where no document describes the loop."""
    late: int = 0
    """Inputs may act so many steps of the plant late."""

    @property
    def verdict(self) -> str:
        """The verdict in a word: stable, destabilised or undecided."""
        if self.upper < 1:
            return "stable"
        return "destabilised" if self.lower > 1 else "undecided"

    def refined(self, other: "Stability") -> "Stability":
        """Return the same with the other bounds where they are better; they have no entries of a proof."""
        found = self.with_upper_of(other).with_lower_of(other)
        changed = {"most": found.upper != self.upper, "least": found.lower != self.lower}
        kept = {key: entry for key, entry in self.entries.items() if not changed[key]}
        return found._replace(entries=kept)

    def with_upper_of(self, other: "Stability") -> "Stability":
        """Return the same, with the upper bound of a guarantee that allows all these patterns."""
        return self if other.upper >= self.upper else self._replace(upper=other.upper)

    def with_lower_of(self, other: "Stability") -> "Stability":
        """Return the same, with the lower bound of a guarantee whose patterns are among these."""
        if other.lower <= self.lower:
            return self
        return self._replace(lower=other.lower, pattern=other.pattern, intervals_s=other.intervals_s)

    def to_json(self) -> dict[str, object]:
        """Return what is known, for JSON."""
        known = self._asdict() | {"pattern": self.text, "verdict": self.verdict}
        del known["entries"]
        return known

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
        self.guarantee = resolved.network.guarantee
        between = intervals(resolved)
        self.shortest, self.longest = between[0], between[-1]
        """In measurements."""
        if longest is not None:
            is_regular = self.shortest == self.longest
            self.shortest = longest if is_regular else min(self.shortest, longest)
            self.longest = longest
        self._resolved = resolved
        self._unit = self.longest if self.shortest == self.longest else 1
        self._measurement = resolved.timing.measurement_period
        self.between = range(self.shortest // self._unit, self.longest // self._unit + 1)
        """Units between two transmissions: the period, or measurements."""
        self.period_loop = period_loop(resolved, self.between, self._unit)
        times = self.period_loop.times
        if times.slots > _MOST_SLOTS or math.lcm(times.step, times.tick) // min(times[:2]) > _MOST_STEPS:
            raise CallerError("the times of the loop repeat only after too many steps")
        # A controller that knows x(0) gets its first update after a period.
        knows_start = resolved.network.initial_sync == "known_state"
        # Where updates are on their way for several periods, the first one arrives so much later.
        self._first_slot = (int(knows_start) + times.behind) % times.slots

    @cached_property
    def bursts_loop(self) -> PeriodicLoop:
        """The loop as :mod:`noack.proof.search.growth` has it.

        Raises:
            CallerError: the loop is not covered.
        """
        require_usable_updates(self._resolved, self.period_loop.times)
        try:
            loop = read_linear_loop(self._resolved.content())
            matrices = loop.A, loop.B, loop.gain, loop.H
            return PeriodicLoop(matrices, self.period_loop.times, self.between, self.guarantee)
        except RefusedError as error:
            raise CallerError(str(error)) from None

    def seconds(self, measurements: int) -> float:
        """Return the time of a number of measurements."""
        return self._measurement.times(measurements).seconds

    @property
    def ties(self) -> str:
        """Which order of an update and a tick is not known, as a sentence; empty: there is none."""
        times = self.period_loop.times
        if not times.has_ties:
            return ""
        return (
            f"an update arrives within {LATENCY_NS / 1e6:g} ms of a tick of the controller: it may act at "
            "this tick or at the next one, and at each update both are covered"
        )

    @property
    def late(self) -> int:
        """Most steps of the plant by which an input may be late in what is proven."""
        return self.period_loop.covered_late

    @property
    def delay_ns(self) -> Fraction:
        """The delay of an update."""
        times = self.period_loop.times
        return Fraction(times.whole_delay, times.parts)

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
            effort: factor of the limit of the work for that.

        Raises:
            CallerError: the loop grows so much between deliveries that products overflow, or the
                guarantee allows too many patterns.
        """
        guarantee = guarantee or self.guarantee
        if guarantee.longest_burst is None:
            raise CallerError(f"{guarantee.meaning}: needs a maximum of losses")
        try:
            return self._proven(guarantee, accuracy, decide=decide, effort=effort)
        except RefusedError as error:
            raise CallerError(
                f"network: {guarantee.meaning}: {error}; reduce mansd, the windows of the constraints, "
                "or the number of measurements between two events"
            ) from None
        except OverflowError:
            raise CallerError(
                "the loop grows beyond 1e308 within some deliveries, or the units of its states and "
                "inputs are too different; reduce mansd or the period, or use other units"
            ) from None

    def _proven(self, guarantee: LossGuarantee, accuracy: float, *, decide: bool, effort: float) -> Stability:
        longest = self.between[-1]
        try:
            found = prove_growth(
                self.period_loop, guarantee, accuracy / longest, decide=decide, effort=effort
            )
        except NoDocumentError:
            loop = self.bursts_loop.under(guarantee)
            return self._of_bursts(loop, enclose_growth(loop, accuracy, decide=decide, effort=effort))
        stability = self._of_document(found)
        if len(self.between) == 1 or not decide or stability.verdict != "undecided":
            return stability
        loop = self.bursts_loop.under(guarantee)
        return stability.refined(
            self._of_bursts(loop, enclose_growth(loop, accuracy, decide=decide, effort=effort))
        )

    def _of_document(self, found: ProvenGrowth) -> Stability:
        longest = self.between[-1]
        outcomes = self._from_first([(slot, delivered, units) for delivered, slot, units in found.outcomes])
        return Stability(
            found.lower**longest,
            found.upper**longest,
            tuple(delivered for _, delivered, _ in outcomes),
            tuple(self.seconds(units * self._unit) for _, _, units in outcomes),
            {key: entry for key, entry in (("most", found.most), ("least", found.least)) if entry},
            self.late,
        )

    def _from_first(self, outcomes: Sequence[tuple[int, bool, int]]) -> list[tuple[int, bool, int]]:
        """Return the outcomes of a cycle from the slot of the first update on, with a delivery if possible.

        In another slot the pattern may grow less.
        """
        begins = [k for k, (slot, _, _) in enumerate(outcomes) if slot == self._first_slot]
        delivered = [k for k in begins if outcomes[k][1]]
        rotations = [[*outcomes[k:], *outcomes[:k]] for k in delivered or begins or [0]]
        return min(rotations, key=lambda path: [not is_delivered for _, is_delivered, _ in path])

    def _of_bursts(self, loop: PeriodicLoop, bounds: GrowthBounds) -> Stability:
        # In another slot than the first update's the pattern may grow less.
        path, slots = bounds.cycle, [burst.slot for burst in bounds.cycle]
        begin = slots.index(self._first_slot) if self._first_slot in slots else 0
        path = path[begin:] + path[:begin]
        pattern = [delivered for burst in path for delivered in (True, *[False] * burst.losses)]
        units = (steps for burst in path for steps in intervals_of(burst, loop.between))
        return Stability(
            bounds.lower,
            bounds.upper,
            tuple(pattern),
            tuple(self.seconds(steps * self._unit) for steps in units),
        )

    def coarse_bounds(self, guarantee: LossGuarantee | None = None) -> Stability:
        """Return coarser bounds, which decide whether all patterns are stable."""
        return self.stability(guarantee, _COARSE_ACCURACY)

    def first_bounds(self) -> Stability:
        """Return bounds that take less than a second; they may leave stability undecided."""
        return self.stability(accuracy=_QUICK_ACCURACY, decide=False)
