"""Where a loop is whose rule is tested at known times: its tests are T apart, exactly.

With a dwell time the first test after an event comes D after it instead. Nothing but tests has events, so
the ages of all updates on their way are known at each test. A *place* is what is known right after one:
how many updates are lost, or the ages of those that are on their way. In a place a clock shows the time
since that test. A *move* leads from one place to another one.

Silent tests since the last event may be counted, up to a number. So V may depend on how long x_s has rested.
"""

from collections.abc import Iterator
from typing import NamedTuple

from flint import fmpq

from noack.proof.elaborate.loop import Times

MOST_PLACES = 160
_CLOSE = 1000
"""Nodes of a clock are at least such a share of its length apart."""


class PlaceAtTest(NamedTuple):
    """What is known right after a test."""

    lost: int
    """So many updates are lost, and none is on its way; 0 if some are."""
    ages: tuple[fmpq, ...]
    """Of the update that is the next to act, and of all events after its own.

    Before the first input the first age is the time since the start, instead.
    """
    has_input: bool = True
    """Whether the first input has acted."""
    dwells: bool = False
    """Whether the test was an event, after which the rule does not count for a time."""
    silent: int = 0
    """So many tests since the last event were silent, up to those that are counted."""

    @property
    def later(self) -> int:
        """The number of events after that of the update that is the next to act."""
        return max(len(self.ages) - 1, 0)


class Move(NamedTuple):
    """A way from a place to another one."""

    source: PlaceAtTest
    target: PlaceAtTest
    kind: str
    """"silent", "lost", "sent", "delivered", "later", "first" or "arrival".

    "later" is an event while another update is on its way, "first" one whose update gives the first input.
    """

    @property
    def is_event(self) -> bool:
        """Whether it is a test that is an event."""
        return self.kind not in {"silent", "arrival"}


class Places:
    """All places of a loop, and the moves between them.

    Args:
        losses: most consecutive losses.
        times: of the loop.
        later: most events within the delay after an event.
        later_at_start: most events after the one at t = 0 before the first input acts.
        counted: most silent tests since an event that are counted.

    Raises:
        ValueError: there are too many.
    """

    def __init__(self, losses: int, times: Times, later: int, later_at_start: int, counted: int = 0) -> None:
        self._losses, self._times, self._later, self._later_at_start = losses, times, later, later_at_start
        self._counted = counted
        self._has_dwell = times.dwell > times.sampling
        dwells, zero = self._has_dwell, fmpq(0)
        self.start = (
            PlaceAtTest(0, (zero,), False, dwells) if times.start > 0 else PlaceAtTest(0, (), True, dwells)
        )
        first = PlaceAtTest(0, ())
        self.places, self.moves = [first] if self.start == first else [first, self.start], list[Move]()
        for place in self.places:  # which grows
            for move in (*self._arrivals(place), *self._tests(place)):
                self.moves.append(move)
                if move.target not in self.places:
                    self.places.append(move.target)
            if len(self.places) > MOST_PLACES:
                raise ValueError(f"more than {MOST_PLACES} ways in which updates may be on their way")

    def clock_end(self, place: PlaceAtTest) -> fmpq:
        """Return the time until the next test."""
        return self._times.dwell if place.dwells else self._times.sampling

    def clock_limit(self, place: PlaceAtTest) -> fmpq:
        """Return the time until the next test, or until the next update has surely acted."""
        limit, end = self._limit(place), self.clock_end(place)
        return end if limit is None else min(end, limit - place.ages[0])

    def _limit(self, place: PlaceAtTest) -> fmpq | None:
        """Return the age up to which the update acts that is the next one; None: none is on its way."""
        if not place.ages:
            return None
        return self._times.delay if place.has_input else self._times.start

    def nodes(self, place: PlaceAtTest, pieces: int) -> list[fmpq]:
        """Return nodes of a place's clock, up to the first one at which an update has surely acted.

        A piece is at most the longest clock over ``pieces``. Of two ends that are close to each other one
        is left out.
        """
        end, zero = self.clock_end(place), fmpq(0)
        others = [each for each in self.places if each.dwells == place.dwells]
        limits = {limit - each.ages[0] for each in others if (limit := self._limit(each)) is not None}
        marks = [zero]
        for limit_s in sorted(limits):
            if min(limit_s - marks[-1], end - limit_s) > end / _CLOSE:
                marks.append(limit_s)
        longest, found = max(self._times.dwell, self._times.sampling), [zero]
        for begin, mark in zip(marks, [*marks[1:], end], strict=True):
            count = max(int(((mark - begin) * pieces / longest).ceil()), 1)
            found += [begin + (mark - begin) * k / count for k in range(1, count + 1)]
        limit = self._limit(place)
        if limit is None:
            return found
        return found[: sum(node < limit - place.ages[0] for node in found[:-1]) + 1]

    def _tests(self, place: PlaceAtTest) -> Iterator[Move]:
        limit, end = self._limit(place), self.clock_end(place)
        if limit is not None and place.ages[0] + end >= limit:
            return  # the update acts before the next test
        ages, zero = tuple(age + end for age in place.ages), fmpq(0)
        silent = min(place.silent + 1, self._counted)
        yield Move(place, place._replace(ages=ages, dwells=False, silent=silent), "silent")
        after = place._replace(ages=ages, dwells=self._has_dwell, silent=0)
        if limit is None:
            if place.lost < self._losses:
                yield Move(place, after._replace(lost=place.lost + 1), "lost")
            if self._times.delay > 0:
                yield Move(place, after._replace(lost=0, ages=(zero,)), "sent")
            else:
                yield Move(place, after._replace(lost=0), "delivered")
            return
        if place.later < (self._later if place.has_input else self._later_at_start):
            yield Move(place, after._replace(ages=(*ages, zero)), "later")
        if not place.has_input and self._later_at_start:
            yield Move(place, after._replace(ages=ages[:1]), "first")

    def _arrivals(self, place: PlaceAtTest) -> Iterator[Move]:
        """Yield what may follow when an update acts: another one is the next, or all others are lost."""
        if not place.ages:
            return
        acted = place._replace(has_input=True)
        if place.later <= self._losses:
            yield Move(place, acted._replace(lost=place.later, ages=()), "arrival")
        for first in range(1, len(place.ages)):
            if place.ages[first] < self._times.delay:
                yield Move(place, acted._replace(ages=place.ages[first:]), "arrival")
