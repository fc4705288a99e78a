"""Reads capture files, pcap and pcapng, packet by packet, and finds the UDP datagram in a packet.

Link types: Ethernet, VLAN, loopback, Linux cooked, raw IP. Sources: draft-ietf-opsawg-pcap,
draft-ietf-opsawg-pcapng, the link types of tcpdump.org, RFC 791, RFC 8200, RFC 768, IEEE 802.1Q.
"""

import struct
from collections.abc import Callable, Iterator, Mapping
from ipaddress import ip_address
from typing import IO, NamedTuple

_PCAP = {0xA1B2C3D4: 1000, 0xA1B23C4D: 1}
"""Magic numbers, and the unit of their times in ns."""
_SECTION, _INTERFACE, _SIMPLE, _PACKET = 0x0A0D0D0A, 1, 3, 6
"""Types of pcapng's blocks."""
_BYTE_ORDER = 0x1A2B3C4D
"""Number in a section header that shows its byte order."""
_MOST_BYTES = 16 * 2**20
"""Largest block of a capture."""
_MOST_INTERFACES = 10_000
_LATEST_NS = 2**62
"""Upper limit of times: differences of two fit 64 bits."""
_RESOLUTION, _OFFSET, _FLAGS = 9, 14, 2
"""Options of pcapng: of an interface's times, and of a packet."""


class CapturedPacket(NamedTuple):
    """A packet of a capture."""

    t_ns: int  # Unix time
    interface: int
    link_type: int
    is_outbound: bool  # Whether the capture says that this host sent it
    data: bytes
    is_cut: bool  # Whether only its beginning was captured


class _Interface(NamedTuple):
    link_type: int
    ticks_per_s: int
    offset_ns: int


class CutCaptureError(ValueError):
    """The file ends within a packet: the capturing program was killed, or the disk was full."""


def is_capture(head: bytes) -> bool:
    """Whether a file that begins with these bytes is a capture."""
    numbers = [int.from_bytes(head[:4], order) for order in ("little", "big")]
    return _SECTION in numbers or not _PCAP.keys().isdisjoint(numbers)


def captured_packets(file: IO[bytes]) -> Iterator[CapturedPacket]:
    """Yield the packets of a capture from its beginning, in the order of the file.

    Raises:
        ValueError: it is not a capture, or contradicts the format; one line, with the packet.
    """
    file.seek(0)
    head = file.read(4)
    file.seek(0)
    if not is_capture(head):
        raise ValueError("not a capture (pcap or pcapng)")
    count = 0
    packets = _pcapng(file) if head == b"\n\r\r\n" else _pcap(file)
    try:
        for packet in packets:
            if not 0 <= packet.t_ns < _LATEST_NS:
                raise ValueError("has an impossible time")
            count += 1
            yield packet
    except CutCaptureError:
        where = f"after packet {count}" if count else "before the end of its first packet"
        raise CutCaptureError(f"is cut off {where}") from None
    except ValueError as error:
        raise ValueError(f"after packet {count}: {error}") from None
    except struct.error:
        raise ValueError(f"after packet {count}: a block is too short; it is damaged") from None


def _exactly(file: IO[bytes], size_bytes: int) -> bytes:
    data = file.read(size_bytes)
    if len(data) < size_bytes:
        raise CutCaptureError
    return data


def _pcap(file: IO[bytes]) -> Iterator[CapturedPacket]:
    header = _exactly(file, 24)
    order = "<" if int.from_bytes(header[:4], "little") in _PCAP else ">"
    magic, _, _, _, _, _, link_type = struct.unpack(f"{order}IHHiIII", header)
    unit_ns = _PCAP[magic]
    record = struct.Struct(f"{order}IIII")
    while begin := file.read(record.size):
        if len(begin) < record.size:
            raise CutCaptureError
        seconds, fraction, captured_bytes, original_bytes = record.unpack(begin)
        if captured_bytes > _MOST_BYTES:
            raise ValueError(f"a packet of {captured_bytes} bytes; the file is damaged")
        data = _exactly(file, captured_bytes)
        t_ns = seconds * 10**9 + fraction * unit_ns
        is_cut = captured_bytes < original_bytes
        yield CapturedPacket(t_ns, 0, link_type & 0xFFFF, False, data, is_cut)


