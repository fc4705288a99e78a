"""Writes captures of UDP datagrams by the RFCs and drafts, independently of the reader."""

import struct
from ipaddress import ip_address
from typing import NamedTuple

ETHERNET, LOOPBACK, RAW, COOKED, COOKED_2 = 1, 0, 101, 113, 276
LINKS = (ETHERNET, LOOPBACK, RAW, COOKED, COOKED_2)


class Sent(NamedTuple):
    """A datagram to be written."""

    t_ns: int
    payload: bytes
    source: str = "192.0.2.1"
    source_port: int = 5000
    destination: str = "198.51.100.7"
    destination_port: int = 6000
    interface: int = 0
    direction: int = 0
    """1 inbound, 2 outbound."""


def packet_of(sent: Sent, link_type: int = RAW, vlans: int = 0) -> bytes:
    """Return the packet with the header of a link type."""
    ends = ip_address(sent.source), ip_address(sent.destination)
    hosts = b"".join(end.packed for end in ends)
    size = 8 + len(sent.payload)
    udp = struct.pack(">HHHH", sent.source_port, sent.destination_port, size, 0) + sent.payload
    if ends[0].version == 4:
        kind = b"\x08\x00"
        ip = struct.pack(">BBHHHBBH", 0x45, 0, 20 + size, 0, 0x4000, 64, 17, 0) + hosts + udp
    else:
        kind = b"\x86\xdd"
        hop_by_hop = bytes([17, 0, 1, 4, 0, 0, 0, 0])  # PadN
        ip = struct.pack(">IHBB", 6 << 28, 8 + size, 0, 64) + hosts + hop_by_hop + udp
    tags = b"\x81\x00\x00\x07" * vlans
    header = {
        ETHERNET: bytes(12) + tags + kind,
        LOOPBACK: struct.pack("=I", 2 if ends[0].version == 4 else 10),
        RAW: b"",
        COOKED: bytes(14) + kind,
        COOKED_2: kind + bytes(18),
    }[link_type]
    trailer = bytes(4) if link_type == ETHERNET else b""
    return header + ip + trailer


def pcap_of(
    *datagrams: Sent, link_type: int = RAW, order: str = "<", nano: bool = True, vlans: int = 0,
    snap_bytes: int = 262_144,
) -> bytes:  # fmt: skip
    """Return a pcap file."""
    magic, unit_ns = (0xA1B23C4D, 1) if nano else (0xA1B2C3D4, 1000)
    parts = [struct.pack(f"{order}IHHiIII", magic, 2, 4, 0, 0, snap_bytes, link_type)]
    for datagram in datagrams:
        packet = packet_of(datagram, link_type, vlans)
        seconds, rest_ns = divmod(datagram.t_ns, 10**9)
        cut = packet[:snap_bytes]
        parts += [
            struct.pack(f"{order}IIII", seconds, rest_ns // unit_ns, len(cut), len(packet)), cut
        ]  # fmt: skip
    return b"".join(parts)


def pcapng_of(
    *datagrams: Sent, link_type: int = RAW, order: str = "<", vlans: int = 0, interfaces: int = 2
) -> bytes:
    """Return a pcapng file with times in nanoseconds."""

    def block(kind: int, body: bytes) -> bytes:
        body += bytes(-len(body) % 4)
        size = struct.pack(f"{order}I", len(body) + 12)
        return struct.pack(f"{order}I", kind) + size + body + size

    resolution = struct.pack(f"{order}HHI", 9, 1, 9 if order == "<" else 9 << 24)
    described = struct.pack(f"{order}HHI", link_type, 0, 0) + resolution + bytes(4)
    parts = [block(0x0A0D0D0A, struct.pack(f"{order}IHHq", 0x1A2B3C4D, 1, 0, -1))]
    parts += [block(1, described) for _ in range(interfaces)]
    parts.append(block(0x0BAD, b"unknown"))
    for datagram in datagrams:
        packet = packet_of(datagram, link_type, vlans)
        numbers = (
            datagram.interface,
            datagram.t_ns >> 32,
            datagram.t_ns & 0xFFFF_FFFF,
            len(packet),
            len(packet),
        )
        data = packet + bytes(-len(packet) % 4)
        flags = struct.pack(f"{order}HHI", 2, 4, datagram.direction) + bytes(4)
        parts.append(block(6, struct.pack(f"{order}5I", *numbers) + data + flags))
    return b"".join(parts)
