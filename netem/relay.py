"""The relay: the network emulator's socket. Datagrams in, survivors out to one destination, unread.

Flows are numbered by source address, in the order of their first datagram. Survivors leave from the
port that they came in by.
"""

import socket

from netem.link import Datagram
from noack.io.address import Address
from noack.io.udp import MAX_UDP_BYTES, CountingSocket


class Relay(CountingSocket):
    """The channel of a link.

    Args:
        endpoint: a bound socket, from :func:`noack.io.udp.bind`.
        destination: where surviving datagrams go.
        source: the only address to serve; None serves everyone.
        duplex: what comes from the destination goes to the source, as flow 1.
    """

    def __init__(
        self,
        endpoint: socket.socket,
        destination: Address,
        source: Address | None = None,
        *,
        duplex: bool = False,
    ) -> None:
        super().__init__(endpoint, destination)
        self._source = source
        self._back: dict[int, Address] = {}
        self._flows: dict[Address, int] = {}
        if duplex and source is not None:
            self._back = {1: source}
            self._flows = {source: 0, destination: 1}
        self._foreign = 0

    def receive(self) -> Datagram | None:
        """Take one datagram; None if there was none, or one that is not served."""
        taken = self.take(MAX_UDP_BYTES)
        if taken is None:
            return None
        data, source = taken
        if self._source is not None and source != self._source and source not in self._flows:
            self._foreign += 1
            return None
        return Datagram(self._flows.setdefault(source, len(self._flows)), data)

    def send(self, message: Datagram) -> None:
        """Forward a datagram that survived."""
        self.put(message.data, self._back.get(message.flow))

    def report(self) -> dict[str, object]:
        """Counters, for the run's summary."""
        foreign = {"source": self._foreign} if self._foreign else {}
        return super().report() | {"rejected": foreign}
