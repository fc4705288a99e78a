"""Received datagrams by source address, counted in bounded memory."""

from collections import Counter
from collections.abc import Iterable

from noack.runtime.address import Address, text_of

_REPORTED_SOURCES = 16
_KNOWN_SOURCES = 256


class SourceCount:
    """Counts datagrams by source address, cheaply while the source stays the same.

    Peers always have a count of their own; of the other sources only the most frequent have one.
    """

    def __init__(self, peers: Iterable[Address] = ()) -> None:
        self._peers = dict.fromkeys(peers, 0)
        self._others: Counter[Address] = Counter()
        self._more = 0
        self._last: Address | None = None
        self._run = 0

    def add(self, source: Address) -> None:
        """Count one datagram."""
        if source == self._last:
            self._run += 1
            return
        self._fold()
        self._last, self._run = source, 1

    def report(self) -> dict[str, int]:
        """Datagrams by source; the rare sources together are ``others``."""
        self._fold()
        self._forget(_REPORTED_SOURCES)
        named = [*self._peers.items(), *self._others.most_common()]
        found = {text_of(source): n for source, n in named if n}
        return found | ({"others": self._more} if self._more else {})

    def _fold(self) -> None:
        if self._last is None:
            return
        if self._last in self._peers:
            self._peers[self._last] += self._run
        else:
            self._others[self._last] += self._run
            if len(self._others) > _KNOWN_SOURCES:
                self._forget(_KNOWN_SOURCES // 2)
        self._last, self._run = None, 0

    def _forget(self, most: int) -> None:
        """Keep the ``most`` frequent sources: forged ones must not fill the memory."""
        kept = Counter(dict(self._others.most_common(most)))
        self._more += self._others.total() - kept.total()
        self._others = kept
