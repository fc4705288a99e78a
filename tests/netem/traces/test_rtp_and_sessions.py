"""RTP streams, datagrams of other sessions, and packets whose sending times are not known."""

import io
import random
import struct
from collections.abc import Sequence

import numpy as np
import pytest

from netem.measurement.loss_bursts import loss_bursts, outcomes
from netem.measurement.network_measurement import NetworkMeasurement
from netem.traces.capture_trace import CaptureOptions, read_captures
from netem.traces.numbered_datagrams import SequenceField
from netem.traces.packet_trace import PacketTrace, packet_trace
from tests.oracles.capture_files import Sent, pcap_of, pcapng_of

T_NS, PERIOD_NS = 1_700_000_000 * 10**9, 20_000_000


def trace_of(sent: Sequence[Sent], field: str | None = None) -> PacketTrace:
    sequence_at = None if field is None else SequenceField.parse(field)
    return read_captures([io.BytesIO(pcap_of(*sorted(sent)))], CaptureOptions(sequence_at=sequence_at))


def rtp(number: int, timestamp: int, source: int = 0x1234ABCD, payload_type: int = 96) -> bytes:
    return struct.pack(">BBHII", 0x80, payload_type, number % 2**16, timestamp % 2**32, source) + b"media"


def rfc_jitter_s(arrivals: Sequence[tuple[float, float]]) -> float:
    """RFC 3550, appendix A.8, of (arrival, sending) in seconds, in the order of arrival."""
    jitter, transit = 0.0, arrivals[0][0] - arrivals[0][1]
    for arrived, sent in arrivals[1:]:
        difference, transit = abs(arrived - sent - transit), arrived - sent
        jitter += (difference - jitter) / 16
    return jitter


def test_timestamps_of_rtp_are_the_sending_times() -> None:
    """A video of groups of packets, with pauses, which has no constant period."""
    rng = random.Random(1)
    sent, number, at_s, arrivals, delays_ns = [], 65_000, 0.0, [], []
    for frame in range(400):
        at_s += 2.5 if frame % 100 == 50 else 1 / 30
        for _ in range(rng.randrange(1, 5)):
            delay_s = 0.03 + 0.004 * rng.random()
            if number not in (65_100, 65_101, 65_700):
                arrived_ns = T_NS + round((at_s + delay_s) * 1e9)
                sent.append(Sent(arrived_ns, rtp(number, 2**32 - 9000 + round(at_s * 90_000))))
                arrivals.append((arrived_ns / 1e9 - T_NS / 1e9, at_s))
                delays_ns.append(delay_s * 1e9)
            number += 1
    sent += [Sent(T_NS + k * 10**9, rtp(7, 7, source=99)) for k in range(5)]
    sent.append(Sent(T_NS + 10**9, b"stun"))
    trace = trace_of(sent)
    assert int(trace.lost.sum()) == 3
    assert not trace.delays_unknown
    assert any(
        "source (SSRC) 0x1234abcd, payload type 96, timestamps of 90000 Hz" in line for line in trace.notes
    )
    assert any("not of this source: 6" in line for line in trace.notes)
    shown = trace.delay_ns[~trace.lost]
    expected = np.array(delays_ns) - min(delays_ns)
    assert np.abs(np.sort(shown) - np.sort(expected)).max() < 50_000
    jitter = NetworkMeasurement(trace).delays.jitter
    assert jitter is not None
    assert jitter.last_s == pytest.approx(rfc_jitter_s(sorted(arrivals)), abs=50e-6)


def test_other_payloads_are_no_rtp() -> None:
    for payloads in (
        [struct.pack(">BBHII", 0x80, 200, k, 5, 1) for k in range(100)],  # RTCP
        [struct.pack(">BBHII", 0x80, 0, k, 5, 1) for k in range(100)],  # timestamps stand still
        [struct.pack(">BBHII", 0x40, 0, k, k, 1) for k in range(100)],  # another version
        [struct.pack(">BBHII", 0x80, 0, k, k, k) for k in range(100)],  # no source
    ):
        with pytest.raises(ValueError, match="has one end only"):
            trace_of([Sent(T_NS + k * PERIOD_NS, payload) for k, payload in enumerate(payloads)])


