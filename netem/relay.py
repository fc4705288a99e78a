"""The relay: the network emulator's socket. Datagrams in, survivors out to one destination, unread.

Flows are numbered by source address, in the order of their first datagram. Survivors leave from the
port that they came in by.
"""

import socket
from collections import Counter

from netem.link import Datagram
from noack.io.udp import MAX_UDP_BYTES, Address, SourceCount, kernel_drops, text_of


class Relay:
    """The channel of a link.

    Args:
        endpoint: a bound socket, from :func:`noack.io.udp.bind`. It stays unconnected: a connected
            one would fail a send for an earlier one's ICMP error, which is a loss beyond the cap.
        destination: where surviving datagrams go.
        source: the only address to serve; None serves everyone.
    """

    def __init__(
        self, endpoint: socket.socket, destination: Address, source: Address | None = None
    ) -> None:
        self._endpoint = endpoint
        self._destination = destination
        self._source = source
        self._flows: dict[Address, int] = {}
        self._foreign = 0
        self._sources = SourceCount()
        self.sent = 0
        self.send_errors: Counter[str] = Counter()

    def fileno(self) -> int:
        """File descriptor to wait on."""
        return self._endpoint.fileno()

    def receive(self) -> Datagram | None:
        """Take one datagram; None if there was none, or one that is not served."""
        try:
            data, source = self._endpoint.recvfrom(MAX_UDP_BYTES)
        except OSError:
            return None
        self._sources.add(source)
        if self._source is not None and source != self._source:
            self._foreign += 1
            return None
        return Datagram(self._flows.setdefault(source, len(self._flows)), data)

    def send(self, message: Datagram) -> None:
        """Forward a datagram that survived; a failure is counted."""
        try:
            self._endpoint.sendto(message.data, self._destination)
            self.sent += 1
        except OSError as error:
            self.send_errors[str(error)] += 1

    def report(self) -> dict[str, object]:
        """Counters, for the run's summary."""
        return {
            "local": text_of(self._endpoint.getsockname()),
            "destination": text_of(self._destination),
            "sent": self.sent,
            "send_errors": dict(self.send_errors),
            "received_from": self._sources.busiest(),
            "rejected": {"source": self._foreign} if self._foreign else {},
            "lost_in_kernel": kernel_drops(self._endpoint),
        }
