"""Packet traces from captures.

* Two captures, of the sender's and of the receiver's end: the datagrams are matched by payload. The
  clocks differ, unless the user says otherwise.
* One capture with both ends, such as a host that forwards writes: the same, with one clock.
* One capture of the receiver's end: numbers at a known place of the payload, for a sender with a
  fixed period, or a stream of RTP, whose timestamps say when its packets were sent.

A flow is a pair of addresses on a leg: an interface, with the VLAN and the direction. The largest is
taken, unless the user names another. A datagram that a capture does not show as it was sent (cut, merged,
or dropped by the capture itself) is not counted as lost: it is matched in another way, or the capture is
refused.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import IO

import numpy as np

from netem.traces.capture_packets import is_capture
from netem.traces.captured_datagrams import CapturedFlow
from netem.traces.captured_flows import Capture, Datagrams, matches
from netem.traces.merged_datagrams import divide_merged
from netem.traces.numbered_datagrams import NumberedPackets, SequenceField, number_packets
from netem.traces.packet_trace import (
    FILE_ERRORS,
    MAX_PACKETS,
    Int64s,
    PacketTrace,
    TraceFormat,
    TraceRecordError,
    file_problem,
    packet_trace,
    relative_delays,
)
from netem.traces.rtp_stream import RtpStream, find_rtp, plan_by_timestamps
from netem.traces.sending_plan import plan_sending

_NEAR_END = 100
"""Arrivals by whose delays it is decided what the receiver's capture would show."""
_RTP_NUMBERS = SequenceField(2, 2, False)
MOST_UNKNOWN = 0.01
"""Largest share of packets that may have been lost by the capture, or that it does not show as sent."""


class CaptureFileError(ValueError):
    """One of the files cannot be used; ``place`` is its place among them, from 0."""

    def __init__(self, place: int, message: str) -> None:
        super().__init__(message)
        self.place = place


@dataclass(frozen=True)
class CaptureOptions:
    """How to read captures."""

    flow: int = 1  # Which flow, by its number of datagrams; 1 is the largest
    far_flow: int | None = None  # The flow at the far end; None: the nearest with the same datagrams
    sequence_at: SequenceField | None = None
    clocks_differ: bool | None = None  # None: only if there are two captures
    most_packets: int = MAX_PACKETS


@dataclass(frozen=True, eq=False)
class _Ends:
    """The datagrams at two ends."""

    sender: Capture
    sent: Datagrams
    receiver: Capture
    received: Datagrams  # Of one leg, or of all that may be the far end
    clocks_differ: bool

    def matched(self) -> tuple[Int64s, Int64s]:
        """Return the places of received datagrams that were sent, and of the latter."""
        return matches(self.sent, self.received)


def read_captures(files: Sequence[IO[bytes]], options: CaptureOptions) -> PacketTrace:
    """Return the trace in one capture, or in those of the sender's and of the receiver's end.

    Raises:
        CaptureFileError: one line; a file is not a capture, or has no datagrams.
        ValueError: one line; the captures do not show what was lost.
    """
    captures = []
    for place, file in enumerate(files):
        try:
            captures.append(Capture(file))
        except FILE_ERRORS as error:
            raise CaptureFileError(place, file_problem(error)) from None
    flow = captures[0].choose(options.flow)
    try:
        trace = _trace(captures, flow, options)
    except TraceRecordError as error:
        raise ValueError(f"datagram {error.row + 1} of the flow {error}") from None
    return trace.noted(*(note for capture in captures for note in capture.notes))


def _trace(captures: list[Capture], flow: CapturedFlow, options: CaptureOptions) -> PacketTrace:
    field = options.sequence_at
    stream = None
    if len(captures) == 1 and field in (None, _RTP_NUMBERS):
        stream = find_rtp(captures[0], flow)
    if len(captures) > 1:
        if field is not None:
            raise ValueError("--sequence-at needs the receiver's capture only")
        ends: _Ends | None = _two_captures(captures[0], flow, captures[1], options)
    elif (field or stream) and options.far_flow == options.flow:
        ends = None
    else:
        ends = _one_capture(captures[0], flow, options, field, is_numbered=bool(field or stream))
    if ends is None:
        if options.clocks_differ is not None:
            raise ValueError("--clocks: has no effect on one end, whose capture has no sending times")
        return _trace_of_numbers(captures[0], flow, field or _RTP_NUMBERS, stream, options.most_packets)
    return _trace_of_ends(ends, field, options.most_packets)


