"""The reader of captures finds what an independent writer wrote; tshark agrees."""

import io
import random
import shutil
import subprocess
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from noack.traces.capture_packets import CapturedFlow, captured_packets, find_udp
from tests.noack.traces.capture_files import LINKS, Sent, pcap_of, pcapng_of

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


@pytest.mark.parametrize("link_type", [link for link in LINKS if link != 0])
def test_tshark_finds_the_same_datagrams(link_type: int, tmp_path: Path) -> None:
    if shutil.which("tshark") is None:
        pytest.skip("needs tshark")
    rng = random.Random(1)
    sent = [
        Sent(10**18 + rng.randrange(10**12), rng.randbytes(rng.randrange(1, 60))) for _ in range(20)
    ]
    sent += [one._replace(source="2001:db8::1", destination="2001:db8::2") for one in sent[:5]]
    path = tmp_path / "a.pcap"
    path.write_bytes(pcap_of(*sent, link_type=link_type, vlans=link_type == 1))
    names = ("frame.time_epoch", "ip.src", "ipv6.src", "udp.srcport", "udp.payload")
    fields = [word for name in names for word in ("-e", name)]
    # tshark must not take the payloads for another protocol.
    command = ["tshark", "-r", str(path), "-T", "fields", "-d", "udp.port==5000,data", *fields]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    found = [line.split("\t") for line in lines]
    for (time, v4, v6, port, payload), (t_ns, flow, data, _) in zip(
        found, read(path.read_bytes()), strict=True
    ):
        assert time.replace(".", "") == str(t_ns)
        assert str(flow).startswith(f"{v4 or f'[{v6}]'}:{port} ")
        assert payload == data.hex()


def test_a_block_that_is_too_short_is_named_in_plain_words() -> None:
    section = bytes.fromhex("0a0d0d0a 1c000000 4d3c2b1a 0100 0000 ffffffffffffffff 1c000000")
    with pytest.raises(ValueError, match=r"^after packet 0: a block is too short"):
        list(captured_packets(io.BytesIO(section + bytes.fromhex("06000000 0c000000 0c000000"))))
