"""Packet traces from captures: ends, legs, and what a capture does not show."""

import io
import random
import struct
from collections.abc import Container, Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem.core.errors import CallerError
from netem.measurement.network_measurement import MeasurementOptions, NetworkMeasurement
from netem.traces.capture_packets import captured_packets
from netem.traces.capture_trace import CaptureOptions, read_captures
from netem.traces.captured_datagrams import CapturedDatagram, DatagramReader
from netem.traces.numbered_datagrams import SequenceField
from netem.traces.packet_trace import PacketTrace
from tests.oracles.capture_files import (
    COOKED,
    COOKED_2,
    ETHERNET,
    LINKS,
    LOOPBACK,
    Sent,
    fragments_of,
    pcap_of,
    pcap_of_packets,
    pcapng_of,
)

T_NS, CAPTURE_PERIOD_NS = 1_700_000_000 * 10**9, 20_000_000
AT_SERVER = {"source": "10.0.0.9", "source_port": 7000, "destination": "10.0.0.2", "interface": 1}


def trace_of(*files: bytes, **options: object) -> PacketTrace:
    return read_captures(list(map(io.BytesIO, files)), CaptureOptions(**options))  # type: ignore[arg-type]


def network(count: int = 200, seed: int = 1) -> tuple[list[Sent], list[Sent], dict[int, int]]:
    """Return what is sent and what arrives (lost, reordered, duplicated), and the delays."""
    rng = random.Random(seed)
    sent = [Sent(T_NS + k * CAPTURE_PERIOD_NS, struct.pack(">Q", k)) for k in range(count)]
    delays = {k: rng.randrange(5 * CAPTURE_PERIOD_NS) + 1 for k in range(count) if rng.random() > 0.3}
    arrived = [sent[k]._replace(t_ns=sent[k].t_ns + delay) for k, delay in delays.items()]
    arrived += [packet._replace(t_ns=packet.t_ns + 10**9) for packet in arrived[::7]]
    return sent, sorted(arrived), delays


def delays_in(trace: PacketTrace) -> dict[int, int]:
    return {int(k): int(delay) for k, delay in enumerate(trace.delay_ns) if delay >= 0}


@pytest.mark.parametrize("offset_ns", [0, 10**12, -(10**12)])
def test_two_captures_give_the_losses_and_relative_delays(offset_ns: int) -> None:
    sent, arrived, delays = network()
    other = Sent(T_NS, b"other")._replace(destination_port=53)
    shifted = [packet._replace(t_ns=packet.t_ns + offset_ns, **AT_SERVER) for packet in arrived]
    trace = trace_of(pcap_of(other, *sent), pcapng_of(*shifted))
    smallest, begin = min(delays.values()), min(delays)
    # What was sent before the receiver's capture begins does not count.
    assert len(trace) == len(sent) - begin
    assert any(f"begins after them: {begin}" in line for line in trace.notes)
    assert delays_in(trace).keys() == {k - begin for k in delays}
    # The drift of so short a record is small against its delays, but not exactly 0.
    for k, delay_ns in delays_in(trace).items():
        assert abs(delay_ns - (delays[k + begin] - smallest)) < 500e-6 * 200 * CAPTURE_PERIOD_NS + 2
    assert any("--flow chooses" in line for line in trace.notes)
    if offset_ns == 0:
        trace = trace_of(pcap_of(*sent), pcapng_of(*shifted), clocks_differ=False)
        assert delays_in(trace) == {k - begin: delay for k, delay in delays.items()}


