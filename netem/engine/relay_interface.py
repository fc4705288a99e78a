"""The interface of a relay: several links, each with two directions, and their reports.

A link listens on one address. Each client that sends to it gets a number, which is the number of
its flow in both directions, and a return path: its own socket towards the server, at which the
server's answers arrive.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from noack.impairments.link_settings import Counters, LinkSettings, RecordedDecision

Address = tuple[str, int]
"""Numeric host (IPv4 or IPv6) and port."""

Direction = Literal["forward", "reverse"]
DIRECTIONS: tuple[Direction, Direction] = ("forward", "reverse")
"""From client to server, and from server to client."""


@dataclass(frozen=True)
class LinkSpec:
    """One link of a relay."""

    name: str
    """Name of the link; part of the names of its random streams."""
    listen: Address
    """The address to which clients send; port 0 selects a free port."""
    to: Address
    """The server."""
    forward: LinkSettings
    reverse: LinkSettings
    seed: int = 0
    return_path: bool = True
    """False: forward only; all datagrams leave from one socket, and answers are discarded."""
    idle_s: float = 60.0
    """A client without a datagram in either direction for this time is removed."""
    most_clients: int = 65_536
    """Maximum number of clients; datagrams of further clients are refused and counted."""
    decisions: Mapping[Direction, Sequence[Sequence[RecordedDecision]]] = field(
        default_factory=dict
    )
    """Recorded decisions per flow; each flow repeats them before the settings apply."""


class FlowReport(NamedTuple):
    """One flow of a direction."""

    flow: int
    client: Address
    packets: int
    longest_loss_burst: int
    """Maximum number of consecutive datagrams that were not effectively delivered under the present
    settings."""


@dataclass(frozen=True)
class DirectionReport:
    """Counts of one direction of a link since the relay started."""

    settings: LinkSettings
    counters: Counters
    unintended: Mapping[str, int]
    """Unintended losses by cause: ``lost_in_kernel`` (the receive buffer overflowed), or the error
    message for datagrams that could not be sent or stored. Any of them voids the guarantee."""
    in_flight: int
    """Datagrams that are delayed now."""
    flows: Sequence[FlowReport]
    """At most 16: the present clients that sent most."""
    delays: NDArray[np.int64]
    """(k,) Histogram of the time from arrival to departure; see :mod:`netem.engine.histogram`."""
    lateness: NDArray[np.int64]
    """(k,) Histogram of the time from a delayed datagram's release time to its departure."""


@dataclass(frozen=True)
class LinkReport:
    """A link's two directions."""

    name: str
    listen: Address
    to: Address
    clients: int
    """Number of present clients."""
    clients_ever: int
    refused: int
    """Datagrams of clients beyond ``most_clients``."""
    discarded: int
    """Answers to a link without a reverse direction; 0 if the system does not count them."""
    port_unreachable: int
    """ICMP port-unreachable messages from the server's host; a lower bound on the datagrams lost
    there."""
    forward: DirectionReport
    reverse: DirectionReport


class Tap(Protocol):
    """Receives the events of a relay in batches, in the relay's thread; must return quickly."""

    wants_data: bool
    """Whether it needs payloads."""

    def take(self, events: NDArray[Any], data: NDArray[np.uint8]) -> None:
        """Receive events, (k,) of :data:`netem.relay_events.EVENT`, and their payloads.

        Both arrays are overwritten after the call.
        """
