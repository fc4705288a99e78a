"""Packet traces from captures, against the losses and delays that the test chose."""

import io
import random
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from noack.protocol.probe_format import ProbeDatagram, ProbeKind, encode_probe
from noack.traces.capture_packets import CapturedFlow, captured_packets, find_udp
from noack.traces.capture_trace import CaptureOptions, SequenceField, read_captures
from noack.traces.packet_trace import PacketTrace
from tests.oracles.capture_files import LINKS, Sent, pcap_of, pcapng_of

T_NS, PERIOD_NS = 1_700_000_000 * 10**9, 20_000_000
AT_SERVER = {"source": "10.0.0.9", "source_port": 7000, "destination": "10.0.0.2", "interface": 1}


def trace_of(*files: bytes, **options: object) -> PacketTrace:
    return read_captures(list(map(io.BytesIO, files)), CaptureOptions(**options))  # type: ignore[arg-type]


def network(count: int = 200, seed: int = 1) -> tuple[list[Sent], list[Sent], dict[int, int]]:
    """Return what is sent and what arrives (lost, reordered, duplicated), and the delays."""
    rng = random.Random(seed)
    sent = [Sent(T_NS + k * PERIOD_NS, struct.pack(">Q", k)) for k in range(count)]
    delays = {k: rng.randrange(5 * PERIOD_NS) + 1 for k in range(count) if rng.random() > 0.3}
    arrived = [sent[k]._replace(t_ns=sent[k].t_ns + delay) for k, delay in delays.items()]
    arrived += [one._replace(t_ns=one.t_ns + 10**9) for one in arrived[::7]]
    return sent, sorted(arrived), delays


def delays_in(trace: PacketTrace) -> dict[int, int]:
    return {int(k): int(delay) for k, delay in enumerate(trace.delay_ns) if delay >= 0}


@pytest.mark.parametrize("offset_ns", [0, 10**12, -(10**12)])
def test_two_captures_give_the_losses_and_relative_delays(offset_ns: int) -> None:
    sent, arrived, delays = network()
    other = Sent(T_NS, b"other")._replace(destination_port=53)
    shifted = [one._replace(t_ns=one.t_ns + offset_ns, **AT_SERVER) for one in arrived]
    trace = trace_of(pcap_of(other, *sent), pcapng_of(*shifted))
    smallest = min(delays.values())
    assert delays_in(trace).keys() == delays.keys()
    # The drift of so short a record is small against its delays, but not exactly 0.
    for k, delay_ns in delays_in(trace).items():
        assert abs(delay_ns - (delays[k] - smallest)) < 500e-6 * 200 * PERIOD_NS + 2
    assert any("--flow chooses" in line for line in trace.notes)
    if offset_ns == 0:
        assert (
            delays_in(trace_of(pcap_of(*sent), pcapng_of(*shifted), clocks_differ=False)) == delays
        )


def test_one_capture_of_both_ends_is_matched_in_the_right_direction() -> None:
    sent, arrived, delays = network()
    forwarded = [one._replace(**AT_SERVER) for one in arrived]
    # An echo with the same payloads goes back over both interfaces.
    back = {"source": "198.51.100.7", "source_port": 6000, "destination": "192.0.2.1"}
    echoes = [one._replace(t_ns=one.t_ns + 5, destination_port=5000, **back) for one in arrived]
    trace = trace_of(pcapng_of(*sorted([*sent, *forwarded, *echoes])))
    assert delays_in(trace) == delays


def test_numbers_at_a_known_place_that_wrap_around() -> None:
    period_ns = 20_000_137
    arrivals = [
        Sent(
            T_NS + k * period_ns + (k % 10) * 10**6, b"xx" + struct.pack("<H", (65_500 + k) % 2**16)
        )
        for k in range(200) if k % 5
    ]  # fmt: skip
    arrivals[3], arrivals[4] = arrivals[4], arrivals[3]
    trace = trace_of(
        pcap_of(*arrivals, b_short := Sent(T_NS, b"")),
        sequence_at=SequenceField.parse("2:2:little"),
    )
    assert b_short.payload == b""
    lost = [k % 5 == 0 for k in range(1, 200)]
    assert trace.lost.tolist() == lost
    expected = np.array([(k % 10 - 1) * 10**6 for k in range(1, 200)])
    assert np.abs(trace.delay_ns - expected)[~trace.lost].max() < 1000
    assert "20.0001 ms" in " ".join(trace.notes)


