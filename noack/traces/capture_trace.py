"""Packet traces from captures.

* Two captures, of the sender's and of the receiver's end: the datagrams are matched by payload. The
  clocks differ, unless the user says otherwise.
* One capture with both ends, such as the emulator writes: the same, with one clock.
* One capture of the receiver's end: numbers and sending times from the datagrams of
  ``noack measure``; or numbers at a known place of the payload, for a sender with a fixed period.

A flow is a pair of addresses at an interface. The largest is taken, unless the user names another.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import IO

from noack.traces.capture_blocks import is_capture
from noack.traces.capture_flows import CaptureFlows
from noack.traces.capture_matching import matched_trace, one_capture, two_captures
from noack.traces.capture_numbers import SequenceField, trace_of_numbers, trace_of_probe
from noack.traces.packet_trace import MAX_PACKETS, PacketTrace, TraceRecordError
from noack.traces.trace_formats import TraceFormat
from noack.traces.udp_headers import CapturedFlow


@dataclass(frozen=True)
class CaptureOptions:
    """How to read captures."""

    flow: int = 1
    """Which flow, by its number of datagrams; 1 is the largest."""
    sequence_at: SequenceField | None = None
    clocks_differ: bool | None = None
    """None: only if there are two captures."""
    most_packets: int = MAX_PACKETS


def read_captures(files: Sequence[IO[bytes]], options: CaptureOptions) -> PacketTrace:
    """Return the trace in one capture, or in those of the sender's and of the receiver's end.

    Raises:
        ValueError: one line; it is not a capture, or the datagrams cannot be matched.
    """
    flows = CaptureFlows(files[0])
    flow = flows.choose(options.flow)
    notes = flows.notes
    try:
        trace = _trace(flows, flow, files[1:], options, notes)
    except TraceRecordError as error:
        raise ValueError(f"datagram {error.row + 1} of the flow {error}") from None
    return trace.noted(*notes)


def _trace(
    flows: CaptureFlows,
    flow: CapturedFlow,
    others: Sequence[IO[bytes]],
    options: CaptureOptions,
    notes: list[str],
) -> PacketTrace:
    most = options.most_packets
    if options.sequence_at is not None:
        if others:
            raise ValueError("--sequence-at needs the receiver's capture only")
        return trace_of_numbers(flows, flow, options.sequence_at, most, notes)
    if others:
        receiver = CaptureFlows(others[0])
        notes += receiver.notes
        ends = two_captures(flows, flow, receiver)
    else:
        found = one_capture(flows, flow, notes)
        if found is None:
            return trace_of_probe(flows, flow, most, notes)
        ends = found
    differ = bool(others) if options.clocks_differ is None else options.clocks_differ
    return matched_trace(*ends, differ, most, notes)


def _read(file: IO[bytes], most_packets: int, clocks_differ: bool) -> PacketTrace:
    options = CaptureOptions(clocks_differ=clocks_differ or None, most_packets=most_packets)
    return read_captures([file], options)


CAPTURE = TraceFormat("pcap", is_capture, _read)
