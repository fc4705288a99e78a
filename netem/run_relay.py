"""The network emulator's socket in a run: forwards surviving datagrams without reading them.

It accepts datagrams from the sensor's address and, with a reverse direction, from the controller's.
Surviving datagrams leave from the port at which they arrived.
"""

import socket

from netem.link_machine import Datagram
from noack.runtime.address import Address
from noack.runtime.udp_sockets import MAX_UDP_BYTES, CountingSocket


class RelayShell(CountingSocket[Datagram]):
    """The channel of a link: forwards from source to destination, as flow 0.

    If it is duplex, also from destination to source, as flow 1. Other senders are ignored.
    """

    most_bytes = MAX_UDP_BYTES

    def __init__(
        self, endpoint: socket.socket, destination: Address, source: Address, *, duplex: bool
    ) -> None:
        self._flows = {source: 0, destination: 1} if duplex else {source: 0}
        self._back = {1: source} if duplex else {}
        self._foreign = 0
        super().__init__(endpoint, destination, list(self._flows))

    def judge(self, data: bytes, source: Address) -> Datagram | None:
        """Return the datagram if it comes from an accepted address; its content is not checked."""
        flow = self._flows.get(source)
        if flow is None:
            self._foreign += 1
            return None
        return Datagram(flow, data)

    def send(self, message: Datagram) -> None:
        """Forward a surviving datagram."""
        self.put(message.data, self._back.get(message.flow))

    def report(self) -> dict[str, object]:
        """Return the counters for the run's summary."""
        return super().report() | {"rejected": self.rejected({"source": self._foreign})}
