"""The network of a scenario for programs that have a loop of their own, in virtual time.

It is the channel of a simulated run (:mod:`noack.machines.channel`): the core decides for each packet, by the
rules, random streams and guarantee of the emulator.
"""

from collections.abc import Iterable, Mapping
from os import PathLike
from typing import Generic, NamedTuple, TypeVar

from cosim.api.scenarios import Source, load
from cosim.shipped_files import find_shipped
from netem.core import toml_file
from netem.core.errors import CallerError
from netem.core.number_checks import one_of, whole_number
from netem.core.packet_rows import NETEM_PACKET
from netem.core.settings_section import LARGEST_SEED, ReadTable
from netem.link_state import LinkState
from noack.machines.channel import Channel, Departure
from noack.machines.run_channel import link_name, require_stand_alone
from noack.protocol.wire_format import Flow, datagram_bytes
from noack.scenario.scenario import Scenario

Content = TypeVar("Content")

_MOST_EPISODES, _MOST_ENTRIES, _LAST_NS = 2**31, 10**8, 2**62
"""Most episodes, most numbers of a packet, and the last time."""
_DIRECTIONS = {Flow.UPDATE: "update", Flow.ACTUATION: "actuation"}


class PacketArrival(NamedTuple, Generic[Content]):
    """A packet that has arrived, after no later one of its direction."""

    direction: str
    number: int
    """Of the packets of this direction, counted from 0."""
    content: Content


class VirtualNetwork(Generic[Content]):
    """A network that delays and drops packets, with its guarantee, in virtual time.

    Times are integer nanoseconds that never decrease. Losses are those of a run of noack with the
    same ``seeds.loss``, packet by packet. A packet that arrives after a later one of its direction
    is stale and left out; so is one that is damaged.

    >>> import noack
    >>> network = noack.VirtualNetwork({"mansd": 1, "loss": {"model": "bernoulli", "probability": 1.0}})
    >>> [[packet.content for packet in network.send("update", k, 1, k)] for k in range(4)]
    [[0], [], [2], []]
    >>> network.consecutive_losses("update")
    1

    Args:
        network: the table ``network`` of a scenario, ``{"mansd": ..., "loss": ...}``; or a
            scenario, its name or its file.
        seed: the seed of the losses; by default the scenario's ``seeds.loss``, else 0.
        episode: each has other losses of the same seed.

    Raises:
        NoackError: the network is wrong, or needs a whole run.
    """

    def __init__(self, network: Source | ReadTable, *, seed: int | None = None, episode: int = 0) -> None:
        scenario = require_stand_alone(_load_network(network))
        self.seed = scenario.seeds.loss if seed is None else whole_number("seed", seed, 0, LARGEST_SEED)
        """The seed of the losses."""
        flows = scenario.network.flows
        self.directions = tuple(_DIRECTIONS[flow] for flow in flows)
        """``("update",)``, or ``("update", "actuation")`` if actuations cross the network, too."""
        links = [LinkState(scenario.network.link_of(flow), self.seed, link_name(flow)) for flow in flows]
        episode = whole_number("episode", episode, 0, _MOST_EPISODES)
        self._channel = Channel(links)
        for direction, link in enumerate(links):
            link.start_flow(0, len(links) * episode + direction)
        self._sent, self._losses = [0] * len(links), [0] * len(links)
        self._now_ns = 0
        self._on_their_way: list[dict[int, Content]] = [{} for _ in links]

    def send(
        self, direction: str, content: Content, entries: int, now_ns: int
    ) -> list[PacketArrival[Content]]:
        """Send a packet; return what has arrived up to now, in order.

        Args:
            direction: one of ``directions``.
            content: what arrives with the packet.
            entries: how many numbers the packet has, for its size.
            now_ns: the time.

        Raises:
            NoackError: there is no such direction, the size is wrong, or time goes back.
        """
        flow, entries = self._flow(direction), whole_number("entries", entries, 0, _MOST_ENTRIES)
        now_ns = self._advanced_to(now_ns)
        number, self._sent[flow] = self._sent[flow], self._sent[flow] + 1
        self._on_their_way[flow][number] = content
        arrived = self.receive(now_ns)
        leaving, copies = self._channel.send(flow, number, datagram_bytes(entries), now_ns)
        if not copies:
            del self._on_their_way[flow][number]
        arrived += self._arrivals(leaving) + self.receive(now_ns)
        for table, rows in self._channel.take_rows():
            for row in rows if table == NETEM_PACKET else ():
                self._losses[flow] = int(row["consecutive_losses"])
        return arrived

    def receive(self, now_ns: int) -> list[PacketArrival[Content]]:
        """Return what has arrived up to now, in order; raise NoackError if time goes back."""
        return self._arrivals(self._channel.release(self._advanced_to(now_ns)))

    def consecutive_losses(self, direction: str) -> int:
        """Return how many of the packets that were sent last are lost."""
        return self._losses[self._flow(direction)]

    def _flow(self, direction: str) -> int:
        one_of("direction", direction, self.directions)
        return self.directions.index(direction)

    def _advanced_to(self, now_ns: int) -> int:
        """Return a time that is not before the last one."""
        self._now_ns = whole_number("now_ns", now_ns, self._now_ns, _LAST_NS)
        return self._now_ns

    def _arrivals(self, leaving: Iterable[Departure]) -> list[PacketArrival[Content]]:
        arrivals: list[PacketArrival[Content]] = []
        for packet in leaving:
            on_their_way = self._on_their_way[packet.flow]
            if packet.bit >= 0 or packet.number not in on_their_way:  # damaged, or stale
                continue
            arrivals.append(
                PacketArrival(self.directions[packet.flow], packet.number, on_their_way[packet.number])
            )
            for number in [number for number in on_their_way if number <= packet.number]:
                del on_their_way[number]
        return arrivals


def _load_network(network: Source | ReadTable) -> Scenario:
    if isinstance(network, Mapping):
        base = toml_file.read(find_shipped("double_integrator", "scenarios"), Scenario)
        try:
            return load({**base, "network": dict(network), "seeds": {}})
        except CallerError as error:
            lines = str(error).replace("scenario: ", "").splitlines()
            raise CallerError("; ".join(lines)) from None
    if not isinstance(network, Scenario | str | PathLike):
        raise CallerError(f"network: {network!r}; give a table as {{'mansd': 3, 'loss': ...}}, or a scenario")
    return load(network)
