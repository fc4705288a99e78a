"""The network emulator's sockets in a run: the core forwards surviving datagrams.

It accepts datagrams from the sensor's address and, with a second direction, from the controller's.
It reads the loop's number in the header, and no more. Surviving datagrams leave from the port at
which they arrived.
"""

import socket
from collections.abc import Sequence

from netem.channel import Datagram
from netem.engine.run_network import RunNetwork
from noack.core.clock import RunClock
from noack.protocol.wire_format import loop_number
from noack.runtime.address import Address, SocketName
from noack.runtime.real_time_loop import RecordSink
from noack.runtime.udp_sockets import MAX_UDP_BYTES, CountingSocket, errors_by_text


class NetworkChannel(CountingSocket):
    """The sockets of a network in the core, which receives the peers' datagrams and sends itself.

    Args:
        endpoint: the process's socket.
        ways: source and destination of each direction.
        network: the network; a datagram's flow is that of :mod:`netem.channel`.
        clock: the run's clock.
        spin_ns: busy-wait for this time before a departure.
        loops: number of loops.

    Raises:
        PeerError: the system refused a socket for a peer.
    """

    most_bytes = MAX_UDP_BYTES

    def __init__(
        self,
        endpoint: socket.socket,
        ways: Sequence[tuple[Address, Address]],
        *,
        network: RunNetwork,
        clock: RunClock,
        spin_ns: int = 0,
        loops: int = 1,
    ) -> None:
        self._directions = {source: number for number, (source, _) in enumerate(ways)}
        destinations = [destination for _, destination in ways]
        super().__init__(endpoint, destinations, list(self._directions))
        self._loops = loops
        self._foreign = self._of_no_loop = 0
        self._network, self._passed_on = network, [0, 0]
        receivers = dict(zip(self._directions, self.peer_sockets, strict=True))
        network.open(clock, self.senders[0], receivers, destinations, spin_ns)

    def take(self, data: bytes, source: SocketName, now_ns: int, sink: RecordSink) -> None:
        """Pass on a datagram that a peer sent before its socket was open; count others."""
        direction = self._directions.get(source[:2])
        loop = loop_number(data)
        if direction is None:
            self._foreign += 1
        elif loop is None or loop >= self._loops:
            self._of_no_loop += 1
        else:
            self._passed_on[direction] += 1
            message = Datagram(direction * self._loops + loop, data)
            for record in self._network.handle(message, max(now_ns, 0)):
                sink.append(record)

    def report(self) -> dict[str, object]:
        """Return the counters for the run's summary."""
        network = self._network
        for source, direction in self._directions.items():
            received = network.received[direction] - self._passed_on[direction]
            self.count_received(source, received)
        rejected = {
            "source": self._foreign + network.refused, "loop": self._of_no_loop + network.of_no_loop
        }  # fmt: skip
        return super().report() | {
            "sent": network.sent,
            "send_errors": errors_by_text(network.send_errors),
            "rejected": self.rejected(rejected),
        }

    def close(self) -> None:
        """Close the sockets that it opened itself."""
        super().close()
        self._network.close()
