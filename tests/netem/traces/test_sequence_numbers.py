"""Numbers that wrap around, senders that restart, and fields that are no sequence numbers."""

import io
import random
import struct
from collections.abc import Sequence

import numpy as np
import pytest

from netem.core.errors import CallerError
from netem.measurement.network_measurement import MeasurementOptions, NetworkMeasurement
from netem.traces.capture_trace import CaptureOptions, read_captures
from netem.traces.numbered_datagrams import SequenceField
from netem.traces.packet_trace import PacketTrace
from netem.traces.sequence_numbers import find_packets
from tests.oracles.capture_files import Sent, pcap_of

T_NS, PERIOD_NS = 1_700_000_000 * 10**9, 20_000_000


def capture(
    packets: Sequence[int],
    size_bytes: int,
    *,
    first: int = 0,
    order: str = "big",
    period_ns: int = PERIOD_NS,
    jitter: float = 0.0,
) -> bytes:
    """Return a receiver's capture of packets, by their place among those that are sent."""
    rng = random.Random(1)
    sent = []
    for k in packets:
        number = (first + k) % (1 << 8 * size_bytes)
        payload = b"head" + number.to_bytes(size_bytes, order) + rng.randbytes(9)  # type: ignore[arg-type]
        delay_ns = round((3 + rng.random() * jitter) * period_ns)
        sent.append(Sent(T_NS + k * period_ns + delay_ns, payload))
    return pcap_of(*sorted(sent))


def trace_of(file: bytes, size_bytes: int, order: str = "big") -> PacketTrace:
    field = SequenceField(4, size_bytes, order == "little")
    return read_captures([io.BytesIO(file)], CaptureOptions(sequence_at=field))


def lost_of(packets: Sequence[int]) -> list[int]:
    """Return the places, from the first packet, of those that are missing."""
    first = min(packets)
    return [k - first for k in sorted({*range(first, max(packets))} - {*packets})]


@pytest.mark.parametrize(("size_bytes", "order"), [(1, "big"), (2, "little"), (3, "big"), (8, "little")])
@pytest.mark.parametrize("gap", [1, 127, 128, 255, 256, 33_000, 70_000])
def test_a_gap_of_any_length_is_counted_exactly(gap: int, size_bytes: int, order: str) -> None:
    packets = [k for k in range(600 + gap) if not 300 <= k < 300 + gap]
    trace = trace_of(capture(packets, size_bytes, order=order, jitter=0.5), size_bytes, order)
    assert np.flatnonzero(trace.lost).tolist() == lost_of(packets)
    assert not any(word in line for line in trace.notes for word in ("duplicates", "restarted", "left out"))
    (line,) = [line for line in trace.notes if "period" in line]
    assert float(line.split("constant, ")[1].split(" ms")[0]) == pytest.approx(PERIOD_NS / 1e6, rel=1e-3)


@pytest.mark.parametrize("first", [0, 250, 65_530, 2**32 - 5, 2**62 - 7, 2**63 - 9, 2**64 - 11])
@pytest.mark.parametrize("size_bytes", range(1, 9))
def test_numbers_may_be_large_and_wrap_around(size_bytes: int, first: int) -> None:
    packets = [k for k in range(500) if k % 7 != 3]
    random.Random(3).shuffle(packets)
    trace = trace_of(capture(packets, size_bytes, first=first, jitter=4), size_bytes)
    assert np.flatnonzero(trace.lost).tolist() == lost_of(packets)


@pytest.mark.parametrize("seed", range(15))
def test_any_losses_are_counted_exactly(seed: int) -> None:
    rng = random.Random(seed)
    size_bytes, period_ns = rng.choice([1, 1, 2, 3, 4, 8]), rng.choice([10**6, 5 * 10**6, PERIOD_NS, 10**8])
    packets, k = [], 0
    for _ in range(rng.randrange(300, 1500)):
        k += 1 + (rng.random() < 0.2) * rng.randrange(5)
        k += rng.randrange(5000) if rng.random() < 0.003 else 0
        packets.append(k)
    packets += [k for k in packets if rng.random() < 0.02]  # duplicates
    file = capture(
        packets, size_bytes, first=rng.randrange(2**63), period_ns=period_ns, jitter=rng.random() * 3
    )
    assert np.flatnonzero(trace_of(file, size_bytes).lost).tolist() == lost_of(packets)


