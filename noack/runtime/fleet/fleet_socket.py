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
from noack.runtime.udp_sockets import CountingSocket, enlarge_buffer

_READ_AT_ONCE = 512
"""Reads by Python in one turn; more would delay the fleet."""
_ALL = 10_000_000
FLEET_BUFFER_BYTES = 64 * 1024 * 1024
"""At 50,000 datagrams a second this covers a stall of a second."""


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
        self._passed_on, self._begun = 0, False
        enlarge_buffer(self._beside[0], FLEET_BUFFER_BYTES)
        fleet.open(clock, endpoint, self._beside[0], destination)
        peer = self._beside[0].fileno()
        # A socket that was empty when already connected has the peer's datagrams only.
        self._to_read = [endpoint.fileno(), *([] if peer in self._source_of else [peer])]

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
        for readable in self._to_read:
            # At the start, all that came before the peer's socket: the fleet would reject it later.
            for _ in range(_READ_AT_ONCE if self._begun else _ALL):
                if readable not in self.watched or not select.select([readable], (), (), 0)[0]:
                    break
                self.receive(readable)
        self._begun = True
        del self._to_read[1:]  # from now on the fleet reads the peer's socket
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
