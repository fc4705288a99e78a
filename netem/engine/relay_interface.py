"""What a relay is: several links, each with two directions, and what can be asked of it.

A link listens on one address. Each client that sends to it gets a number, which is its flow's in
both directions, and a return path: a socket of its own towards the server, through which the
server's answers come back.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from noack.impairments.link_records import Counters, RecordedDecision
from noack.impairments.link_settings import LinkSettings

Address = tuple[str, int]
"""Host as a number (IPv4 or IPv6) and port."""

Direction = Literal["forward", "reverse"]
DIRECTIONS: tuple[Direction, Direction] = ("forward", "reverse")
"""From client to server, and from server to client."""


@dataclass(frozen=True)
class LinkSpec:
    """One link of a relay."""

    name: str
    """Part of the names of its random streams."""
    listen: Address
    """Where clients send to; port 0 takes a free one."""
    to: Address
    """The server."""
    forward: LinkSettings
    reverse: LinkSettings
    seed: int = 0
    return_path: bool = True
    """False: one way only; all that survives leaves from one socket, and answers are discarded."""
    idle_s: float = 60.0
    """A client's return path is closed after so long without a datagram in either direction."""
    most_clients: int = 65_536
    """Datagrams of more clients than that are refused, and counted."""
    decisions: Mapping[Direction, Sequence[Sequence[RecordedDecision]]] = field(
        default_factory=dict
    )
    """Recorded decisions of each flow, taken again before the settings apply."""


@dataclass(frozen=True)
class FlowReport:
    """One flow of a direction."""

    flow: int
    client: Address
    packets: int
    longest_loss_burst: int
    """Most successive datagrams that were not effectively delivered, of those that came since the
    settings are in force."""


@dataclass(frozen=True)
class DirectionReport:
    """What has happened in one direction of a link since the relay began."""

    settings: LinkSettings
    counters: Counters
    unintended: Mapping[str, int]
    """Unintended losses: ``lost_in_kernel`` (the receive buffer overflowed), and by the system's
    message what could not be sent, or kept until then. Any breaks the guarantee."""
    in_flight: int
    """Datagrams that are delayed now."""
    flows: Sequence[FlowReport]
    """Of the clients that are there now: those that sent most, at most 16."""
    delays: NDArray[np.int64]
    """(k,) Histogram of the time from arrival to departure; see :mod:`netem.engine.histogram`."""
    lateness: NDArray[np.int64]
    """(k,) Histogram of the time from when a delayed datagram should have left until it did."""


@dataclass(frozen=True)
class LinkReport:
    """A link's two directions."""

    name: str
    listen: Address
    to: Address
    clients: int
    """Clients that are there now."""
    clients_ever: int
    refused: int
    """Datagrams of more clients than ``most_clients``."""
    discarded: int
    """Answers to a link that takes none; 0 if the system does not count them."""
    port_unreachable: int
    """How often ICMP said that nobody listens where the server should be; at least so often did a
    datagram come to nobody."""
    forward: DirectionReport
    reverse: DirectionReport


class Tap(Protocol):
    """Sees what a relay does, in batches, in the relay's thread; must not take long."""

    wants_data: bool
    """Whether it looks at payloads."""

    def take(self, events: NDArray[Any], data: NDArray[np.uint8]) -> None:
        """Take k events (:data:`netem.relay_events.EVENT`) and the payloads that they point into.

        Both are overwritten after the call.
        """
        ...

    def missing(self, events: int) -> None:
        """So many events were lost, as there was no room for them."""
        ...


class Relay(Protocol):
    """An engine with its links."""

    engine: str
    """``batched`` or ``plain``."""
    specs: Sequence[LinkSpec]
    began_unix_ns: int | None
    """Unix time at which it began to run; its times, those of blackouts too, count from there."""

    def addresses(self) -> Mapping[str, Address]:
        """Where each link listens."""
        ...

    def run(self, stop: Callable[[], bool], housekeeping: Callable[[], None]) -> None:
        """Relay until ``stop()``; both are called at least every 50 ms, in this thread."""
        ...

    def change(self, link: str, direction: Direction, settings: LinkSettings) -> None:
        """Change a direction's impairments between two datagrams.

        Flows go on: their numbers, their random streams' places, their counters. What is under way
        leaves when it was to leave.
        """
        ...

    def report(self) -> Sequence[LinkReport]:
        """What has happened so far."""
        ...

    def close(self) -> None:
        """Close all sockets."""
        ...
