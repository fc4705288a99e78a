"""A strict reader of pcapng (draft-ietf-opsawg-pcapng) and of UDP over IP."""

import ipaddress
import struct
from collections.abc import Iterator
from dataclasses import dataclass

Options = dict[int, list[bytes]]


@dataclass(frozen=True)
class Packet:
    interface: int
    t_ns: int
    original_bytes: int
    frame: bytes
    options: Options

    @property
    def comment(self) -> str:
        (comment,) = self.options[1]
        return comment.decode()


@dataclass(frozen=True)
class File:
    section: Options
    interfaces: list[tuple[int, int, Options]]
    """Link type, snap length, options."""
    packets: list[Packet]
    statistics: dict[int, tuple[int, Options]]
    """By interface: time, options."""


@dataclass(frozen=True)
class Datagram:
    source: str
    destination: str
    source_port: int
    destination_port: int
    payload: bytes


def blocks(data: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at < len(data):
        kind, size = struct.unpack_from("<II", data, at)
        assert size % 4 == 0
        assert struct.unpack_from("<I", data, at + size - 4) == (size,)
        yield kind, data[at + 8 : at + size - 4]
        at += size
    assert at == len(data)


def padded(data: bytes, at: int, size: int) -> tuple[bytes, int]:
    end = at + size
    rest = -size % 4
    assert data[end : end + rest] == bytes(rest)
    assert end + rest <= len(data)
    return data[at:end], end + rest


def options(data: bytes) -> Options:
    found: Options = {}
    at = 0
    while True:
        code, size = struct.unpack_from("<HH", data, at)
        value, at = padded(data, at + 4, size)
        if code == 0:
            assert size == 0
            assert at == len(data)
            return found
        found.setdefault(code, []).append(value)


def read(data: bytes) -> File:
    section: Options | None = None
    file = File({}, [], [], {})
    for kind, body in blocks(data):
        if kind == 0x0A0D0D0A:
            assert section is None, "one section"
            assert struct.unpack_from("<IHHq", body) == (0x1A2B3C4D, 1, 0, -1)
            section = options(body[16:])
            file.section.update(section)
        elif kind == 1:
            link_type, reserved, snap = struct.unpack_from("<HHI", body)
            assert reserved == 0
            file.interfaces.append((link_type, snap, options(body[8:])))
        elif kind == 6:
            index, high, low, captured, original = struct.unpack_from("<IIIII", body)
            assert captured <= min(original, file.interfaces[index][1])
            frame, at = padded(body, 20, captured)
            t_ns = high << 32 | low
            file.packets.append(Packet(index, t_ns, original, frame, options(body[at:])))
        else:
            assert kind == 5
            index, high, low = struct.unpack_from("<III", body)
            file.statistics[index] = (high << 32 | low, options(body[12:]))
    assert section is not None
    return file


def ones_complement(data: bytes) -> int:
    """Return the RFC 1071 sum; it is 0xffff if the data contain their correct checksum."""
    words = int.from_bytes(data + bytes(len(data) % 2), "big")
    return (words - 1) % 0xFFFF + 1 if words else 0


def datagram(frame: bytes) -> Datagram:
    """Return the datagram in a frame; its checksums must be correct."""
    version = frame[0] >> 4
    if version == 4:
        first, tos, total, ident, fragment, hops, protocol, _ = struct.unpack_from(
            ">BBHHHBBH", frame
        )
        assert (first, tos, ident, fragment, protocol) == (0x45, 0, 0, 0x4000, 17)
        assert total == len(frame)
        assert ones_complement(frame[:20]) == 0xFFFF
        addresses, udp = frame[12:20], frame[20:]
    else:
        word, total, protocol, hops = struct.unpack_from(">IHBB", frame)
        assert (word, protocol) == (6 << 28, 17)
        assert total == len(frame) - 40
        addresses, udp = frame[8:40], frame[40:]
    assert hops > 1
    source_port, destination_port, size, checksum = struct.unpack_from(">HHHH", udp)
    assert size == len(udp)
    assert checksum != 0
    pseudo = addresses + struct.pack(">IHH", size, 0, 17)
    assert ones_complement(pseudo + udp) == 0xFFFF
    half = len(addresses) // 2
    source = str(ipaddress.ip_address(addresses[:half]))
    destination = str(ipaddress.ip_address(addresses[half:]))
    return Datagram(source, destination, source_port, destination_port, udp[8:])