@pytest.mark.parametrize("bits", [8, 16, 32])
@pytest.mark.parametrize(
    ("largest", "jitter_ns"), [(40, 0), (40, 900_000), (9, 20_000_000), (4, 3_000_000), (200, 1_000_000)]
)
def test_groups_in_any_order_are_no_restart(largest: int, jitter_ns: int, bits: int) -> None:
    """Video frames of many packets each, which overtake each other."""
    rng = np.random.default_rng(1)
    sizes = rng.integers(largest // 7 + 1, largest, 900)
    sent_ns = np.repeat(33_300_000 * np.arange(900), sizes)
    sent_ns += 12_000 * (np.arange(len(sent_ns)) - np.repeat(np.cumsum(sizes) - sizes, sizes))
    t_ns = T_NS + sent_ns + rng.integers(0, jitter_ns + 1, len(sent_ns))
    kept = np.flatnonzero(rng.random(len(sent_ns)) > 0.02)
    number = kept[np.argsort(t_ns[kept], kind="stable")]
    t_ns = t_ns[number]
    if largest == 200 and bits == 8:
        with pytest.raises(ValueError, match="overtake more others than 8 bits can tell"):
            find_packets((number % 256).astype(np.uint64), t_ns, bits)
        return
    arrivals = find_packets((number % 2**bits).astype(np.uint64), t_ns, bits)
    assert (arrivals.packet - arrivals.packet.min()).tolist() == (number - number.min()).tolist()
    assert not arrivals.part.any()


@pytest.mark.parametrize("size_bytes", [2, 3, 4, 8])
@pytest.mark.parametrize(
    ("before", "first", "down"), [(500, 0, 0), (500, 0, 400), (40, 0, 5), (20_000, 3, 90)]
)
def test_a_sender_that_restarts_is_noticed(size_bytes: int, before: int, first: int, down: int) -> None:
    start = 0 if before < 10_000 else 2**15
    parts = [k for k in range(before) if k != 20], [k for k in range(300) if k not in (0, 100, 101)]
    rng = random.Random(1)
    sent = [
        Sent(
            T_NS + (place + k) * PERIOD_NS + rng.randrange(PERIOD_NS),
            struct.pack(">Q", number + k)[-size_bytes:],
        )
        for part, place, number in ((parts[0], 0, start), (parts[1], before + down, first))
        for k in part
    ]
    trace = read_captures(
        [io.BytesIO(pcap_of(*sent))], CaptureOptions(sequence_at=SequenceField(0, size_bytes, False))
    )
    assert int(trace.lost.sum()) == 3
    assert len(trace) == before + 299
    assert not any("duplicates" in line for line in trace.notes)
    assert sum("the sender restarted at" in line for line in trace.notes) == 1


def test_single_numbers_that_are_none_are_left_out() -> None:
    file = [Sent(T_NS + k * PERIOD_NS, struct.pack(">I", k) + b"x") for k in range(500)]
    file[200] = file[200]._replace(payload=b"\x9f" * 5)
    trace = read_captures(
        [io.BytesIO(pcap_of(*file))], CaptureOptions(sequence_at=SequenceField(0, 4, False))
    )
    assert np.flatnonzero(trace.lost).tolist() == [200]
    assert any("does not belong to the sequence: 1" in line for line in trace.notes)


@pytest.mark.parametrize("second", [0, 3, 1000, 40_000])
def test_two_counters_in_one_flow_are_noticed(second: int) -> None:
    payloads = [struct.pack(">HB", k // 2 + (second if k % 2 else 0), k % 2) for k in range(1000)]
    file = pcap_of(*(Sent(T_NS + k * PERIOD_NS, payload) for k, payload in enumerate(payloads)))
    options = CaptureOptions(sequence_at=SequenceField(0, 2, False))
    if second < 1000:
        trace = read_captures([io.BytesIO(file)], options)
        assert sum("two counters" in line for line in trace.notes) == 1
    else:
        with pytest.raises(ValueError, match="two counters"):
            read_captures([io.BytesIO(file)], options)


def test_fields_that_are_no_sequence_numbers_are_refused() -> None:
    rng = random.Random(1)
    for payloads, message in (
        ([b"\0\5"] * 500, "the numbers at 0:2 do not ascend"),
        ([rng.randbytes(2) for _ in range(500)], "the numbers at 0:2 jump at random"),
        (
            [struct.pack(">HI", k % 2, k) for k in range(500)],
            "of 500 datagrams have the number of an earlier one",
        ),
        (
            [struct.pack("<H", k % 2**16) for k in range(1000)],
            "wrong byte order; try --sequence-at 0:2:little",
        ),
    ):
        file = pcap_of(*(Sent(T_NS + k * PERIOD_NS, payload) for k, payload in enumerate(payloads)))
        with pytest.raises(ValueError, match=message):
            read_captures([io.BytesIO(file)], CaptureOptions(sequence_at=SequenceField(0, 2, False)))
    at_once = pcap_of(*(Sent(T_NS, struct.pack(">H", k)) for k in range(50)))
    with pytest.raises(ValueError, match="period"):
        read_captures([io.BytesIO(at_once)], CaptureOptions(sequence_at=SequenceField(0, 2, False)))
    times = pcap_of(*(Sent(T_NS + k * PERIOD_NS, struct.pack(">I", 160 * k)) for k in range(50)))
    trace = read_captures([io.BytesIO(times)], CaptureOptions(sequence_at=SequenceField(0, 4, False)))
    assert any("multiples of 160" in line for line in trace.notes)
    by_two = pcap_of(*(Sent(T_NS + k * PERIOD_NS, struct.pack(">I", 2 * k)) for k in range(50)))
    trace = read_captures([io.BytesIO(by_two)], CaptureOptions(sequence_at=SequenceField(0, 4, False)))
    assert any("multiples of 2:" in line for line in trace.notes)


def numbered(sent: Sequence[tuple[int, int]], field: SequenceField) -> PacketTrace:
    """Return the trace of datagrams with (time, number in the whole field)."""
    payloads = [(t_ns, number.to_bytes(field.size_bytes, "big")) for t_ns, number in sent]
    file = pcap_of(*(Sent(T_NS + t_ns, payload + b"x") for t_ns, payload in payloads))
    return read_captures([io.BytesIO(file)], CaptureOptions(sequence_at=field))


def keepalive(bits: int, idle_s: int, cycles: int) -> list[tuple[int, int]]:
    """A source sends 44 packets a second while something changes, else one every ``idle_s``."""
    sent, t_ns, number = [], 0, 0
    for _ in range(cycles):
        for spacing_ns in (*[22_727_000] * 40, *[idle_s * 10**9] * 12):
            sent.append((t_ns, number % (1 << bits)))
            t_ns, number = t_ns + spacing_ns, number + 1
    return sent


@pytest.mark.parametrize(("bits", "idle_s"), [(8, 1), (8, 3), (16, 1), (16, 600)])
def test_a_gap_holds_at_most_what_the_sender_can_send(bits: int, idle_s: int) -> None:
    sent = keepalive(bits, idle_s, 12)
    del sent[200], sent[100:102]
    trace = numbered(sent, SequenceField(0, bits // 8, False))
    assert int(trace.lost.sum()) == 3
    assert not trace.losses_ambiguous


def test_what_numbers_do_not_say_is_said_with_both_counts() -> None:
    """44 · 7 s hold 256 packets: a pause of a sender that pauses looks like their loss."""
    trace = numbered(keepalive(8, 7, 6), SequenceField(0, 1, False))
    pauses = 6 * 12 - 1
    assert int(trace.lost.sum()) == 0
    assert f"wrapped around: {pauses}." in trace.losses_ambiguous
    assert f": 0 packets are lost if the sender paused in all of them, {256 * pauses} if" in (
        trace.losses_ambiguous
    )
    assert trace.losses_ambiguous in trace.notes
    with pytest.raises(CallerError, match="a deadline"):
        NetworkMeasurement(trace, MeasurementOptions(deadline_s=0.1))
    steady = [(k * PERIOD_NS, k % 256) for k in range(1200) if not 400 <= k < 700]
    trace = numbered(steady, SequenceField(0, 1, False))
    assert int(trace.lost.sum()) == 300
    assert "44 packets are lost if the sender paused in all of them, 300 if" in trace.losses_ambiguous
    assert not trace.delays_unknown
    with pytest.raises(CallerError, match="the number of losses, which is not certain"):
        NetworkMeasurement(trace, MeasurementOptions(deadline_s=0.1))


@pytest.mark.parametrize(
    ("text", "bits", "numbers", "flags"),
    [
        ("0:2", 14, None, 0xC000), ("0:2", 12, None, 0x7000), ("0:1", 4, None, 0x50),
        ("0:1", None, "1..255", 0), ("0:1", 4, "0..14", 0xA0), ("0:4", None, "100..70000", 0),
    ],
)  # fmt: skip
def test_numbers_of_some_bits_or_another_range(
    text: str, bits: int | None, numbers: str | None, flags: int
) -> None:
    field = SequenceField.parse(text, bits, numbers)
    lost = {40, 300, 301, 302, 303, 900}
    sent = [
        (k * PERIOD_NS + k * 7919 % 10**6, flags | (field.first + (k + 11) % field.size))
        for k in range(1000)
        if k not in lost
    ]
    trace = numbered(sent, field)
    assert set(np.flatnonzero(trace.lost).tolist()) == lost
    assert len(trace) == 1000
    assert not trace.losses_ambiguous


@pytest.mark.parametrize(
    ("bits", "numbers", "message"),
    [
        (17, None, "--bits: expected 2 to 16"), (None, "5..4", "--numbers: expected FIRST..LAST"),
        (None, "0..65536", "--numbers: expected FIRST..LAST, at most 65535"),
        (None, "x", "--numbers: expected"), (4, "0..16", "--numbers: expected FIRST..LAST, at most 15"),
    ],
)  # fmt: skip
def test_a_wrong_range_is_refused(bits: int | None, numbers: str | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SequenceField.parse("0:2", bits, numbers)


def test_numbers_outside_the_range_are_refused_or_left_out() -> None:
    field = SequenceField.parse("0:1", None, "1..255")
    sent = [(k * PERIOD_NS, 1 + k % 255) for k in range(600)]
    sent[300] = (sent[300][0], 0)
    trace = numbered(sent, field)
    assert np.flatnonzero(trace.lost).tolist() == [300]
    assert any("not in 1..255: 1" in line for line in trace.notes)
    with pytest.raises(ValueError, match=r"are not in 1\.\.255; check --numbers"):
        numbered([(k * PERIOD_NS, k // 9 % 2) for k in range(600)], field)


@pytest.mark.parametrize("size_bytes", [1, 2, 4])
def test_a_counter_of_several_receivers_is_refused(size_bytes: int) -> None:
    """Of 51 packets in each period this receiver gets two."""
    sent = [
        (k * 33_000_000 + j * 10**5, (51 * k + j) % (1 << 8 * size_bytes)) for k in range(600) for j in (1, 2)
    ]
    with pytest.raises(ValueError, match=r"96 % of the numbers at 0:.* they count more than this flow"):
        numbered(sent, SequenceField(0, size_bytes, False))


def test_an_outage_is_no_shared_counter() -> None:
    sent = [(k * PERIOD_NS, k) for k in range(20_000) if k < 200 or k > 19_700]
    assert int(numbered(sent, SequenceField(0, 4, False)).lost.sum()) == 19_501