def probes(count: int) -> list[Sent]:
    return [
        Sent(
            T_NS + k * PERIOD_NS + k % 3,
            encode_probe(
                ProbeDatagram(ProbeKind.PROBE, 7, 0, k, k * PERIOD_NS, 0, PERIOD_NS, count), 150
            ),
        )
        for k in range(count)
    ]


def test_a_probe_captured_at_the_receiver_has_its_sending_times() -> None:
    arrived = [one for k, one in enumerate(probes(100)) if k % 4]
    end = Sent(T_NS, encode_probe(ProbeDatagram(ProbeKind.END, 7, 0, 100, 0, 0, PERIOD_NS, 100)))
    trace = trace_of(pcap_of(end, *arrived, end))
    assert len(trace) == 99
    assert trace.lost.tolist() == [k % 4 == 0 for k in range(1, 100)]
    assert trace.delay_ns.max() <= 2


def test_a_capture_of_the_sender_alone_is_refused() -> None:
    with pytest.raises(ValueError, match="sender's end only"):
        trace_of(pcapng_of(*(one._replace(direction=2) for one in probes(9))))


def test_captures_that_do_not_say_what_was_lost() -> None:
    sent, arrived, _ = network()
    same = [one._replace(payload=b"same") for one in sent]
    for files, message in (
        ([pcap_of(*same), pcap_of(*arrived)], "199 of 200 datagrams have the payload of another"),
        ([pcap_of(*sent), pcap_of(*same)], "none of the complete datagrams"),
        ([pcap_of(*sent, snap_bytes=30)], "no datagrams of `noack measure`"),
        ([pcap_of(*sent)], "has one end only"),
        ([pcap_of()], "has no UDP datagrams"),
        ([pcap_of(*sent, link_type=101)[:-3]], "has one end only"),
        ([b"\n\r\r\n\0\0\0\0"], "has no UDP datagrams: the capture is cut off before the end"),
    ):
        with pytest.raises(ValueError, match=message):
            trace_of(*files)


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
        )
        for version in (4, 6)
    )
)


def read(data: bytes) -> list[tuple[int, CapturedFlow, bytes, bool]]:
    found = []
    for packet in captured_packets(io.BytesIO(data)):
        datagram = find_udp(packet.interface, packet.link_type, packet.data)
        assert datagram is not None
        found.append((packet.t_ns, *datagram))
    return found


@given(
    st.lists(families, max_size=4), st.sampled_from(LINKS), st.sampled_from("<>"),
    st.integers(0, 2), st.sampled_from(["pcap", "micro", "pcapng"]),
)  # fmt: skip
def test_every_datagram_is_found_again(
    sent: list[Sent], link_type: int, order: str, vlans: int, form: str
) -> None:
    if form == "pcapng":
        data = pcapng_of(*sent, link_type=link_type, order=order, vlans=vlans)
    else:
        data = pcap_of(*sent, link_type=link_type, order=order, vlans=vlans, nano=form == "pcap")
    for one, (t_ns, flow, payload, is_complete) in zip(sent, read(data), strict=True):
        assert t_ns == (one.t_ns // 1000 * 1000 if form == "micro" else one.t_ns)
        assert payload == one.payload
        assert is_complete
        source = f"[{one.source}]" if ":" in one.source else one.source
        destination = f"[{one.destination}]" if ":" in one.destination else one.destination
        assert str(flow) == (
            f"{source}:{one.source_port} → {destination}:{one.destination_port} on interface 0"
        )


def test_a_block_that_is_too_short_is_named_in_plain_words() -> None:
    section = bytes.fromhex("0a0d0d0a 1c000000 4d3c2b1a 0100 0000 ffffffffffffffff 1c000000")
    with pytest.raises(ValueError, match=r"^after packet 0: a block is too short"):
        list(captured_packets(io.BytesIO(section + bytes.fromhex("06000000 0c000000 0c000000"))))
