"""The relay: the network emulator's sockets. Datagrams in from anyone, out to one destination.

It reads no payload and serves any UDP program. Flows are numbered by source address, in the order
of their first datagram.
"""

import socket
from collections import Counter

from netem.link import Datagram
from noack.io.udp import MAX_UDP_BYTES, Address, text_of


class Relay:
    """The channel of a link.

    Args:
        endpoint: a bound socket, from :func:`noack.io.udp.bind`.
        destination: where surviving datagrams go.
    """

    def __init__(self, endpoint: socket.socket, destination: Address) -> None:
        self._in = endpoint
        self._out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._out.setblocking(False)
        self._out.connect(destination)
        self._destination = destination
        self._flows: dict[Address, int] = {}
        self.received_from: Counter[Address] = Counter()
        self.sent = 0
        self.send_errors: Counter[str] = Counter()

    def fileno(self) -> int:
        """File descriptor to wait on."""
        return self._in.fileno()

    def receive(self) -> Datagram | None:
        """Take one datagram; None if there was none."""
        try:
            data, source = self._in.recvfrom(MAX_UDP_BYTES)
        except OSError:
            return None
        self.received_from[source] += 1
        return Datagram(self._flows.setdefault(source, len(self._flows)), data)

    def send(self, message: Datagram) -> None:
        """Forward a datagram that survived; a failure is counted."""
        try:
            self._out.send(message.data)
            self.sent += 1
        except OSError as error:
            self.send_errors[error.strerror or str(error)] += 1

    def report(self) -> dict[str, object]:
        """Counters, for the run's summary."""
        return {
            "local": text_of(self._in.getsockname()),
            "forwards_from": text_of(self._out.getsockname()),
            "destination": text_of(self._destination),
            "sent": self.sent,
            "send_errors": dict(self.send_errors),
            "received_from": {text_of(peer): n for peer, n in self.received_from.items()},
        }

    def close(self) -> None:
        """Close the outgoing socket; the incoming one is its owner's."""
        self._out.close()