def _two_captures(sender: Capture, flow: CapturedFlow, receiver: Capture, options: CaptureOptions) -> _Ends:
    """Return the datagrams of a flow at its sender, and all that may be the same at the receiver.

    The addresses may differ (NAT, a relay); only the reverse flow of an echo is left out.
    """
    shown_bytes = min(sender.shown_bytes, receiver.shown_bytes)
    sender.show(shown_bytes)
    receiver.show(shown_bytes)
    sent = sender.datagrams.where(sender.datagrams.flow == sender.flows.index(flow))
    received = receiver.datagrams
    if options.far_flow is None:
        legs = ~np.isin(received.flow, receiver.reverse_of(flow))
    else:
        legs = received.flow == receiver.flows.index(receiver.choose(options.far_flow, "--far-flow"))
    differ = True if options.clocks_differ is None else options.clocks_differ
    ends = _Ends(sender, sent, receiver, received.where(legs), differ)
    if options.far_flow is None:
        counts = np.bincount(ends.received.flow[ends.matched()[0]], minlength=len(receiver.flows))
        likely = np.flatnonzero((2 * counts > counts.max()) & (counts > 0)).tolist()
        if len(likely) > 1:
            receiver.notes.append(
                "the receiver's capture has these datagrams several times, and the first arrival counts: "
                f"{receiver.numbered(likely)}; --far-flow N chooses one"
            )
    return ends


def _one_capture(
    capture: Capture,
    flow: CapturedFlow,
    options: CaptureOptions,
    field: SequenceField | None,
    *,
    is_numbered: bool,
) -> _Ends | None:
    """Return the datagrams at the two ends in one capture; None: it has one end, and numbers."""
    capture.show(capture.shown_bytes)
    everything, number = capture.datagrams, capture.flows.index(flow)
    mine = everything.where(everything.flow == number)
    others = everything.where(~np.isin(everything.flow, [number, *capture.reverse_of(flow)]))
    received, sent = matches(mine, others)
    if flow.leg.outbound and options.far_flow is None:
        _refuse_senders_end(capture.flows[k] for k in np.unique(others.flow[received]))
    if options.far_flow is None:
        received, sent = _without_copies(capture, flow, others, received, sent, is_numbered=is_numbered)
    if not len(sent):
        if options.far_flow not in (None, options.flow):
            raise ValueError(f"--far-flow {options.far_flow}: has no datagram of flow {options.flow}")
        if is_numbered:
            return None
        raise ValueError(
            f"has one end only of flow {options.flow} ({flow}); give the captures of both ends, choose "
            "another flow (--flow), or say where the payload has a sequence number: --sequence-at "
            "OFFSET:BYTES"
        )
    of_flow = others.flow[received]
    counts = np.bincount(of_flow)
    delays_ns = others.t_ns[received] - mine.t_ns[sent]
    # A reverse flow with the same payloads (an echo) takes longer.
    likely = np.flatnonzero(2 * counts > counts.max())
    medians = {int(k): float(np.median(delays_ns[of_flow == k])) for k in likely}
    other = min(medians, key=lambda k: abs(medians[k]))
    if options.far_flow is not None:
        other = capture.flows.index(capture.choose(options.far_flow, "--far-flow"))
        if not (of_flow == other).any():
            raise ValueError(f"--far-flow {options.far_flow}: has no datagram of flow {options.flow}")
        medians[other] = float(np.median(delays_ns[of_flow == other]))
    else:
        further = [k for k in medians if k != other]
        if further:
            capture.notes.append(
                f"these datagrams are also in {capture.numbered(further)}; --far-flow N compares with flow N"
            )
    capture.notes.append(
        f"compared with flow {other + 1}: {capture.flows[other]}. One host has captured both: losses and "
        "delays are those between these two legs, not those before or after them"
    )
    if flow.is_copy_of(capture.flows[other]):
        capture.notes.append("both legs have the same direction: between them is no network, only this host")
    theirs = others.where(others.flow == other)
    if field is not None:
        capture.notes.append(
            "the capture has both ends: sending times are those of the first one, and numbers that are "
            "missing there count as lost; to measure one flow alone by its numbers, give its number as "
            "--flow and as --far-flow"
        )
    differ = bool(options.clocks_differ)
    if medians[other] >= 0:
        return _Ends(capture, mine, capture, theirs, differ)
    return _Ends(capture, theirs, capture, mine, differ)


