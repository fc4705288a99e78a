"""Writes captures of UDP datagrams by the RFCs and drafts, independently of the reader."""

import struct
from collections.abc import Iterable
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
    vlans: tuple[int, ...] = ()
    hardware: int = 1
    """ARPHRD type of the interface, in cooked packets."""


def packet_of(sent: Sent, link_type: int = RAW) -> bytes:
    """Return the packet with the header of a link type."""
    (packet,) = fragments_of(sent, link_type)
    return packet


def fragments_of(sent: Sent, link_type: int = RAW, identification: int = 0, most: int = 2**16) -> list[bytes]:
    """Return a datagram in packets with at most this number of bytes after the IP header each."""
    ends = ip_address(sent.source), ip_address(sent.destination)
    hosts = b"".join(end.packed for end in ends)
    size = 8 + len(sent.payload)
    udp = struct.pack(">HHHH", sent.source_port, sent.destination_port, size, 0) + sent.payload
    pieces = {at: udp[at : at + most // 8 * 8] for at in range(0, len(udp), most // 8 * 8)}
    packets = []
    for at, piece in pieces.items():
        is_part, follows = len(pieces) > 1, at + len(piece) < len(udp)
        if ends[0].version == 4:
            position = (at // 8 | follows << 13) if is_part else 0x4000
            length = 20 + len(piece)
            ip = struct.pack(">BBHHHBBH", 0x45, 0, length, identification, position, 64, 17, 0) + hosts
        else:
            fragment = struct.pack(">BBHI", 17, 0, at | follows, identification) if is_part else b""
            hop_by_hop = bytes([44 if is_part else 17, 0, 1, 4, 0, 0, 0, 0])  # PadN
            length = 8 + len(fragment) + len(piece)
            ip = struct.pack(">IHBB", 6 << 28, length, 0, 64) + hosts + hop_by_hop + fragment
        packets.append(_on_link(sent, link_type, ends[0].version) + ip + piece + _trailer(link_type))
    return packets


def _on_link(sent: Sent, link_type: int, version: int) -> bytes:
    kind = b"\x08\x00" if version == 4 else b"\x86\xdd"
    kinds = b"".join(b"\x81\x00" + struct.pack(">H", 0xE000 | vlan) for vlan in sent.vlans) + kind
    packet_type = 4 if sent.direction == 2 else 0
    return {
        ETHERNET: bytes(12) + kinds,
        LOOPBACK: struct.pack("=I", 2 if version == 4 else 10),
        RAW: b"",
        COOKED: struct.pack(">HHH8s", packet_type, sent.hardware, 6, b"") + kinds,
        COOKED_2: kinds[:2]
        + struct.pack(">HIHBB8s", 0, sent.interface, sent.hardware, packet_type, 6, b"")
        + kinds[2:],
    }[link_type]


def _trailer(link_type: int) -> bytes:
    return bytes(4) if link_type == ETHERNET else b""


def pcap_of(
    *datagrams: Sent, link_type: int = RAW, order: str = "<", nano: bool = True, snap_bytes: int = 262_144
) -> bytes:
    """Return a pcap file."""
    packets = [(datagram.t_ns, packet_of(datagram, link_type)) for datagram in datagrams]
    return pcap_of_packets(packets, link_type, order, nano, snap_bytes)


def pcap_of_packets(
    packets: Iterable[tuple[int, bytes]],
    link_type: int = RAW,
    order: str = "<",
    nano: bool = True,
    snap_bytes: int = 262_144,
) -> bytes:
    """Return a pcap file of packets with their times."""
    magic, unit_ns = (0xA1B23C4D, 1) if nano else (0xA1B2C3D4, 1000)
    parts = [struct.pack(f"{order}IHHiIII", magic, 2, 4, 0, 0, snap_bytes, link_type)]
    for t_ns, packet in packets:
        seconds, rest_ns = divmod(t_ns, 10**9)
        cut = packet[:snap_bytes]
        parts += [
            struct.pack(f"{order}IIII", seconds, rest_ns // unit_ns, len(cut), len(packet)), cut
        ]  # fmt: skip
    return b"".join(parts)


def pcapng_of(
    *datagrams: Sent,
    link_type: int = RAW,
    order: str = "<",
    interfaces: int = 2,
    dropped: int = 0,
    dropped_before: int = 0,
) -> bytes:
    """Return a pcapng file with times in nanoseconds.

    Args:
        datagrams: what is captured.
        link_type: of all interfaces.
        order: of bytes.
        interfaces: their number.
        dropped: what the statistics of interface 0 say that the system dropped.
        dropped_before: what each packet says that was dropped before it.
    """

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
        packet = packet_of(datagram, link_type)
        numbers = (
            datagram.interface,
            datagram.t_ns >> 32,
            datagram.t_ns & 0xFFFF_FFFF,
            len(packet),
            len(packet),
        )
        data = packet + bytes(-len(packet) % 4)
        flags = struct.pack(f"{order}HHI", 2, 4, datagram.direction)
        before = struct.pack(f"{order}HHQ", 4, 8, dropped_before)
        parts.append(block(6, struct.pack(f"{order}5I", *numbers) + data + flags + before + bytes(4)))
    if dropped:
        counters = struct.pack(f"{order}HHQHHQ", 4, 8, 10**6, 7, 8, dropped) + bytes(4)
        parts.append(block(5, struct.pack(f"{order}III", 0, 0, 0) + counters))
    return b"".join(parts)