def numbered(first: int, count: int, begin: int, lost: Sequence[int] = ()) -> list[Sent]:
    """Return datagrams with these numbers, the first one after ``begin`` periods."""
    rng = random.Random(first)
    return [
        Sent(
            T_NS + (begin + k) * PERIOD_NS + rng.randrange(PERIOD_NS // 10),
            struct.pack(">I", (first + k) % 2**32) + bytes([k % 256]),
        )
        for k in range(count)
        if k not in lost
    ]


@pytest.mark.parametrize("count", [1, 2, 5, 7, 10, 25])
@pytest.mark.parametrize("first", [0, 100_000, 2**31 + 5])
@pytest.mark.parametrize("is_before", [True, False])
def test_some_datagrams_of_another_session_cost_no_delays(count: int, first: int, is_before: bool) -> None:
    session = numbered(20_000, 900, 100, lost=(30, 31, 700))
    other = numbered(first, count, 40 if is_before else 1010)
    trace = trace_of(session + other, "0:4")
    assert int(trace.lost.sum()) == 3
    assert len(trace) == 900
    assert not trace.delays_unknown
    assert any(f"session: {count}" in line or f"the sequence: {count}" in line for line in trace.notes)


def test_a_negative_number_ends_a_stream_of_iperf2() -> None:
    session = numbered(1, 500, 0, lost=(119, 120, 121, 498, 499))
    end = [Sent(T_NS + (502 + k // 8) * PERIOD_NS + k, struct.pack(">i", -501)) for k in range(10)]
    trace = trace_of(session + end, "0:4")
    assert len(trace) == 501
    assert int(trace.lost.sum()) == 5
    assert not trace.delays_unknown
    assert not any("two counters" in line for line in trace.notes)


def test_a_burst_of_stale_packets_has_a_duration() -> None:
    """Of packets whose sending times are not known, since the sender pauses."""
    order = [*range(100), 103, 100, 101, 102, *range(104, 200)]
    times = [k * PERIOD_NS + (10**10 if k >= 150 else 0) for k in range(200)]
    sent = [Sent(T_NS + t_ns, struct.pack(">I", number)) for t_ns, number in zip(times, order, strict=True)]
    trace = trace_of(sent, "0:4")
    assert trace.delays_unknown
    assert (np.diff(trace.sent_ns) > 0).all()
    bursts = loss_bursts(outcomes(trace).effective)
    assert bursts.length.tolist() == [3]
    # Sent between packet 99 and packet 103, which arrived one period later.
    assert bursts.times_s(trace)[1][0] == pytest.approx(0.75 * PERIOD_NS / 1e9)


def test_one_datagram_at_both_ends_is_measured() -> None:
    both = [Sent(T_NS, b"only"), Sent(T_NS + 500_000, b"only", interface=1)]
    trace = read_captures([io.BytesIO(pcapng_of(*both))], CaptureOptions())
    assert trace.delay_ns.tolist() == [500_000]


def test_correlations_are_without_outages() -> None:
    rng = np.random.default_rng(1)
    sent_ns = np.arange(4000) * PERIOD_NS
    delay_ns = rng.integers(1_000_000, 9_000_000, 4000)
    lost = rng.random(4000) < 0.05
    quiet = NetworkMeasurement(_trace(sent_ns, delay_ns, lost))
    # In an outage of 8 s packets wait for its end, and arrive out of order.
    late = slice(1000, 1400)
    delay_ns[late] = (1400 - np.arange(1000, 1400)) * PERIOD_NS + np.arange(400)[::-1] * 1000
    with_outage = NetworkMeasurement(
        _trace(sent_ns, delay_ns, lost & ~((sent_ns > 20 * 10**9) & (sent_ns < 28 * 10**9)))
    )
    assert with_outage.is_outage.sum() == 1
    for before, behind in (
        (quiet.delays.correlation, with_outage.delays.correlation),
        (quiet.loss_correlation, with_outage.loss_correlation),
    ):
        assert abs(before.at_lags[0]) < 0.06
        assert abs(behind.at_lags[0]) < 0.06


def _trace(sent_ns: np.ndarray, delay_ns: np.ndarray, lost: np.ndarray) -> PacketTrace:
    return packet_trace(sent_ns, sent_ns + delay_ns, lost)