def _pcapng(file: IO[bytes]) -> Iterator[CapturedPacket]:
    order = "<"
    interfaces: list[_Interface] = []
    first = 0
    while begin := file.read(8):
        if len(begin) < 8:
            raise CutCaptureError
        if begin[:4] == b"\n\r\r\n":
            mark = _exactly(file, 4)
            order = "<" if int.from_bytes(mark, "little") == _BYTE_ORDER else ">"
            first = len(interfaces)
            body = mark + _body(file, order, begin, 4)
            if int.from_bytes(mark, "little" if order == "<" else "big") != _BYTE_ORDER:
                raise ValueError("a section without its byte order; the file is damaged")
            continue
        body = _body(file, order, begin, 0)
        kind = struct.unpack(f"{order}I", begin[:4])[0]
        if kind == _INTERFACE:
            if len(interfaces) == _MOST_INTERFACES:
                raise ValueError(f"more than {_MOST_INTERFACES} interfaces")
            interfaces.append(_interface(order, body))
        elif kind == _PACKET:
            yield _packet(order, body, interfaces, first)
        elif kind == _SIMPLE:
            raise ValueError("a packet without a time (simple packet block)")


def _body(file: IO[bytes], order: str, begin: bytes, done: int) -> bytes:
    """Return the rest of a block's body, of which ``done`` bytes have been read."""
    size = struct.unpack(f"{order}I", begin[4:8])[0]
    if size % 4 or not 12 + done <= size <= _MOST_BYTES:
        raise ValueError(f"a block of {size} bytes; the file is damaged")
    rest = _exactly(file, size - 8 - done)
    if rest[-4:] != begin[4:8]:
        raise ValueError("the two lengths of a block differ; the file is damaged")
    return rest[:-4]


def _options(order: str, data: bytes) -> dict[int, bytes]:
    """Return the options at the end of a block; of several with one code, the last."""
    options = {}
    at = 0
    while at + 4 <= len(data):
        code, size = struct.unpack_from(f"{order}HH", data, at)
        if code == 0:
            break
        options[code] = data[at + 4 : at + 4 + size]
        at += 4 + size + -size % 4
    return options


def _interface(order: str, body: bytes) -> _Interface:
    link_type = struct.unpack_from(f"{order}H", body)[0]
    options = _options(order, body[8:])
    resolution = options.get(_RESOLUTION, b"\x06")[:1] or b"\x06"
    power = resolution[0] & 0x7F
    ticks_per_s = (2 if resolution[0] & 0x80 else 10) ** power
    offset = options.get(_OFFSET, b"")
    offset_s = struct.unpack(f"{order}q", offset)[0] if len(offset) == 8 else 0
    return _Interface(link_type, ticks_per_s, offset_s * 10**9)


def _packet(order: str, body: bytes, interfaces: list[_Interface], first: int) -> CapturedPacket:
    number, high, low, captured_bytes, original_bytes = struct.unpack_from(f"{order}5I", body)
    if first + number >= len(interfaces):
        raise ValueError(f"a packet of interface {number}, which is not described")
    if 20 + captured_bytes > len(body):
        raise ValueError("a packet longer than its block; the file is damaged")
    interface = interfaces[first + number]
    t_ns = (high << 32 | low) * 10**9 // interface.ticks_per_s + interface.offset_ns
    flags = _options(order, body[20 + captured_bytes + -captured_bytes % 4 :]).get(_FLAGS, b"")
    is_outbound = len(flags) == 4 and struct.unpack(f"{order}I", flags)[0] & 3 == 2
    data = body[20 : 20 + captured_bytes]
    is_cut = captured_bytes < original_bytes
    return CapturedPacket(t_ns, first + number, interface.link_type, is_outbound, data, is_cut)


