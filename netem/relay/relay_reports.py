"""What a relay reports: lines for the user, and counts of its links.

The core counts times in histograms (``native/relay/record.c``).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from netem.core.address import Address
from netem.core.command_line import netem_program, print_to_stderr
from netem.impairments.link_settings import Counters, LinkSettings

Bytes = NDArray[np.uint8]
Direction = Literal["forward", "reverse"]
DIRECTIONS: tuple[Direction, Direction] = ("forward", "reverse")
"""From client to server, and from server to client."""

_STEP_BITS = 5
_STEPS = 1 << _STEP_BITS
"""Buckets for each doubling of the time; times below this number of ns have a bucket each."""
_JOINED = 8
"""Buckets that are one bucket of a coarse histogram."""


def report_line(line: str) -> None:
    """Write a line; if standard error is closed, the emulator continues."""
    print_to_stderr(f"{netem_program()}: {line}")


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
    """(k,) Histogram of the time from arrival to departure: counts by :func:`bucket_start_ns`."""
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


def bucket_start_ns(bucket: int) -> int:
    """Return the shortest time of a bucket."""
    if bucket < _STEPS:
        return bucket
    shift = (bucket >> _STEP_BITS) - 1
    return (_STEPS + (bucket & (_STEPS - 1))) << shift


def coarse_histogram(counts: NDArray[np.int64]) -> list[list[int]]:
    """Return a coarser histogram for people and plots: four buckets for each doubling.

    Each entry is the shortest time in ns and the count of a bucket that is not empty.
    """
    joined = counts.reshape(-1, _JOINED).sum(axis=1)
    return [[bucket_start_ns(_JOINED * k), int(joined[k])] for k in np.flatnonzero(joined).tolist()]


def quantile_ns(counts: Sequence[int] | NDArray[np.int64], share: float) -> float:
    """Return the quantile at ``share`` in ns, accurate to 3 %; nan if the histogram is empty."""
    reached = np.cumsum(counts)
    if reached[-1] == 0:
        return float("nan")
    bucket = int(np.searchsorted(reached, max(share * reached[-1], 1)))
    return (bucket_start_ns(bucket) + bucket_start_ns(bucket + 1) - 1) / 2
