"""The socket of a fleet of compiled code, which receives the peer's datagrams and sends itself."""

import os
import select
import socket
from collections.abc import Sequence

from noack.core.clock import RunClock
from noack.core.errors import PeerError
from noack.protocol.machine_interface import Notice, Record
from noack.protocol.wire_format import Flow, Message
from noack.runtime.address import Address
from noack.runtime.fleet.compiled_fleet import CompiledFleet
from noack.runtime.udp_sockets import CountingSocket, most_waiting

_READ_AT_ONCE = 4096
"""Datagrams read by Python in one turn; more would delay the fleet."""
_ALL = 10_000_000
FLEET_BUFFER_BYTES = 256 * 1024 * 1024
"""At 50,000 datagrams a second this covers a stall of 7 s. The kernel takes what is in use."""


class FleetSocket(CountingSocket[Message]):
    """The channel of a compiled fleet.

    It reads the datagrams of other sources every 50 ms, and passes on those that the peer sent
    before its socket was open.

    Raises:
        PeerError: the system refused a peer socket.
    """

    def __init__(
        self,
        endpoint: socket.socket,
        fleet: CompiledFleet,
        sends: Flow,
        *,
        clock: RunClock,
        source: Address,
        destination: Address,
    ) -> None:
        super().__init__(endpoint, destination, [source])
        if not self._beside:
            raise PeerError("the system refused to open a socket for the peer")
        self._fleet, self._sends, self._source = fleet, sends, source
        self._outputs: list[Record | Notice] = []
        self._passed_on = 0
        fleet.open(clock, endpoint, self._beside[0], destination)
        peer = self._beside[0].fileno()
        # A socket that was empty when already connected has the peer's datagrams only. In another
        # one, datagrams of other sources may be among those that wait now.
        self._to_read = {endpoint.fileno(): _ALL}
        """Most datagrams to read in the next turn, by file descriptor."""
        if peer not in self._source_of:
            waiting = most_waiting(self._beside[0])
            self._to_read[peer] = _ALL if waiting is None else waiting

    def judge(self, data: bytes, source: Address) -> Message | None:
        """Pass a datagram to the fleet, which rejects all but those of the peer."""
        self._outputs += self._fleet.take(data, from_peer=source == self._source)
        self._passed_on += 1
        return None

    def send(self, message: Message) -> None:
        """Send a message outside the fleet's batches, which it sends by itself."""
        self.put(self._fleet.encode(message), self._destination)

    def tend(self, now_ns: int) -> Sequence[Record | Notice]:
        """Begin the next interval of housekeeping; read datagrams of other sources."""
        notices = super().tend(now_ns)
        # At the start, all that came before the peer's socket: the fleet would reject it later.
        # From then on the fleet reads that socket: datagrams may come faster than Python reads.
        for readable, most in self._to_read.items():
            end = self._passed_on + most
            while self._passed_on < end and readable in self.watched:
                if not select.select([readable], (), (), 0)[0]:
                    break
                self.receive(readable)
        self._to_read = {self._endpoint.fileno(): _READ_AT_ONCE}
        outputs, self._outputs = [*notices, *self._outputs], []
        return outputs

    def report(self) -> dict[str, object]:
        """Counters, for the run's summary."""
        self._read_the_rest()
        fleet = self._fleet
        read = fleet.accepted + sum(fleet.rejected.values()) - self._passed_on
        self._sources.add(self._source, max(read, 0))
        return super().report() | {
            "sent": fleet.sent,
            "send_errors": {os.strerror(error): n for error, n in fleet.send_errors.items()},
            "sends": self._sends.name.lower(),
            "accepted": fleet.accepted,
            "rejected": self.rejected(fleet.rejected),
            "loops": fleet.reports(),
            "engine": "compiled",
        }
