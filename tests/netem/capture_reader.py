"""Batches of events; a strict reader of pcapng (draft-ietf-opsawg-pcapng) and of UDP over IP."""

import ipaddress
import random
import struct
from typing import Any, NamedTuple

import numpy as np
from hypothesis import strategies as st

from netem.capture import Interface, PcapngSection
from netem.relay.relay_links import LinkSpec
from netem.relay.relay_reports import EVENT, Bytes, Events
from noack.impairments.link_settings import LinkSettings

T_NS = 1_767_225_600_123_456_789
SPECS = [
    LinkSpec("link0", ("127.0.0.1", 1), ("127.0.0.1", 2), LinkSettings(), LinkSettings())
]  # fmt: skip
INTERFACES = (Interface("link0 client", "127.0.0.1:1"), Interface("link0 server", "127.0.0.1:2"))
USUAL: dict[str, Any] = {
    "t_ns": T_NS, "family": 4, "source_port": 40_001, "destination_port": 40_002,
    "source": "192.0.2.1", "destination": "198.51.100.7", "flow": 3, "packet": 17,
    "mansd": -1, "bit": -1, "payload": b"payload",
}  # fmt: skip

i64 = st.integers(0, 2**63 - 1)
SHARED = {
    "t_ns": i64, "interface": st.integers(0, 1), "departure": st.integers(0, 1),
    "direction": st.integers(0, 1), "fate": st.integers(0, 5), "copy": st.integers(0, 1),
    "stale": st.integers(0, 1), "source_port": st.integers(0, 65_535),
    "destination_port": st.integers(0, 65_535), "flow": i64, "packet": i64,
    "consecutive_losses": i64,
    "mansd": st.integers(-1, 2**63 - 1), "delay_ns": i64, "hold_back_ns": i64,
    "bit": st.integers(-1, 2**63 - 1),
}  # fmt: skip


def of_family(family: int) -> st.SearchStrategy[dict[str, Any]]:
    addresses = st.ip_addresses(v=family).map(str)
    large = st.builds(
        lambda size, seed: random.Random(seed).randbytes(size),
        st.integers(0, 65_507),
        st.integers(0, 9),
    )
    return st.fixed_dictionaries(
        SHARED
        | {
            "family": st.just(family), "source": addresses, "destination": addresses,
            "payload": st.binary(max_size=40) | large,
        }
    )  # fmt: skip


events = of_family(4) | of_family(6)


def batch(*described: dict[str, Any]) -> tuple[Events, Bytes]:
    """Return events with these fields, payloads and addresses; other fields have default values."""
    table = np.zeros(len(described), EVENT)
    data = b"other bytes"
    for row, given in zip(table, described, strict=True):
        fields = USUAL | given
        payload = fields.pop("payload")
        row["size_bytes"], row["offset"] = len(payload), len(data)
        data += payload
        for name, value in fields.items():
            if isinstance(value, str):
                packed = ipaddress.ip_address(value).packed
                row[name][: len(packed)] = list(packed)
            else:
                row[name] = value
    return table, np.frombuffer(data, np.uint8)


def file_of(*described: dict[str, Any]) -> bytes:
    """Return a whole capture file."""
    section = PcapngSection(INTERFACES)
    return section.header() + bytes(section.packets(*batch(*described))) + section.statistics()


Options = dict[int, list[bytes]]


class Packet(NamedTuple):
    interface: int
    t_ns: int
    original_bytes: int
    frame: bytes
    options: Options

    @property
    def comment(self) -> str:
        (comment,) = self.options[1]
        return comment.decode()


class File(NamedTuple):
    section: Options
    interfaces: list[tuple[int, int, Options]]
    """Link type, snap length, options."""
    packets: list[Packet]
    statistics: dict[int, tuple[int, Options]]
    """By interface: time, options."""


class Datagram(NamedTuple):
    source: str
    destination: str
    source_port: int
    destination_port: int
    payload: bytes


def padded(data: bytes, at: int, size: int) -> tuple[bytes, int]:
    end, rest = at + size, -size % 4
    assert data[end : end + rest] == bytes(rest)
    assert end + rest <= len(data)
    return data[at:end], end + rest


def options(data: bytes) -> Options:
    values_by_code: Options = {}
    at, code = 0, -1
    while code != 0:
        code, size = struct.unpack_from("<HH", data, at)
        value, at = padded(data, at + 4, size)
        values_by_code.setdefault(code, []).append(value)
    assert values_by_code.pop(0) == [b""]
    assert at == len(data)
    return values_by_code


def read(data: bytes) -> File:
    file = File({}, [], [], {})
    at = 0
    while at < len(data):
        kind, size = struct.unpack_from("<II", data, at)
        assert size % 4 == 0
        assert (kind == 0x0A0D0D0A) == (at == 0), "one section"
        body = data[at + 8 : at + size - 4]
        at += size
        assert struct.unpack_from("<I", data, at - 4) == (size,)
        if kind == 0x0A0D0D0A:
            assert struct.unpack_from("<IHHq", body) == (0x1A2B3C4D, 1, 0, -1)
            file.section.update(options(body[16:]))
        elif kind == 1:
            link_type, reserved, snap = struct.unpack_from("<HHI", body)
            assert reserved == 0
            file.interfaces.append((link_type, snap, options(body[8:])))
        elif kind == 6:
            index, high, low, captured, original = struct.unpack_from("<IIIII", body)
            assert captured <= min(original, file.interfaces[index][1])
            frame, end = padded(body, 20, captured)
            packet = Packet(index, high << 32 | low, original, frame, options(body[end:]))
            file.packets.append(packet)
        else:
            assert kind == 5
            index, high, low = struct.unpack_from("<III", body)
            file.statistics[index] = (high << 32 | low, options(body[12:]))
    assert at == len(data)
    return file


def ones_complement(data: bytes) -> int:
    """Return the RFC 1071 sum; it is 0xffff if the data contain their correct checksum."""
    words = int.from_bytes(data + bytes(len(data) % 2), "big")
    return (words - 1) % 0xFFFF + 1 if words else 0


def datagram(frame: bytes) -> Datagram:
    """Return the datagram in a frame; its checksums must be correct."""
    if frame[0] >> 4 == 4:
        *constant, hops, protocol, _ = struct.unpack_from(">HHHHBBH", frame)
        assert constant == [0x4500, len(frame), 0, 0x4000]
        assert ones_complement(frame[:20]) == 0xFFFF
        addresses, udp = frame[12:20], frame[20:]
    else:
        word, total, protocol, hops = struct.unpack_from(">IHBB", frame)
        assert (word, total) == (6 << 28, len(frame) - 40)
        addresses, udp = frame[8:40], frame[40:]
    assert protocol == 17
    assert hops > 1
    source_port, destination_port, size, checksum = struct.unpack_from(">HHHH", udp)
    assert size == len(udp)
    assert checksum != 0
    pseudo = addresses + struct.pack(">IHH", size, 0, 17)
    assert ones_complement(pseudo + udp) == 0xFFFF
    half = len(addresses) // 2
    source, destination = (ipaddress.ip_address(address) for address in (addresses[:half], addresses[half:]))
    return Datagram(str(source), str(destination), source_port, destination_port, udp[8:])