def test_datagrams_outside_the_common_time_of_both_captures_do_not_count() -> None:
    sent, arrived = on_leg(0), on_leg(7_000_000, [5, 100, 250, 251])
    # The receiver's capture has the arrivals 40 to 199, or runs longer.
    part = [packet for packet in arrived if 40 <= (packet.t_ns - T_NS) // CAPTURE_PERIOD_NS < 200]
    trace = trace_of(pcap_of(*sent), pcap_of(*part))
    assert np.flatnonzero(trace.lost).tolist() == [60]
    assert any("begins after them: 40" in line for line in trace.notes)
    assert any("would arrive: 100, of 1.98 s;" in line for line in trace.notes)
    # Other packets show that it ran from 0 to 6 s.
    other = [Sent(T_NS + second * 10**9, b"x", destination_port=53) for second in range(7)]
    trace = trace_of(pcap_of(*sent), pcap_of(*sorted([*part, *other])))
    assert int(trace.lost.sum()) == 40 + 100 + 1
    # The sender's capture begins late.
    trace = trace_of(pcap_of(*sent[50:]), pcap_of(*arrived))
    assert np.flatnonzero(trace.lost).tolist() == [50, 200, 201]
    # The last datagram may still be on its way.
    file = pcap_of(*sorted([*on_leg(0, interface=2, direction=1),
                            *on_leg(7_000_000, [250, 299], interface=3, direction=2)]),
                   link_type=COOKED_2)  # fmt: skip
    assert np.flatnonzero(trace_of(file).lost).tolist() == [250]


def test_a_bridge_at_the_receiver_is_not_the_network() -> None:
    field = SequenceField(2, 4, False)
    legs = [
        on_leg(0, LOST, interface=2, direction=1),
        on_leg(9, LOST, interface=3, direction=1),
    ]
    twice = pcap_of(*sorted(packet for leg in legs for packet in leg), link_type=COOKED_2)
    with pytest.raises(ValueError, match=r"receiver's end only: the same datagrams come in twice .*flow 2"):
        trace_of(twice)
    trace = trace_of(twice, sequence_at=field)
    assert np.flatnonzero(trace.lost).tolist() == LOST
    assert any("it is not the other end" in line for line in trace.notes)
    chosen = trace_of(twice, far_flow=2)
    assert any("One host has captured both" in line for line in chosen.notes)
    assert any("between them is no network" in line for line in chosen.notes)
    # A bridge that forwards: the leg that goes out is the other end.
    out = on_leg(90, [*LOST, 20], interface=4, direction=2)
    file = pcap_of(*sorted([*legs[0], *legs[1], *out]), link_type=COOKED_2)
    trace = trace_of(file)
    assert trace.lost.sum() == 1
    assert any("compared with flow 3" in line for line in trace.notes)


@pytest.mark.parametrize("link_type", [COOKED, COOKED_2])
def test_what_goes_over_the_loopback_interface_counts_once(link_type: int) -> None:
    """An emulator on one host, captured with -i any: each datagram goes out, and comes in at once."""
    at_emulator = [*on_leg(0), *on_leg(2_000_000, LOST, **AT_SERVER)]
    both = [
        packet._replace(t_ns=packet.t_ns + delay_ns, interface=1, direction=direction, hardware=772)
        for packet in at_emulator
        for delay_ns, direction in ((0, 2), (5_000, 1))
    ]
    trace = trace_of(pcap_of(*sorted(both), link_type=link_type))
    assert np.flatnonzero(trace.lost).tolist() == LOST
    assert set(trace.delay_ns[~trace.lost].tolist()) == {2_000_000}


def test_one_capture_of_both_ends_is_matched_in_the_right_direction() -> None:
    sent, arrived, delays = network()
    forwarded = [packet._replace(**AT_SERVER) for packet in arrived]
    # An echo with the same payloads goes back over both interfaces.
    back = {"source": "198.51.100.7", "source_port": 6000, "destination": "192.0.2.1"}
    echoes = [packet._replace(t_ns=packet.t_ns + 5, destination_port=5000, **back) for packet in arrived]
    trace = trace_of(pcapng_of(*sorted([*sent, *forwarded, *echoes])))
    assert delays_in(trace) == delays


def test_numbers_at_a_known_place_may_wrap_around() -> None:
    period_ns = 20_000_137
    arrivals = [
        Sent(
            T_NS + k * period_ns + (k % 10) * 10**6, b"xx" + struct.pack("<H", (65_500 + k) % 2**16)
        )
        for k in range(200) if k % 5
    ]  # fmt: skip
    trace = trace_of(
        pcap_of(b_short := Sent(T_NS, b""), *arrivals),
        sequence_at=SequenceField.parse("2:2:little"),
    )
    assert b_short.payload == b""
    lost = [k % 5 == 0 for k in range(1, 200)]
    assert trace.lost.tolist() == lost
    expected = np.array([(k % 10 - 1) * 10**6 for k in range(1, 200)])
    assert np.abs(trace.delay_ns - expected)[~trace.lost].max() < 1000
    assert "20.0001 ms" in " ".join(trace.notes)


@pytest.mark.parametrize("back_ns", [45_000_000, 2_000_000_000])
def test_a_capture_whose_clock_was_set_back_is_refused(back_ns: int) -> None:
    sent, arrived = on_leg(0), on_leg(5_000_000, LOST)
    late = [packet._replace(t_ns=packet.t_ns - back_ns * (k >= 150)) for k, packet in enumerate(arrived)]
    for files, options in (
        ([pcap_of(*sent), pcap_of(*late)], {}),
        ([pcap_of(*late)], {"sequence_at": SequenceField(2, 4, False)}),
    ):
        with pytest.raises(ValueError, match=r"packet 151 is .* the clock was set back"):
            trace_of(*files, **options)


@pytest.mark.parametrize("at", [30, 150, 280])
@pytest.mark.parametrize("step_ns", [200_000_000, 3_600_000_000_000])
def test_without_a_steady_clock_delays_are_not_known(at: int, step_ns: int) -> None:
    sent, arrived = on_leg(0), on_leg(5_000_000)
    ahead = [packet._replace(t_ns=packet.t_ns + step_ns * (k >= at)) for k, packet in enumerate(arrived)]
    lost = [packet for k, packet in enumerate(ahead) if k not in LOST]
    for files, options in (
        ([pcap_of(*sent), pcap_of(*lost)], {}),
        ([pcap_of(*lost)], {"sequence_at": SequenceField(2, 4, False)}),
    ):
        trace = trace_of(*files, **options)
        assert f"changes by {step_ns / 1e6:+.1f} ms" in trace.delays_unknown
        assert trace.lost.sum() == len(LOST)
        measured = NetworkMeasurement(trace)
        assert measured.bursts.losses == trace.lost.sum()
        assert measured.delays.received == 0
        with pytest.raises(CallerError, match=r"deadline .* needs delays"):
            NetworkMeasurement(trace, MeasurementOptions(deadline_s=0.1))
    assert not trace_of(pcap_of(*sent), pcap_of(*lost), clocks_differ=False).delays_unknown


# --- the legs of a host that forwards ---------------------------------------------------------------

COUNT = 300
LOST = [3, 7, 8, 150, 290]


def rtp(k: int, size_bytes: int = 40) -> bytes:
    """Return a payload with its number in the bytes 2 to 5."""
    return b"\x80\x01" + struct.pack(">I", k) + random.Random(k).randbytes(size_bytes - 6)


def on_leg(delay_ns: int, lost: Container[int] = (), **changes: object) -> list[Sent]:
    sent = [Sent(T_NS + k * CAPTURE_PERIOD_NS + delay_ns, rtp(k)) for k in range(COUNT) if k not in lost]
    return [packet._replace(**changes) for packet in sent]  # type: ignore[arg-type]


IN_AND_OUT = {
    "cooked, version 2": (COOKED_2, {"interface": 2, "direction": 1}, {"interface": 3, "direction": 2}),
    "cooked": (COOKED, {"direction": 1}, {"direction": 2}),
    "VLAN": (ETHERNET, {"vlans": (7,)}, {"vlans": (8,)}),
    "VLAN in cooked": (COOKED, {"vlans": (7,)}, {"vlans": (8,)}),
    "VLAN in cooked, version 2": (COOKED_2, {"vlans": (7, 1)}, {"vlans": (7, 2)}),
    "one of two has a VLAN": (ETHERNET, {}, {"vlans": (8,)}),
}


@pytest.mark.parametrize("name", IN_AND_OUT)
@pytest.mark.parametrize("sequence_at", [None, SequenceField(2, 4, False)])
def test_a_host_that_forwards_shows_both_ends(name: str, sequence_at: SequenceField | None) -> None:
    link_type, inside, outside = IN_AND_OUT[name]
    lost = [*LOST, COUNT - 1]
    packets = sorted([*on_leg(0, **inside), *on_leg(500_000, lost, **outside)])
    for file in (
        pcap_of(*packets, link_type=link_type),
        pcapng_of(*packets, link_type=link_type, interfaces=4),
    ):
        trace = trace_of(file, sequence_at=sequence_at)
        assert np.flatnonzero(trace.lost).tolist() == lost
        assert set(trace.delay_ns[~trace.lost].tolist()) == {500_000}


def test_numbers_that_are_missing_on_the_first_leg_are_lost_too() -> None:
    packets = [
        *on_leg(0, [20, 21], interface=2, direction=1),
        *on_leg(9, [20, 21, 30], interface=3, direction=2),
    ]
    file = pcap_of(*sorted(packets), link_type=COOKED_2)
    field = SequenceField(2, 4, False)
    assert np.flatnonzero(trace_of(file, sequence_at=field).lost).tolist() == [20, 21, 30]
    assert np.flatnonzero(trace_of(file, sequence_at=field, far_flow=1).lost).tolist() == [20, 21]
    alone = trace_of(file, sequence_at=field, flow=2, far_flow=2)
    assert np.flatnonzero(alone.lost).tolist() == [20, 21, 30]


# --- what a capture does not show -------------------------------------------------------------------


def network_of(size_bytes: int, source: str = "192.0.2.1", count: int = COUNT) -> list[Sent]:
    destination = "2001:db8::7" if ":" in source else "198.51.100.7"
    return [
        Sent(T_NS + k * CAPTURE_PERIOD_NS, rtp(k, size_bytes), source, 5000, destination)
        for k in range(count)
    ]


def parts_of(packets: list[Sent], most: int, link_type: int = ETHERNET) -> list[tuple[int, bytes]]:
    """Return packets in fragments, with their times."""
    return [
        (packet.t_ns + place, part)
        for k, packet in enumerate(packets)
        for place, part in enumerate(fragments_of(packet, link_type, k % 2**16, most))
    ]


@pytest.mark.parametrize("source", ["192.0.2.1", "2001:db8::1"])
@pytest.mark.parametrize("link_type", [ETHERNET, COOKED, LOOPBACK])
def test_fragments_are_put_together(source: str, link_type: int) -> None:
    sent = network_of(3000, source)
    arrived = [packet for k, packet in enumerate(sent) if k not in LOST]
    parts = parts_of(arrived, 1480, link_type)
    for k in range(0, len(parts) - 3, 3):
        parts[k : k + 3] = random.Random(k).sample(parts[k : k + 3], 3)
    parts[36:36] = [(parts[35][0], part) for _, part in parts[30:36]]  # duplicates
    whole = pcap_of(*sent, link_type=link_type)
    for sender in (whole, pcap_of_packets(parts_of(sent, 1400, link_type), link_type)):
        trace = trace_of(sender, pcap_of_packets(parts, link_type))
        assert np.flatnonzero(trace.lost).tolist() == LOST
    # A datagram of which a fragment is missing has not arrived.
    trace = trace_of(whole, pcap_of_packets(parts[:46] + parts[47:], link_type))
    assert np.flatnonzero(trace.lost).tolist() == sorted([*LOST, 3 + 40 // 3])
    assert any("fragments are missing: 1" in line for line in trace.notes)


@pytest.mark.parametrize("source", ["192.0.2.1", "2001:db8::1"])
def test_first_fragments_suffice_if_a_filter_has_left_out_the_others(source: str) -> None:
    sent = network_of(3000, source)
    arrived = [packet for k, packet in enumerate(sent) if k not in LOST]
    first = [
        pcap_of_packets(
            [(packet.t_ns, fragments_of(packet, ETHERNET, k, 1480)[0]) for k, packet in side], ETHERNET
        )
        for side in (enumerate(sent), enumerate(arrived))
    ]
    for sender in (first[0], pcap_of(*sent, link_type=ETHERNET)):
        trace = trace_of(sender, first[1])
        assert np.flatnonzero(trace.lost).tolist() == LOST
        assert any("first fragment only" in line for line in trace.notes)


@pytest.mark.parametrize("link_type", LINKS)
@pytest.mark.parametrize("snap_bytes", [80, 200])
def test_datagrams_that_are_cut_are_compared_as_far_as_they_go(link_type: int, snap_bytes: int) -> None:
    sent = [
        packet._replace(payload=packet.payload[: 40 + k % 400]) for k, packet in enumerate(network_of(500))
    ]
    arrived = [packet for k, packet in enumerate(sent) if k not in LOST]
    whole = pcap_of(*sent, link_type=link_type), pcap_of(*arrived, link_type=link_type)
    cut = [pcap_of(*side, link_type=link_type, snap_bytes=snap_bytes) for side in (sent, arrived)]
    for files in ((whole[0], cut[1]), (cut[0], cut[1]), (cut[0], whole[1])):
        trace = trace_of(*files)
        assert np.flatnonzero(trace.lost).tolist() == LOST
        assert any("cut by the snap length" in line for line in trace.notes)
    trace = trace_of(cut[1], sequence_at=SequenceField(2, 4, False))
    assert np.flatnonzero(trace.lost).tolist() == LOST


def merged(packets: list[Sent], groups: int) -> list[Sent]:
    """Return packets in groups of equal datagrams, as the kernel merges them."""
    return [
        packets[k + len(packets[k : k + groups]) - 1]._replace(
            payload=b"".join(packet.payload for packet in packets[k : k + groups])
        )
        for k in range(0, len(packets), groups)
    ]


@pytest.mark.parametrize("groups", [2, 3, 7])
def test_datagrams_that_the_kernel_merged_are_divided(groups: int) -> None:
    sent = network_of(400)
    arrived = [packet for k, packet in enumerate(sent) if k not in LOST]
    half = arrived[:100] + merged(arrived[100:], groups)
    for receiver in (half, merged(arrived, groups)):
        trace = trace_of(pcap_of(*sent), pcap_of(*receiver))
        assert np.flatnonzero(trace.lost).tolist() == LOST
        trace = trace_of(pcap_of(*receiver), sequence_at=SequenceField(2, 4, False))
        assert np.flatnonzero(trace.lost).tolist() == LOST
    # A sender that hands many datagrams over at once.
    trace = trace_of(pcap_of(*merged(sent, groups)), pcap_of(*arrived))
    assert np.flatnonzero(trace.lost).tolist() == LOST


@pytest.mark.parametrize("order", ["<", ">"])
def test_packets_that_the_capture_dropped_are_not_lost_in_the_network(order: str) -> None:
    sent = on_leg(0)
    few = pcapng_of(*on_leg(5, [8, 9]), order=order, dropped=2)
    many = pcapng_of(*on_leg(5, range(10, 20)), order=order, dropped=10)
    between = pcapng_of(*on_leg(5, range(10, 20)), order=order, dropped_before=1)
    for files, options in (
        ((pcap_of(*sent), few), {}),
        ((few,), {"sequence_at": SequenceField(2, 4, False)}),
    ):
        trace = trace_of(*files, **options)
        assert np.flatnonzero(trace.lost).tolist() == [8, 9]
        assert any(
            "up to 2 of the 2 lost packets were not lost in the network" in line for line in trace.notes
        )
    for file in (many, between):
        with pytest.raises(ValueError, match="the capture itself dropped"):
            trace_of(pcap_of(*sent), file)
        with pytest.raises(ValueError, match="the capture itself dropped"):
            trace_of(file, sequence_at=SequenceField(2, 4, False))
    # Where nothing is missing, it does not matter what was dropped.
    assert not trace_of(pcap_of(*sent), pcapng_of(*on_leg(5), dropped=50)).lost.any()


# --- formats ----------------------------------------------------------------------------------------
families = st.one_of(
    *(
        st.builds(
            Sent,
            t_ns=st.integers(0, 2**32 * 10**9 - 1),
            payload=st.binary(max_size=30),
            source=st.ip_addresses(v=version).map(str),
            destination=st.ip_addresses(v=version).map(str),
            source_port=st.integers(0, 65_535),
            destination_port=st.integers(0, 65_535),
            interface=st.just(0),
            direction=st.just(0),
            hardware=st.just(1),
        )
        for version in (4, 6)
    )
)


def read(data: bytes) -> Iterator[CapturedDatagram]:
    reader = DatagramReader()
    yield from reader.read(captured_packets(io.BytesIO(data)))
    yield from reader.rest()


@given(
    st.lists(families, max_size=4), st.sampled_from(LINKS), st.sampled_from("<>"),
    st.lists(st.integers(0, 4095), max_size=3), st.sampled_from(["pcap", "micro", "pcapng"]),
)  # fmt: skip
def test_every_datagram_is_found_again(
    sent: list[Sent], link_type: int, order: str, vlans: list[int], form: str
) -> None:
    has_vlans = link_type in (ETHERNET, COOKED, COOKED_2)
    sent = [packet._replace(vlans=tuple(vlans) if has_vlans else ()) for packet in sent]
    if form == "pcapng":
        data = pcapng_of(*sent, link_type=link_type, order=order)
    else:
        data = pcap_of(*sent, link_type=link_type, order=order, nano=form == "pcap")
    for expected, datagram in zip(sent, read(data), strict=True):
        assert datagram.t_ns == (expected.t_ns // 1000 * 1000 if form == "micro" else expected.t_ns)
        assert datagram.payload == expected.payload
        assert not datagram.is_cut
        source = f"[{expected.source}]" if ":" in expected.source else expected.source
        destination = f"[{expected.destination}]" if ":" in expected.destination else expected.destination
        leg = "interface 0" + "".join(f", VLAN {vlan}" for vlan in expected.vlans)
        leg += ", incoming" if link_type in (COOKED, COOKED_2) else ""
        assert str(datagram.flow) == (
            f"{source}:{expected.source_port} → {destination}:{expected.destination_port} on {leg}"
        )


def test_captures_that_do_not_show_what_was_lost_are_refused() -> None:
    sent, arrived, _ = network()
    same = [packet._replace(payload=b"same") for packet in sent]
    for files, message in (
        ([pcap_of(*same), pcap_of(*arrived)], "199 of 200 datagrams have the payload of another"),
        ([pcap_of(*sent), pcap_of(*same)], "none of the datagrams"),
        ([pcap_of(*sent, snap_bytes=30)], "has one end only"),
        ([pcap_of(*sent)], "has one end only"),
        ([pcap_of()], "has no UDP datagrams"),
        ([pcap_of(*sent, link_type=101)[:-3]], "has one end only"),
        ([b"\n\r\r\n\0\0\0\0"], "has no UDP datagrams: the capture is cut off before the end"),
    ):
        with pytest.raises(ValueError, match=message):
            trace_of(*files)


def test_captures_in_the_wrong_order_are_refused() -> None:
    sender, receiver = pcap_of(*on_leg(0)), pcap_of(*on_leg(9, LOST))
    assert trace_of(sender, receiver).lost.sum() == len(LOST)
    with pytest.raises(ValueError, match="wrong order"):
        trace_of(receiver, sender)
    # With duplicates, too.
    arrived = on_leg(9, LOST)
    twice = sorted([*arrived, *(packet._replace(t_ns=packet.t_ns + 50) for packet in arrived[::5])])
    with pytest.raises(ValueError, match="wrong order"):
        trace_of(pcap_of(*twice), sender)
    twice = sorted([*on_leg(0), *(packet._replace(t_ns=packet.t_ns + 50) for packet in on_leg(0)[::5])])
    with pytest.raises(ValueError, match=r"payload of another one.*wrong order"):
        trace_of(pcap_of(*twice), sender)
    # Fewer than 1 % may be a gap in the sender's capture.
    assert any("wrong order" in line for line in trace_of(pcap_of(*on_leg(9, [7, 8])), sender).notes)