def _without_copies(
    capture: Capture,
    flow: CapturedFlow,
    others: Datagrams,
    received: Int64s,
    sent: Int64s,
    *,
    is_numbered: bool,
) -> tuple[Int64s, Int64s]:
    """Return matches without those on legs of the same direction, between which is no network."""
    copies = [k for k in np.unique(others.flow[received]).tolist() if capture.flows[k].is_copy_of(flow)]
    if not copies:
        return received, sent
    text = f"the same datagrams come in twice on this host (a bridge?): {capture.numbered(copies)}"
    is_other = ~np.isin(others.flow[received], copies)
    if not is_other.any() and not is_numbered:
        raise ValueError(
            f"has the receiver's end only: {text}; give the captures of both ends, or say where the payload "
            "has a sequence number: --sequence-at OFFSET:BYTES"
        )
    capture.notes.append(f"{text}; it is not the other end")
    return received[is_other], sent[is_other]


def _refuse_senders_end(other_legs: Iterable[CapturedFlow]) -> None:
    """Refuse outgoing datagrams that have come in on no other leg."""
    if all(flow.leg.outbound for flow in other_legs):
        raise ValueError(
            "shows the sender's end only (outgoing packets), where nothing is lost yet; capture at the "
            "receiver, or give the captures of both ends"
        )


def _trace_of_ends(ends: _Ends, field: SequenceField | None, most: int) -> PacketTrace:
    """Return the trace of the sent datagrams.

    Raises:
        ValueError: payloads are repeated, none has arrived, or a capture does not show what was lost.
    """
    ends = _with_merged_divided(ends)
    sent, received, notes = ends.sent, ends.received, ends.receiver.notes
    here, there = ends.matched()
    if len(here):
        _check_foreign(ends, here)
    repeated = len(sent.hashes) - len(np.unique(sent.hashes))
    if repeated:
        shown = ends.sender.shown_text()
        raise ValueError(
            f"{repeated} of {len(sent.hashes)} datagrams have the payload of another one{shown}, and "
            f"cannot be matched{_order_hint(ends, repeated)}; if they are numbered, give the receiver's "
            "capture with --sequence-at OFFSET:BYTES"
        )
    arrived, first = np.unique(there, return_index=True)
    if not len(arrived):
        raise ValueError(
            "none of the datagrams sent is in the receiver's capture; are both captures "
            f"of whole packets (tcpdump -s 0), and of the same time?{ends.receiver.problem()}"
        )
    of_leg = there[received.flow[here] == np.bincount(received.flow[here]).argmax()]
    if duplicates := len(of_leg) - len(np.unique(of_leg)):
        notes.append(f"duplicates at the receiver: {duplicates}")
    if not ends.receiver.has_fragments:
        ends.sender.note_merged(int(sent.flow[0]))
    arrived_ns = received.t_ns[here[first]]
    begin, end = _common_time(ends, arrived, arrived_ns)
    sent, arrived = sent.where(slice(begin, end)), arrived - begin
    received_ns = np.zeros(len(sent.t_ns), np.int64)
    received_ns[arrived] = arrived_ns
    lost = np.ones(len(sent.t_ns), bool)
    lost[arrived] = False
    sent_ns, numbers = sent.t_ns, None
    if field is not None:
        numbered = number_packets(ends.sender, ends.sender.flows[int(sent.flow[0])], field)
        sent_ns, received_ns, lost, numbers = _numbered_rows(numbered, sent, received_ns, lost)
    trace = packet_trace(
        sent_ns, received_ns, lost, numbers, clocks_differ=ends.clocks_differ, most_packets=most
    )
    _check_dropped(ends.receiver, received, trace)
    return relative_delays(trace) if ends.clocks_differ else trace


