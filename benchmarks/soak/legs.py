"""Checks of consecutive numbers, and of datagrams without loss, in bounded memory."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.int64]

MOST_WAITING = 200_000
"""Maximum number of waiting numbers; more are a fault, and are discarded."""


class InTurn:
    """Numbers 0, 1, 2, … that arrive from several sources, batch by batch."""

    def __init__(self, what: str) -> None:
        self._what = what
        self.next = 0
        """All numbers before it have arrived."""
        self._ahead: Numbers = np.zeros(0, np.int64)

    @property
    def waiting(self) -> int:
        """Number of numbers with predecessors that have not arrived yet."""
        return len(self._ahead)

    def take(self, numbers: Numbers) -> Iterator[str]:
        """Process a batch; yield the faults."""
        ahead = np.sort(np.concatenate([self._ahead, numbers]))
        if len(ahead) and ahead[0] < self.next:
            yield f"{self._what} {ahead[0]} came twice"
            ahead = ahead[ahead >= self.next]
        in_turn = ahead == self.next + np.arange(len(ahead))
        ready = len(ahead) if in_turn.all() else int(np.argmin(in_turn))
        self.next += ready
        self._ahead = ahead[ready:]
        if self.waiting > MOST_WAITING:
            yield from self.end()

    def end(self) -> Iterator[str]:
        """Yield the numbers that never arrived."""
        if self.waiting:
            yield f"{self._what} {self.next} never came, but {self._ahead[0]} and others did"
            self.next, self._ahead = int(self._ahead[-1]) + 1, np.zeros(0, np.int64)


class Leg:
    """A path without losses: the sent datagrams arrive, in order, each once.

    Args:
        what: name of the path.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._sent: Numbers = np.zeros(0, np.int64)
        self._arrived: Numbers = np.zeros(0, np.int64)

    @property
    def waiting(self) -> int:
        """Number of datagrams known from one end only."""
        return len(self._sent) + len(self._arrived)

    def sent(self, numbers: Numbers) -> None:
        """Add sent datagrams."""
        self._sent = np.concatenate([self._sent, numbers])

    def arrived(self, numbers: Numbers) -> None:
        """Add arrived datagrams."""
        self._arrived = np.concatenate([self._arrived, numbers])

    def judge(self) -> Iterator[str]:
        """Compare the datagrams known from both ends; yield the faults."""
        while both := min(len(self._sent), len(self._arrived)):
            differ = np.flatnonzero(self._sent[:both] != self._arrived[:both])
            same = int(differ[0]) if len(differ) else both
            self._sent, self._arrived = self._sent[same:], self._arrived[same:]
            if len(differ):
                sent, arrived = int(self._sent[0]), int(self._arrived[0])
                if arrived > sent:
                    yield f"{self._what} {sent} was lost"
                    self._sent = self._sent[1:]
                else:
                    yield f"{self._what} {arrived} came twice, or out of turn, or was not sent"
                    self._arrived = self._arrived[1:]
        if self.waiting > MOST_WAITING:
            yield f"{self._what}: {self.waiting} numbers wait for the other end"
            self._sent, self._arrived = self._sent[:0], self._arrived[:0]

    def end(self, in_flight: int) -> Iterator[str]:
        """Yield the datagrams that never arrived; the last ``in_flight`` ones may be in flight."""
        yield from self.judge()
        if len(self._sent) > in_flight:
            yield f"{self._what} {self._sent[0]} and {len(self._sent) - 1} more never came"
        if len(self._arrived):
            yield f"{self._what} {self._arrived[0]} came, but was not sent"
