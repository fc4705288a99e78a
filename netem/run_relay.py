"""The network emulator's socket in a run: forwards surviving datagrams without reading them.

It accepts datagrams from the sensor's address and, with a second direction, from the controller's.
In a run of several loops, it reads the loop's number in the header, and no more. Surviving
datagrams leave from the port at which they arrived.
"""

import os
import select
import socket
from collections.abc import Sequence

from netem.channel import Datagram
from netem.engine.run_network import RunNetwork
from noack.core.clock import RunClock
from noack.core.errors import PeerError
from noack.protocol.machine_interface import Notice, Record
from noack.protocol.wire_format import loop_number
from noack.runtime.address import Address
from noack.runtime.udp_sockets import MAX_UDP_BYTES, CountingSocket


class RelayShell(CountingSocket[Datagram]):
    """The channel of a network: forwards each direction from its source to its destination.

    Other senders are ignored. The flow is that of :mod:`netem.channel`.

    Args:
        endpoint: the socket.
        ways: source and destination of each direction.
        loops: number of loops; None in a run of one loop without numbers.
    """

    most_bytes = MAX_UDP_BYTES
    engine = "python"
    """What waits for the datagrams: the core, or the process's own loop in Python."""

    def __init__(
        self,
        endpoint: socket.socket,
        ways: Sequence[tuple[Address, Address]],
        *,
        loops: int | None = None,
    ) -> None:
        self._directions = {source: number for number, (source, _) in enumerate(ways)}
        self._destinations = [destination for _, destination in ways]
        self._loops, self._reads_loop = loops or 1, loops is not None
        self._foreign = self._of_no_loop = 0
        super().__init__(endpoint, self._destinations[0], list(self._directions))

    def judge(self, data: bytes, source: Address) -> Datagram | None:
        """Return the datagram if it comes from an accepted address and is of a loop of the run."""
        direction = self._directions.get(source)
        if direction is None:
            self._foreign += 1
            return None
        loop = loop_number(data) if self._reads_loop else 0
        if loop is None or loop >= self._loops:
            self._of_no_loop += 1
            return None
        return Datagram(direction * self._loops + loop, data)

    def send(self, message: Datagram) -> None:
        """Forward a surviving datagram."""
        self.put(message.data, self._destinations[message.flow // self._loops])

    def report(self) -> dict[str, object]:
        """Return the counters for the run's summary."""
        rejected = self.rejected({"source": self._foreign, "loop": self._of_no_loop})
        return super().report() | {"rejected": rejected, "engine": self.engine}


class CoreShell(RelayShell):
    """The channel of a network in the core, which receives the peers' datagrams and sends itself.

    It reads the datagrams of other sources every 50 ms, and passes on those that the peers sent
    before their sockets were open.

    Raises:
        PeerError: the system refused a peer socket.
    """

    engine = "core"

    def __init__(
        self,
        endpoint: socket.socket,
        ways: Sequence[tuple[Address, Address]],
        *,
        network: RunNetwork,
        clock: RunClock,
        spin_us: float,
        loops: int | None = None,
    ) -> None:
        super().__init__(endpoint, ways, loops=loops)
        if not self._beside:
            raise PeerError("the system refused to open a socket for each peer")
        self._network, self._passed_on = network, [0, 0]
        receivers = dict(zip(self._directions, self._beside, strict=True))
        network.open(clock, endpoint, receivers, self._destinations, int(spin_us * 1000))
        self._to_read = [endpoint.fileno(), *(one.fileno() for one in self._beside)]

    def tend(self, now_ns: int) -> Sequence[Record | Notice]:
        """Begin the next interval of housekeeping; read datagrams of other sources."""
        outputs: list[Record | Notice] = [*super().tend(now_ns)]
        for readable in self._to_read:
            while readable in self.watched and select.select([readable], (), (), 0)[0]:
                message = self.receive(readable)
                if message is not None:
                    self._passed_on[message.flow // self._loops] += 1
                    outputs += self._network.handle(message, max(now_ns, 0))
        del self._to_read[1:]  # from now on the network reads the peers' sockets
        return outputs

    def report(self) -> dict[str, object]:
        """Return the counters for the run's summary."""
        network = self._network
        for source, direction in self._directions.items():
            received = network.received[direction] - self._passed_on[direction]
            self._sources.add(source, received)
        self._sent, self._foreign = network.sent, self._foreign + network.refused
        self._of_no_loop += network.of_no_loop
        self.send_errors.update(
            {str(OSError(one, os.strerror(one))): n for one, n in network.send_errors.items()}
        )
        return super().report()

    def close(self) -> None:
        """Close the sockets that it opened itself."""
        super().close()
        self._network.close()
