"""What a relay reports: lines for the user, events, which taps receive, and counts of its links."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from noack.core.core_library import dtype_of
from noack.impairments.link_settings import Counters, LinkSettings
from noack.runtime.address import Address
from noack.runtime.command_line import print_to_stderr

Bytes = NDArray[np.uint8]
Events = NDArray[np.void]

EVENT = dtype_of("noack_event")
"""One event, with the fields of ``noack_event`` in native/noack.h; the payload is ``data[offset :
offset + size_bytes]``."""


Direction = Literal["forward", "reverse"]
DIRECTIONS: tuple[Direction, Direction] = ("forward", "reverse")
"""From client to server, and from server to client."""


def report_line(line: str) -> None:
    """Write a line; if standard error is closed, the emulator continues."""
    print_to_stderr(f"noack netem: {line}")


class FlowReport(NamedTuple):
    """One flow of a direction."""

    flow: int
    client: str
    """The client's address; in a shell: protocol and both ends."""
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
    """(k,) Histogram of the time from arrival to departure; see
    :mod:`netem.control.time_histogram`."""
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

    def take(self, events: Events, data: Bytes) -> None:
        """Receive events, (k,) of :data:`netem.relay.relay_reports.EVENT`, and their payloads.

        Both arrays are overwritten after the call.
        """
