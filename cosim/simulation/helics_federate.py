"""A HELICS federate through which messages of a federation reach their endpoints, or get lost.

For an endpoint ``D`` the federate ``noack`` has the endpoint ``noack/D``. The channel of a
simulated run (:mod:`netem.channel`) decides about what is sent there, at the federation's time; it
reaches ``D`` when it leaves the channel. Filters of HELICS would need no other destination, but
federations with a filter can hang (HELICS #2524).
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, NamedTuple

from netem.channel import UPDATE_LINK, Channel, Departure, require_stand_alone
from netem.link_state import LinkState
from noack.core.clock import NEVER_NS, NS_PER_S
from noack.core.errors import CallerError, PeerError
from noack.protocol.record_tables import NETEM_PACKET, Fate
from noack.scenario.scenario import Scenario

if TYPE_CHECKING:
    from helics import HelicsEndpoint, HelicsMessageFederate

_LOST = (Fate.DROPPED, Fate.OVERFLOWED, Fate.BLACKED_OUT)


class FederateOptions(NamedTuple):
    """How a federate joins a federation; see the manual of HELICS."""

    name: str = "noack"
    core_type: str = "zmq"
    broker: str = ""
    """The broker's address; by default the one of this host, at HELICS' own port."""


class _QueuedMessage(NamedTuple):
    """A message in the channel."""

    data: bytes
    source: str
    copies: int


@dataclass
class Route:
    """What the network did with the messages to an endpoint."""

    destination: str
    sent: int = 0
    lost: int = 0
    longest_burst: int = 0
    waiting: dict[int, _QueuedMessage] = field(default_factory=dict)

    def to_json(self) -> dict[str, object]:
        """Return the counts."""
        counts = {"sent": self.sent, "lost": self.lost, "longest_burst": self.longest_burst}
        return {"endpoint": self.destination, **counts}

    def __str__(self) -> str:
        counts = f"{self.sent} messages, {self.lost} lost, longest loss burst {self.longest_burst}"
        return f"{self.destination}: {counts}"


def run(scenario: Scenario, endpoints: Sequence[str], options: FederateOptions) -> list[Route]:
    """Join a federation, and be its network until the other federates have ended.

    Args:
        scenario: its ``network`` without ``actuation`` is that of each endpoint; the losses are
            those of a run with as many loops.
        endpoints: names of the endpoints that the network leads to.
        options: how the federation is joined.

    Raises:
        CallerError: the network does not suit, an endpoint is not in the federation, or the package
            helics is missing.
        PeerError: the federation cannot be joined, or fails.
    """
    if not endpoints or len({*endpoints}) < len(endpoints):
        raise CallerError("--endpoint: give one or more endpoints, each once")
    settings = require_stand_alone(scenario).network.link
    link = LinkState(settings, scenario.seeds.loss, UPDATE_LINK, rows=len(endpoints))
    channel = Channel([link], loops=len(endpoints))
    with _join_federation(options) as (helics, federate):
        network = _Network(helics, federate, channel, options.name, endpoints)
        helics.helicsFederateEnterInitializingMode(federate)
        network.check()
        helics.helicsFederateEnterExecutingMode(federate)
        network.run()
    return network.routes


@contextmanager
def _join_federation(options: FederateOptions) -> "Iterator[tuple[ModuleType, HelicsMessageFederate]]":
    """Yield helics and a federate; afterwards it leaves the federation."""
    try:
        helics = import_module("helics")
    except ImportError:
        raise CallerError("helics is not installed; pip install 'noack[helics]'") from None
    federate = None
    try:
        info = helics.helicsCreateFederateInfo()
        helics.helicsFederateInfoSetCoreTypeFromString(info, options.core_type)
        helics.helicsFederateInfoSetCoreName(info, f"{options.name}_core")
        helics.helicsFederateInfoSetCoreInitString(info, "--federates=1 --loglevel=no_print")
        if options.broker:
            helics.helicsFederateInfoSetBroker(info, options.broker)
        federate = helics.helicsCreateMessageFederate(options.name, info)
        yield helics, federate
    except helics.HelicsException as error:
        raise PeerError(f"HELICS: {' '.join(str(error).split())}") from None
    finally:
        if federate is not None:
            helics.helicsFederateDisconnect(federate)
        helics.helicsCloseLibrary()


class _Network:
    """The federate's endpoints and their channel."""

    def __init__(
        self,
        helics: ModuleType,
        federate: "HelicsMessageFederate",
        channel: Channel,
        name: str,
        destinations: Sequence[str],
    ) -> None:
        self._helics, self._federate, self._channel = helics, federate, channel
        self.routes = [Route(destination) for destination in destinations]
        self._endpoints: list[HelicsEndpoint] = [
            helics.helicsFederateRegisterGlobalEndpoint(federate, f"{name}/{destination}", "")
            for destination in destinations
        ]

    def check(self) -> None:
        """Raise CallerError if the federation does not have an endpoint."""
        query = self._helics.helicsCreateQuery("root", "endpoints")
        known = self._helics.helicsQueryExecute(query, self._federate)
        for route in self.routes:
            if route.destination not in known:
                own = {f"{self._federate.name}/{endpoint.destination}" for endpoint in self.routes}
                existing = ", ".join(sorted({*known} - own)) or "none"
                raise CallerError(
                    f"--endpoint {route.destination}: the federation has no such endpoint; it has {existing}"
                )

    def run(self) -> None:
        """Take messages and let them leave, until the federation ends."""
        helics, end_s = self._helics, self._helics.HELICS_TIME_MAXTIME
        while True:
            due_ns = self._channel.due_ns
            wanted_s = end_s if due_ns == NEVER_NS else due_ns / NS_PER_S
            granted_s = helics.helicsFederateRequestTime(self._federate, wanted_s)
            if granted_s >= end_s:
                return
            for time_ns, flow, message in sorted(self._receive(), key=lambda received: received[:2]):
                self._take(time_ns, flow, message)
            self._send_departures(self._channel.release(round(granted_s * NS_PER_S)), granted_s)

    def _receive(self) -> Iterator[tuple[int, int, _QueuedMessage]]:
        """Yield the messages that have come: time in ns, number of the endpoint, content."""
        helics = self._helics
        for flow, endpoint in enumerate(self._endpoints):
            while helics.helicsEndpointHasMessage(endpoint):
                message = helics.helicsEndpointGetMessage(endpoint)
                content = _QueuedMessage(helics.helicsMessageGetBytes(message), message.original_source, 0)
                yield round(message.time * NS_PER_S), flow, content
        helics.helicsFederateClearMessages(self._federate)

    def _take(self, now_ns: int, flow: int, message: _QueuedMessage) -> None:
        """Let the channel decide about a message that was sent now."""
        route, channel = self.routes[flow], self._channel
        self._send_departures(channel.release(now_ns), now_ns / NS_PER_S)
        departures, copies = channel.send(flow, route.sent, len(message.data), now_ns)
        if copies:
            route.waiting[route.sent] = message._replace(copies=copies)
        route.sent += 1
        for table, rows in channel.take_rows():
            for row in rows if table == NETEM_PACKET else ():
                route.lost += row["fate"] in _LOST
                route.longest_burst = max(route.longest_burst, int(row["consecutive_losses"]))
        self._send_departures(departures, now_ns / NS_PER_S)

    def _send_departures(self, departures: Iterable[Departure], now_s: float) -> None:
        """Send what leaves the channel now."""
        helics = self._helics
        for flow, number, bit in departures:
            route, endpoint = self.routes[flow], self._endpoints[flow]
            queued = route.waiting.pop(number)
            if queued.copies > 1:
                route.waiting[number] = queued._replace(copies=queued.copies - 1)
            message = helics.helicsEndpointCreateMessage(endpoint)
            helics.helicsMessageSetData(message, _with_flipped(queued.data, bit))
            helics.helicsMessageSetDestination(message, route.destination)
            helics.helicsMessageSetOriginalSource(message, queued.source)
            helics.helicsMessageSetTime(message, now_s)
            helics.helicsEndpointSendMessage(endpoint, message)


def _with_flipped(data: bytes, bit: int) -> bytes:
    """Return data with a bit flipped; of −1 the data themselves."""
    if bit < 0:
        return data
    flipped = bytearray(data)
    flipped[bit // 8] ^= 1 << bit % 8
    return bytes(flipped)