def _common_time(ends: _Ends, arrived: Int64s, arrived_ns: Int64s) -> tuple[int, int]:
    """Return the range of sent datagrams that the receiver's capture would show, had they arrived.

    Args:
        ends: the two ends.
        arrived: (k,) Places of the sent datagrams that arrived, ascending.
        arrived_ns: (k,) When they arrived.
    """
    sent_ns, span, notes = ends.sent.t_ns, ends.receiver.span, ends.receiver.notes
    lag_ns = arrived_ns - sent_ns[arrived]
    soonest_ns = lag_ns[:_NEAR_END].min()
    usually_ns = int(np.quantile(lag_ns[-_NEAR_END:], 0.99))
    begin = min(int(np.searchsorted(sent_ns, span.begin_ns - soonest_ns)), int(arrived[0]))
    end_ns = span.end_ns
    if ends.sender is ends.receiver and len(sent_ns) > 1:
        period_ns = int(np.median(np.diff(sent_ns)))
        if 4 * usually_ns < period_ns:
            end_ns += period_ns // 4  # hardly a datagram is on its way
    end = max(int(np.searchsorted(sent_ns, end_ns - usually_ns, side="right")), int(arrived[-1]) + 1)
    if begin:
        notes.append(f"datagrams left out because the receiver's capture begins after them: {begin}")
    if after := len(sent_ns) - end:
        last_s = (sent_ns[-1] - sent_ns[end]) / 1e9
        notes.append(
            f"datagrams left out because the receiver's capture ends before they would arrive: {after}, of "
            f"{last_s:.3g} s; if it ran on without a packet, they were lost"
        )
    return begin, end


def _numbered_rows(
    numbered: NumberedPackets, sent: Datagrams, received_ns: Int64s, lost: np.ndarray
) -> tuple[Int64s, Int64s, np.ndarray, Int64s]:
    """Return the sent datagrams that have a number, in the order of the numbers, and the numbers."""
    _, rows, numbers = np.intersect1d(sent.row, numbered.row, return_indices=True)
    order = np.argsort(numbered.packet[numbers], kind="stable")
    rows, numbers = rows[order], numbers[order]
    # The order of sending is that of the numbers.
    sent_ns = np.maximum.accumulate(sent.t_ns[rows])
    received_ns = np.maximum(received_ns[rows], np.where(lost[rows], 0, sent_ns))
    return sent_ns, received_ns, lost[rows], numbered.packet[numbers]


def _with_merged_divided(ends: _Ends) -> _Ends:
    """Return the ends with datagrams that a kernel merged (UDP GRO, GSO) divided again."""
    sent, received = ends.sent, ends.received
    here, there = ends.matched()
    legs = np.unique(received.flow[here]) if len(here) else np.unique(received.flow)
    unmatched = np.isin(received.flow, legs)
    unmatched[here] = False
    received = divide_merged(ends.receiver, received, unmatched, sent, all_known=True)
    far = received.where(np.isin(received.flow, legs))
    unmatched = np.ones(len(sent.t_ns), bool)
    unmatched[there] = False
    sent = divide_merged(ends.sender, sent, unmatched, far, all_known=False)
    return _Ends(ends.sender, sent, ends.receiver, received, ends.clocks_differ)


def _order_hint(ends: _Ends, repeated: int) -> str:
    """Return a hint for a line if repeated datagrams are in the first of two captures only."""
    if ends.sender is ends.receiver:
        return ""
    repeated_there = len(ends.received.hashes) - len(np.unique(ends.received.hashes))
    return " (unless the captures are in the wrong order: the sender's is the first)" * (
        repeated_there < repeated
    )


