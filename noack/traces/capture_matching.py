"""Matches the datagrams of a flow at the sender's and at the receiver's end by their payloads."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.traces.capture_flows import CaptureFlows, Payloads
from noack.traces.packet_trace import Int64s, PacketTrace, packet_trace
from noack.traces.relative_delay import relative_delays
from noack.traces.udp_headers import CapturedFlow


class _Matches(NamedTuple):
    """Datagrams at the receiver's end with the payload of a sent one."""

    received: Int64s
    """Places among the received datagrams."""
    sent: Int64s
    """Places among the sent datagrams."""


def two_captures(
    sender: CaptureFlows, flow: CapturedFlow, receiver: CaptureFlows
) -> tuple[Payloads, Payloads]:
    """Return the datagrams of a flow at its sender, and all that may be the same at the receiver.

    The addresses may differ (NAT, a relay); only the reverse flow of an echo is left out.
    """
    back = [k for k, one in enumerate(receiver.names) if one.is_reverse_of(flow)]
    received = receiver.payloads()
    sent = sender.payloads()
    return (
        _where(sent, sent.flow == sender.names.index(flow)),
        _where(received, ~np.isin(received.flow, back)),
    )


def one_capture(
    flows: CaptureFlows, flow: CapturedFlow, notes: list[str]
) -> tuple[Payloads, Payloads] | None:
    """Return the datagrams at the two ends in one capture; None if it has one end only."""
    everything = flows.payloads()
    number = flows.names.index(flow)
    mine = _where(everything, everything.flow == number)
    back = [k for k, one in enumerate(flows.names) if one.is_reverse_of(flow)]
    others = _where(everything, ~np.isin(everything.flow, [number, *back]))
    if not len(mine.t_ns):
        return None
    matches = _matches(mine, others)
    if not len(matches.sent):
        return None
    of_flow = others.flow[matches.received]
    counts = np.bincount(of_flow)
    delays_ns = others.t_ns[matches.received] - mine.t_ns[matches.sent]
    # A reverse flow with the same payloads (an echo) takes longer.
    likely = np.flatnonzero(2 * counts > counts.max())
    medians = {int(k): float(np.median(delays_ns[of_flow == k])) for k in likely}
    other = min(medians, key=lambda k: abs(medians[k]))
    notes.append(f"the other end: {flows.names[other]}")
    theirs = _where(others, others.flow == other)
    return (mine, theirs) if medians[other] >= 0 else (theirs, mine)


def matched_trace(
    sent: Payloads, received: Payloads, clocks_differ: bool, most: int, notes: list[str]
) -> PacketTrace:
    """Return the trace of the sent datagrams.

    Raises:
        ValueError: payloads are repeated, or none has arrived.
    """
    repeated = len(sent.hashes) - len(np.unique(sent.hashes))
    if repeated:
        raise ValueError(
            f"{repeated} of {len(sent.hashes)} datagrams have the payload of another one, and "
            "cannot be matched; if they are numbered, give the receiver's capture with "
            "--sequence-at OFFSET:BYTES"
        )
    matches = _matches(sent, received)
    place, first = np.unique(matches.sent, return_index=True)
    if not len(place):
        raise ValueError(
            "none of the complete datagrams sent is in the receiver's capture; are both captures "
            "of whole packets (tcpdump -s 0), and of the same time?"
        )
    if len(matches.sent) > len(place):
        notes.append(f"duplicates at the receiver: {len(matches.sent) - len(place)}")
    for where, outside in (("first", place[0]), ("last", len(sent.t_ns) - 1 - place[-1])):
        if outside:
            notes.append(
                f"the {where} {outside} sent datagrams did not arrive; if the receiver's capture "
                "did not run then, they are no losses"
            )
    received_ns = np.zeros(len(sent.t_ns), np.int64)
    received_ns[place] = received.t_ns[matches.received[first]]
    lost = np.ones(len(sent.t_ns), bool)
    lost[place] = False
    trace = packet_trace(
        sent.t_ns, received_ns, lost, clocks_differ=clocks_differ, most_packets=most
    )
    return relative_delays(trace) if clocks_differ else trace


def _where(payloads: Payloads, flags: NDArray[np.bool_]) -> Payloads:
    return Payloads(*(column[flags] for column in payloads))


def _matches(sent: Payloads, received: Payloads) -> _Matches:
    if not len(sent.hashes):
        return _Matches(np.zeros(0, np.int64), np.zeros(0, np.int64))
    hashes, places = np.unique(sent.hashes, return_index=True)
    at = np.minimum(np.searchsorted(hashes, received.hashes), len(hashes) - 1)
    known = np.flatnonzero(hashes[at] == received.hashes)
    return _Matches(known, places[at[known]])
