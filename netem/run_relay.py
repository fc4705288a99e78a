"""The network emulator's socket in a run: forwards surviving datagrams without reading them.

It accepts datagrams from the sensor's address and, with a reverse direction, from the controller's.
Surviving datagrams leave from the port at which they arrived.
"""

import os
import select
import socket
from collections.abc import Sequence

from netem.engine.compiled_network import CompiledNetwork
from netem.link_machine import Datagram
from noack.core.clock import RunClock
from noack.core.errors import PeerError
from noack.protocol.machine_interface import Notice, Record
from noack.runtime.address import Address
from noack.runtime.udp_sockets import MAX_UDP_BYTES, CountingSocket


class RelayShell(CountingSocket[Datagram]):
    """The channel of a link: forwards from source to destination, as flow 0.

    If it is duplex, also from destination to source, as flow 1. Other senders are ignored.
    """

    most_bytes = MAX_UDP_BYTES
    engine = "plain"
    """See :attr:`netem.engine.relay_base.Relay.engine`."""

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
        rejected = self.rejected({"source": self._foreign})
        return super().report() | {"rejected": rejected, "engine": self.engine}


class CompiledShell(RelayShell):
    """The channel of a compiled network, which receives the peers' datagrams and sends itself.

    It reads the datagrams of other sources every 50 ms, and passes on those that the peers sent
    before their sockets were open.

    Raises:
        PeerError: the system refused a peer socket.
    """

    engine = "batched"

    def __init__(
        self,
        endpoint: socket.socket,
        destination: Address,
        source: Address,
        *,
        duplex: bool,
        network: CompiledNetwork,
        clock: RunClock,
        spin_us: float,
    ) -> None:
        super().__init__(endpoint, destination, source, duplex=duplex)
        if not self._beside:
            raise PeerError("the system refused to open a socket for each peer")
        self._network, self._passed_on = network, [0, 0]
        receivers = dict(zip(self._flows, self._beside, strict=True))
        network.open(clock, endpoint, receivers, destination, int(spin_us * 1000))
        self._to_read = [endpoint.fileno(), *(one.fileno() for one in self._beside)]

    def tend(self, now_ns: int) -> Sequence[Record | Notice]:
        """Begin the next interval of housekeeping; read datagrams of other sources."""
        outputs: list[Record | Notice] = [*super().tend(now_ns)]
        for readable in self._to_read:
            while readable in self.watched and select.select([readable], (), (), 0)[0]:
                message = self.receive(readable)
                if message is not None:
                    self._passed_on[message.flow] += 1
                    outputs += self._network.handle(message, max(now_ns, 0))
        del self._to_read[1:]  # from now on the network reads the peers' sockets
        return outputs

    def report(self) -> dict[str, object]:
        """Return the counters for the run's summary."""
        network = self._network
        for source, flow in self._flows.items():
            self._sources.add(source, network.received[flow] - self._passed_on[flow])
        self._sent, self._foreign = network.sent, self._foreign + network.refused
        self.send_errors.update(
            {str(OSError(one, os.strerror(one))): n for one, n in network.send_errors.items()}
        )
        return super().report()

    def close(self) -> None:
        """Close the sockets that it opened itself."""
        super().close()
        self._network.close()
