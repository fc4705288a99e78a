"""A timetable: settings that directions of links get at given times since the relay's start."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from netem.impairments.link_settings import LinkSettings
from netem.relay.relay_reports import Direction

NEVER_NS = 2**63 - 1
"""The time of the next change, if there is none."""


class TimedChange(NamedTuple):
    """Settings that a direction of a link gets at a time."""

    at_ns: int
    link: str
    direction: Direction
    settings: LinkSettings


@dataclass(frozen=True)
class Timetable:
    """Changes in the order of their times."""

    changes: Sequence[TimedChange] = ()
    repeat_ns: int | None = None
    """The changes repeat after this time, which is later than the last; None: they do not."""


class TimetableProgress:
    """Which changes of a timetable have been taken."""

    def __init__(self, timetable: Timetable) -> None:
        self._changes, self._repeat_ns = timetable.changes, timetable.repeat_ns
        self._next = 0
        self._round_ns = 0
        """Begin of the present round."""

    @property
    def next_ns(self) -> int:
        """Time of the next change; :data:`NEVER_NS`: there is none."""
        if self._next == len(self._changes):
            return NEVER_NS
        return self._round_ns + self._changes[self._next].at_ns

    def take(self, now_ns: int) -> Iterator[TimedChange]:
        """Yield the changes that are due, in their order.

        Of rounds that have passed completely, the last one is enough: it sets all settings again.
        """
        if self._repeat_ns is not None:
            self._round_ns += max((now_ns - self.next_ns) // self._repeat_ns - 1, 0) * self._repeat_ns
        while self.next_ns <= now_ns:
            change = self._changes[self._next]
            self._next += 1
            if self._next == len(self._changes) and self._repeat_ns is not None:
                self._next = 0
                self._round_ns += self._repeat_ns
            yield change