def _check_foreign(ends: _Ends, here: Int64s) -> None:
    """Refuse captures if the far end has datagrams between the sent ones that were not sent."""
    received, known_rows = ends.received, ends.sender.datagrams
    legs = np.bincount(received.flow[here])
    leg = int(legs.argmax())
    of_leg = np.flatnonzero(received.flow == leg)
    inside = of_leg[(of_leg >= here.min()) & (of_leg <= here.max())]
    known = np.isin(received.hashes[inside], known_rows.hashes) | np.isin(
        received.hashes[inside], ends.sent.hashes
    )
    foreign = inside[~known]
    if not len(foreign):
        return
    count, most = len(np.unique(received.hashes[foreign])), MOST_UNKNOWN * len(ends.sent.t_ns)
    longest = int(ends.sent.size.max())
    merged = int(np.count_nonzero(received.size[foreign] > longest))
    if merged > most:
        raise ValueError(
            f"{merged} of {len(inside)} datagrams at the far end are longer than all that were sent: the "
            "kernel merged them (UDP GRO); switch this off (ethtool -K DEVICE gro off) and capture again"
        )
    missing = len(np.unique(ends.sent.hashes)) - len(np.unique(received.hashes[here]))
    if count > most and count > missing:
        raise ValueError(
            f"{count} of {len(inside)} datagrams at the far end are not in the sender's capture, and "
            f"{missing} are in the sender's only: the captures are in the wrong order (the sender's is the "
            "first), or the sender's is incomplete"
        )
    ends.receiver.notes.append(
        f"datagrams at the far end that are not in the sender's capture: {count}; they do not count"
        f"{'' if missing else '. If the captures are in the wrong order, they were lost'}"
    )


def _check_dropped(capture: Capture, received: Datagrams, trace: PacketTrace) -> None:
    """Refuse a capture that may itself have lost more than 1 % of the packets."""
    legs, counts = np.unique(received.flow, return_counts=True)
    dropped = capture.dropped_at(int(legs[counts.argmax()]))
    if not dropped:
        return
    lost = int(trace.lost.sum())
    unknown = min(dropped, lost)
    cause = f"the capture itself dropped {dropped} packets, as its statistics say"
    if unknown > MOST_UNKNOWN * len(trace):
        raise ValueError(
            f"{cause}: up to {unknown} of the {lost} missing packets were not lost in the network; "
            "capture again with a larger buffer (tcpdump -B 65536)"
        )
    capture.notes.append(f"{cause}: up to {unknown} of the {lost} lost packets were not lost in the network")


def _trace_of_numbers(
    capture: Capture, flow: CapturedFlow, field: SequenceField, stream: RtpStream | None, most_packets: int
) -> PacketTrace:
    """Return the trace of a sender with a constant period, or of RTP; the payloads have a number each."""
    if flow.leg.outbound:
        everything, number = capture.datagrams, capture.flows.index(flow)
        others = everything.where(everything.flow != number)
        received, _ = matches(everything.where(everything.flow == number), others)
        _refuse_senders_end(capture.flows[k] for k in np.unique(others.flow[received]))
    numbered = number_packets(capture, flow, field, None if stream is None else stream.row)
    capture.note_merged(capture.flows.index(flow))
    count = int(numbered.packet.max()) + 1
    if count > most_packets:
        raise ValueError(
            f"the sequence numbers span {count} packets; at most {most_packets} can be; check --sequence-at"
        )
    order = np.argsort(numbered.packet, kind="stable")
    packet, part, received_ns, row = (column[order] for column in numbered[:4])
    received_ns = received_ns - received_ns.min()
    if stream is None:
        sent_ns, unknown = _planned_times(capture, packet, part, received_ns)
    else:
        sent_ns, unknown = _times_of_stream(capture, stream, packet, row, part, received_ns)
    trace = packet_trace(
        sent_ns,
        np.maximum(received_ns, sent_ns),
        np.zeros(len(packet), bool),
        packet,
        clocks_differ=True,
        most_packets=most_packets,
    )
    index = capture.flows.index(flow)
    _check_dropped(capture, capture.datagrams.where(capture.datagrams.flow == index), trace)
    return replace(trace, delays_unknown=unknown, losses_ambiguous=numbered.ambiguous)


