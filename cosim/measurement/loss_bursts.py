"""Effective losses of a packet trace, and the bursts of consecutive ones.

A packet is effective (``docs/mansd.md``) if it is received within the deadline, before every later
packet. A receiver that uses only the newest data misses all others.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from noack.traces.packet_trace import LOST_NS, Int64s, PacketTrace

Flags = NDArray[np.bool_]
_NEVER_NS = np.iinfo(np.int64).max


@dataclass(frozen=True, eq=False)
class Outcomes:
    """What became of the k packets of a trace: each is in one of four groups."""

    lost: Flags
    """(k,) Never received."""
    out_of_order: Flags
    """(k,) Received after a later packet."""
    late: Flags
    """(k,) Received in order, but after the deadline."""
    newer_ns: Int64s
    """(k,) When the first later packet was received; the greatest integer if none was."""

    @property
    def effective(self) -> Flags:
        """(k,) Received in order, within the deadline."""
        return ~(self.lost | self.out_of_order | self.late)


def outcomes(trace: PacketTrace, deadline_ns: int | None = None) -> Outcomes:
    """Return what became of each packet.

    Of packets that are received at the same time, the one with the lower number is the first. If
    one is received within the deadline, a later packet that arrives before it is, too: whether late
    packets make others stale makes no difference.
    """
    lost = trace.received_ns == LOST_NS
    received_ns = np.where(lost, _NEVER_NS, trace.received_ns)
    newer_ns = np.append(np.minimum.accumulate(received_ns[::-1])[::-1][1:], _NEVER_NS)
    out_of_order = ~lost & (received_ns > newer_ns)
    late = np.zeros(len(lost), bool)
    if deadline_ns is not None:
        late = ~lost & ~out_of_order & (trace.received_ns - trace.sent_ns > deadline_ns)
    return Outcomes(lost, out_of_order, late, newer_ns)


@dataclass(frozen=True, eq=False)
class LossBursts:
    """The b bursts of consecutive effective losses among k packets."""

    packets: int
    """k"""
    first: Int64s
    """(b,) Place of the first lost packet."""
    length: Int64s
    """(b,)"""

    @property
    def end(self) -> Int64s:
        """(b,) Place of the packet after the last lost one."""
        return self.first + self.length

    @property
    def complete(self) -> Flags:
        """(b,) Whether the burst began and ended within the trace."""
        return (self.first > 0) & (self.end < self.packets)

    @property
    def losses(self) -> int:
        """Number of effective losses."""
        return int(self.length.sum())

    @property
    def longest(self) -> int:
        """Length of the longest burst; 0 if there is none."""
        return int(self.length.max(initial=0))

    def deliveries(self) -> Int64s:
        """(b + 1,) Deliveries before, between and after the bursts; the ends may be 0."""
        ends = np.append(self.first, self.packets)
        return np.asarray(ends - np.append(0, self.end))

    def only(self, which: Flags) -> "LossBursts":
        """Return some of the bursts."""
        return LossBursts(self.packets, self.first[which], self.length[which])

    def times_s(self, trace: PacketTrace) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return when each burst began, and how long it lasted, (b,) each.

        It lasts from the sending of its first packet to that of the next effective packet, or to
        the last sending.
        """
        after = np.minimum(self.end, self.packets - 1)
        begin_ns = trace.sent_ns[self.first]
        lasts_ns = trace.sent_ns[after] - begin_ns
        return np.asarray(begin_ns * 1e-9), np.asarray(lasts_ns * 1e-9)


def loss_bursts(effective: Flags) -> LossBursts:
    """Return the bursts of consecutive packets that are not effective."""
    steps = np.diff(np.concatenate([[1], effective.view(np.int8), [1]]))
    first = np.flatnonzero(steps < 0)
    return LossBursts(len(effective), first, np.flatnonzero(steps > 0) - first)