_VLAN = (b"\x81\x00", b"\x88\xa8", b"\x91\x00")
_MOST_VLANS = 4
_UDP = 17
"""The protocol's number in an IP header."""
_IPV6_OPTIONS = (0, 43, 60)
"""Extension headers with a length: hop-by-hop, routing, destination options."""
_MOST_EXTENSIONS = 8
"""Extension headers of IPv6 that are followed."""


class CapturedFlow(NamedTuple):
    """Where a datagram came from and went to, and the interface that captured it."""

    interface: int
    source: bytes
    source_port: int
    destination: bytes
    destination_port: int

    def __str__(self) -> str:
        ends = ((self.source, self.source_port), (self.destination, self.destination_port))
        texts = (
            f"[{ip_address(host)}]:{port}" if len(host) == 16 else f"{ip_address(host)}:{port}"
            for host, port in ends
        )
        return f"{' → '.join(texts)} on interface {self.interface}"

    def is_reverse_of(self, other: "CapturedFlow") -> bool:
        """Whether its datagrams go the other way."""
        return (self.source, self.source_port, self.destination, self.destination_port) == (
            other.destination,
            other.destination_port,
            other.source,
            other.source_port,
        )


def _ethernet(data: bytes) -> int:
    at = 12
    for _ in range(_MOST_VLANS):
        if data[at : at + 2] not in _VLAN:
            break
        at += 4
    return at + 2


_IP_AT: Mapping[int, Callable[[bytes], int]] = {
    0: lambda data: 4,  # loopback of BSD
    1: _ethernet,
    12: lambda data: 0,  # raw IP
    14: lambda data: 0,
    101: lambda data: 0,
    108: lambda data: 4,  # loopback of OpenBSD
    113: lambda data: 16,  # Linux cooked
    228: lambda data: 0,  # raw IPv4
    229: lambda data: 0,  # raw IPv6
    276: lambda data: 20,  # Linux cooked, version 2
}
"""Place of the IP header, by link type."""


def find_udp(interface: int, link_type: int, data: bytes) -> tuple[CapturedFlow, bytes, bool] | None:
    """Return the flow of a packet, the payload, and whether the payload is complete.

    None: it is no UDP datagram, or a fragment of one.

    Raises:
        ValueError: the link type is not supported.
    """
    ip_at = _IP_AT.get(link_type)
    if ip_at is None:
        raise ValueError(f"link type {link_type} is not supported; capture Ethernet or raw IP")
    at = ip_at(data)
    if at >= len(data):
        return None
    udp = _udp_in_ipv4(data, at) if data[at] >> 4 == 4 else _udp_in_ipv6(data, at)
    if udp is None or udp + 8 > len(data):
        return None
    v4 = data[at] >> 4 == 4
    hosts, size = (at + 12, 4) if v4 else (at + 8, 16)
    flow = CapturedFlow(
        interface,
        data[hosts : hosts + size],
        int.from_bytes(data[udp : udp + 2]),
        data[hosts + size : hosts + 2 * size],
        int.from_bytes(data[udp + 2 : udp + 4]),
    )
    end = udp + int.from_bytes(data[udp + 4 : udp + 6])
    return flow, data[udp + 8 : end], end <= len(data)


def _udp_in_ipv4(data: bytes, at: int) -> int | None:
    if len(data) < at + 20 or data[at + 9] != _UDP or data[at] & 15 < 5:
        return None
    is_fragment = int.from_bytes(data[at + 6 : at + 8]) & 0x3FFF
    return None if is_fragment else at + 4 * (data[at] & 15)


def _udp_in_ipv6(data: bytes, at: int) -> int | None:
    if data[at] >> 4 != 6 or len(data) < at + 40:
        return None
    following, at = data[at + 6], at + 40
    for _ in range(_MOST_EXTENSIONS):
        if following not in _IPV6_OPTIONS or at + 2 > len(data):
            break
        following, at = data[at], at + 8 * (1 + data[at + 1])
    return at if following == _UDP else None