def _planned_times(capture: Capture, packet: Int64s, part: Int64s, received_ns: Int64s) -> tuple[Int64s, str]:
    """Return the sending times by a constant period, below all arrivals, and why delays are not known.

    If they are not, the sending times are those of the arrivals.
    """
    periods_ns: list[float] = []
    sent_ns = np.zeros(len(packet), np.int64)
    unknown = ""
    for here in (part == k for k in np.unique(part)):
        number = packet[here] - packet[here][0]
        planned = plan_sending(number, received_ns[here])
        sent_ns[here] = planned.sent_ns
        periods_ns.append(planned.period_ns)
        unknown = unknown or planned.unknown
        if planned.note:
            capture.notes.append(planned.note)
    if unknown:
        capture.notes.append(f"the capture has no sending times, and delays are not known: {unknown}")
        return _times_of_arrivals(packet, received_ns), unknown
    periods = ", ".join(dict.fromkeys(f"{period_ns / 1e6:.6g}" for period_ns in periods_ns))
    capture.notes.append(
        "the capture has no sending times: by the arrivals, the sender's period is constant, "
        f"{periods} ms; the smallest delay is shown as 0, and a deadline applies to these relative delays"
    )
    return np.maximum.accumulate(sent_ns), ""


def _times_of_arrivals(packet: Int64s, received_ns: Int64s) -> Int64s:
    """Return sending times for packets in the order of their numbers, without delays.

    They are the arrivals of those that arrived before all later ones, and between them on a line.
    """
    soonest_ns = np.minimum.accumulate(received_ns[::-1])[::-1]
    in_order = np.flatnonzero(received_ns == soonest_ns)
    in_order = in_order[np.append(np.diff(received_ns[in_order]) > 0, True)]
    known, at_ns = packet[in_order], received_ns[in_order]
    period_ns = (at_ns[-1] - at_ns[0]) // max(int(known[-1] - known[0]), 1)
    before_ns = at_ns[0] - (known[0] - packet[: in_order[0]]) * period_ns
    after_ns = np.rint(np.interp(packet[in_order[0] :], known, at_ns - at_ns[0])).astype(np.int64)
    return np.concatenate((before_ns, at_ns[0] + after_ns))


def _times_of_stream(
    capture: Capture,
    stream: RtpStream,
    packet: Int64s,
    row: Int64s,
    part: Int64s,
    received_ns: Int64s,
) -> tuple[Int64s, str]:
    """Return the sending times by the timestamps, below all arrivals, and why delays are not known."""
    sent_ns = np.zeros(len(row), np.int64)
    rates_hz: list[float] = []
    unknown = ""
    for here in (part == k for k in np.unique(part)):
        planned, rate_hz = plan_by_timestamps(stream.ticks_of(row[here]), received_ns[here])
        sent_ns[here] = planned.sent_ns
        rates_hz.append(rate_hz)
        unknown = unknown or planned.unknown
    rates = ", ".join(dict.fromkeys(f"{rate_hz:.6g}" for rate_hz in rates_hz))
    capture.notes.append(
        f"a stream of RTP: source (SSRC) 0x{stream.source:08x}, payload type {stream.payload_type}, "
        f"timestamps of {rates} Hz"
    )
    if stream.others:
        capture.notes.append(f"datagrams left out because they are not of this source: {stream.others}")
    if unknown:
        capture.notes.append(f"the delays are not known: {unknown}")
        return _times_of_arrivals(packet, received_ns), unknown
    capture.notes.append(
        "sending times are those of the timestamps; the smallest delay is shown as 0, and a deadline applies "
        "to these relative delays"
    )
    return np.maximum.accumulate(sent_ns), ""


def _read(file: IO[bytes], most_packets: int, clocks_differ: bool) -> PacketTrace:
    options = CaptureOptions(clocks_differ=clocks_differ or None, most_packets=most_packets)
    return read_captures([file], options)


CAPTURE = TraceFormat("pcap", is_capture, _read)
