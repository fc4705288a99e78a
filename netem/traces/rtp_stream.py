"""RTP streams in a capture (RFC 3550): their synchronisation source, sequence numbers and timestamps.

A flow is a stream of RTP if nearly all of its datagrams have an RTP header of one source (SSRC), whose
sequence numbers are near those before them, and whose timestamps do not stand still. Timestamps say when
the sender took what it sent, also if it pauses or sends several packets for one picture.
"""

from typing import NamedTuple

import numpy as np

from netem.traces.captured_datagrams import CapturedFlow
from netem.traces.captured_flows import Capture
from netem.traces.packet_trace import Int64s
from netem.traces.sending_plan import SendingPlan
from netem.traces.sequence_numbers import nearest_steps
from netem.traces.smallest_delays import FEWEST, envelope_slope, find_steps, steps_text

_HEADER_BYTES = 12
_CONTROL_TYPES = range(72, 77)
"""Payload types that RTCP on the same port looks like (RFC 5761)."""
_FEWEST_PACKETS, _LEAST_SHARE, _NEAR_STEPS = 20, 0.9, 16
_RATES_HZ = (8000, 11025, 16000, 22050, 24000, 32000, 44100, 48000, 90000)
_NEAR = 0.02
"""Largest relative difference of a measured rate from one of these."""


class RtpStream(NamedTuple):
    """The n packets of one source, in the order of the file."""

    source: int
    payload_type: int
    row: Int64s  # (n,) Numbers of the datagrams in the file
    timestamp: Int64s  # (n,) Of 32 bits
    others: int  # Datagrams of the flow that are not of this source

    def ticks_of(self, row: Int64s) -> Int64s:
        """Return timestamps of packets in the order of sending, from 0, without wrap-around."""
        order = np.argsort(self.row)
        timestamps = self.timestamp[order[np.searchsorted(self.row, row, sorter=order)]]
        steps = nearest_steps(timestamps.astype(np.uint64), 1 << 32)
        # A picture may be sent before an earlier one.
        return np.maximum.accumulate(np.concatenate(([0], np.cumsum(steps))))


def find_rtp(capture: Capture, flow: CapturedFlow) -> RtpStream | None:
    """Return the stream of a flow; None: it is not one of RTP."""
    headers = []
    count = 0
    for row, datagram in enumerate(capture.read()):
        if datagram.flow != flow:
            continue
        count += 1
        payload = datagram.payload[:_HEADER_BYTES]
        if len(payload) == _HEADER_BYTES and payload[0] >> 6 == 2 and payload[1] & 127 not in _CONTROL_TYPES:
            fields = (payload[1] & 127, payload[2:4], payload[4:8], payload[8:12])
            headers.append((row, fields[0], *(int.from_bytes(part) for part in fields[1:])))
    if len(headers) < max(_FEWEST_PACKETS, _LEAST_SHARE * count):
        return None
    row, payload_type, number, timestamp, source = np.array(headers, np.int64).T
    sources, counts = np.unique(source, return_counts=True)
    main = int(sources[counts.argmax()])
    here = source == main
    if here.sum() < _LEAST_SHARE * count:
        return None
    steps = nearest_steps(number[here].astype(np.uint64), 1 << 16)
    is_near = (np.abs(steps) <= _NEAR_STEPS).mean() >= _LEAST_SHARE and (steps != 0).any()
    if not is_near or not np.diff(timestamp[here]).any():
        return None
    types, counts = np.unique(payload_type[here], return_counts=True)
    others = count - int(here.sum())
    return RtpStream(main, int(types[counts.argmax()]), row[here], timestamp[here], others)


def plan_by_timestamps(ticks: Int64s, received_ns: Int64s) -> tuple[SendingPlan, float]:
    """Return the sending times of packets by their timestamps, and the rate of these in Hz.

    Args:
        ticks: (n,) Timestamps in the order of sending, not descending.
        received_ns: (n,) When they arrived.
    """
    tick_ns = envelope_slope(ticks, received_ns)
    if len(ticks) < FEWEST or tick_ns <= 0:
        why = f"fewer than {FEWEST} datagrams, or timestamps that stand still; give the captures of both ends"
        return SendingPlan(received_ns, 0.0, why, ""), 0.0
    planned_ns = np.rint(tick_ns * ticks).astype(np.int64)
    delay_ns = received_ns - planned_ns
    sent_ns = planned_ns + delay_ns.min()
    rate_hz = 1e9 / tick_ns
    rate_hz = next((rate for rate in _RATES_HZ if abs(rate_hz / rate - 1) < _NEAR), rate_hz)
    steps = find_steps(planned_ns.astype(float), delay_ns.astype(float))
    unknown = ""
    if steps:
        unknown = (
            f"{steps_text(steps, received_ns)}: a clock was set, the route changed, or a queue stays full; "
            "measure the parts (editcap -A, -B), or give the captures of both ends"
        )
    return SendingPlan(sent_ns, tick_ns, unknown, ""), float(rate_hz)
