"""Finds the UDP datagrams in captured packets, and puts fragments together.

Link types: Ethernet, VLAN, loopback, Linux cooked, raw IP. Sources: the link types of tcpdump.org, RFC 791,
RFC 8200, RFC 768, IEEE 802.1Q. The library dpkt has no fragments, no VLAN tags in cooked packets, and no
packets that are cut.
"""

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from ipaddress import ip_address
from typing import NamedTuple

from netem.traces.capture_packets import CapturedPacket

_VLAN = (b"\x81\x00", b"\x88\xa8", b"\x91\x00")
_MOST_VLANS = 4
_UDP, _IPV6_FRAGMENT = 17, 44
"""Numbers of protocols in an IP header."""
_IPV6_OPTIONS = (0, 43, 60)
"""Extension headers with a length: hop-by-hop, routing, destination options."""
_MOST_EXTENSIONS = 8
"""Extension headers of IPv6 that are followed."""
_OUTGOING = 4
"""The type of an outgoing packet in Linux's cooked headers."""
_LOOPBACK = 772
"""The loopback interface in Linux's cooked headers (ARPHRD_LOOPBACK)."""
_LONGEST_REASSEMBLY_NS = 30 * 10**9
"""Linux waits this long for missing fragments."""
_MOST_REASSEMBLIES = 4096


class Leg(NamedTuple):
    """Where a capture saw a packet; a host that forwards sees it on two legs."""

    interface: int  # Linux's index in cooked packets of version 2, else the number in the file
    vlans: tuple[int, ...]
    outbound: bool | None  # None: the capture does not say

    def __str__(self) -> str:
        vlans = "".join(f", VLAN {vlan}" for vlan in self.vlans)
        direction = "" if self.outbound is None else ", outgoing" if self.outbound else ", incoming"
        return f"interface {self.interface}{vlans}{direction}"


class CapturedFlow(NamedTuple):
    """Where a datagram came from and went to, and the leg on which it was captured."""

    leg: Leg
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
        return f"{' → '.join(texts)} on {self.leg}"

    def is_copy_of(self, other: "CapturedFlow") -> bool:
        """Whether a host has the same datagrams twice in one direction, as with a bridge."""
        mine, theirs = self.leg, other.leg
        are_two_vlans = mine.vlans and theirs.vlans and mine.vlans != theirs.vlans
        is_known = mine.outbound is not None and mine.outbound == theirs.outbound
        return self[1:] == other[1:] and is_known and not are_two_vlans

    def is_reverse_of(self, other: "CapturedFlow") -> bool:
        """Whether its datagrams go the other way."""
        return (self.source, self.source_port, self.destination, self.destination_port) == (
            other.destination,
            other.destination_port,
            other.source,
            other.source_port,
        )


class CapturedDatagram(NamedTuple):
    """A UDP datagram of a capture."""

    t_ns: int  # Of its last fragment
    flow: CapturedFlow
    payload: bytes
    size_bytes: int  # Of the whole payload, more than is here if only its beginning was captured
    interface: int  # In the file
    is_merged: bool  # Whether it exceeds Ethernet's MTU, and was not fragmented

    @property
    def is_cut(self) -> bool:
        """Whether only its beginning was captured."""
        return len(self.payload) < self.size_bytes


class _IpPacket(NamedTuple):
    """A packet, or a fragment, from its UDP header on."""

    source: bytes
    destination: bytes
    following: int  # Protocol of the content
    content: bytes
    size_bytes: int  # Of the content, more than is here if it is cut
    fragment: bytes | None  # Identification; None: the packet is whole
    offset: int
    is_last: bool


@dataclass
class _Reassembly:
    """The fragments of one packet."""

    packet: CapturedPacket
    leg: Leg
    first: _IpPacket
    pieces: dict[int, _IpPacket] = field(default_factory=dict)

    def whole(self) -> tuple[bytes, int] | None:
        """Return the content as far as it was captured, and its size; None: a fragment is missing."""
        at, content, is_cut = 0, b"", False
        while (piece := self.pieces.get(at)) is not None:
            if not is_cut:
                content += piece.content
                is_cut = len(piece.content) < piece.size_bytes
            at += piece.size_bytes
            if piece.is_last:
                return content, at
            if piece.size_bytes <= 0:
                break
        return None


class DatagramReader:
    """Finds the datagrams in the packets of one capture."""

    def __init__(self) -> None:
        self.unsupported: dict[int, int] = {}
        """Packets of link types that are not supported, by link type."""
        self.incomplete = 0
        """Datagrams of which fragments did not arrive: no receiver got them."""
        self.first_fragments = 0
        """Datagrams of which the capture has the first fragment only, as a filter by port leaves it."""
        self._reassemblies: dict[tuple[Leg, bytes, bytes, bytes], _Reassembly] = {}
        self._with_later_fragments: set[tuple[Leg, bytes, bytes]] = set()

    @property
    def has_fragments(self) -> bool:
        """Whether there were later fragments."""
        return bool(self._with_later_fragments)

    def read(self, packets: Iterable[CapturedPacket]) -> Iterator[CapturedDatagram]:
        """Yield the datagrams; those with fragments when the last one arrives."""
        for packet in packets:
            if _is_sent_on_loopback(packet):
                continue
            located = _locate_ip(packet)
            if located is None:
                self.unsupported[packet.link_type] = self.unsupported.get(packet.link_type, 0) + 1
                continue
            ip_at, leg = located
            ip = _ip_packet(packet, ip_at)
            if ip is None:
                continue
            if ip.fragment is None:
                datagram = _datagram(packet, leg, ip, ip.content, ip.size_bytes)
                if datagram is not None:
                    yield datagram
            else:
                yield from self._with_fragment(packet, leg, ip)

    def rest(self) -> Iterator[CapturedDatagram]:
        """Yield what is left at the end of the capture."""
        while self._reassemblies:
            yield from self._given_up()

    def _with_fragment(self, packet: CapturedPacket, leg: Leg, ip: _IpPacket) -> Iterator[CapturedDatagram]:
        if ip.offset:
            self._with_later_fragments.add((leg, ip.source, ip.destination))
        while self._reassemblies:
            oldest = next(iter(self._reassemblies.values())).packet
            is_full = len(self._reassemblies) >= _MOST_REASSEMBLIES
            if not is_full and packet.t_ns - oldest.t_ns <= _LONGEST_REASSEMBLY_NS:
                break
            yield from self._given_up()
        assert ip.fragment is not None
        key = (leg, ip.source, ip.destination, ip.fragment)
        reassembly = self._reassemblies.get(key)
        if reassembly is None:
            reassembly = self._reassemblies[key] = _Reassembly(packet, leg, ip)
        known = reassembly.pieces.setdefault(ip.offset, ip)
        if known.content != ip.content:  # the identification has come round to another datagram
            reassembly = self._reassemblies[key] = _Reassembly(packet, leg, ip, {ip.offset: ip})
        whole = reassembly.whole()
        if whole is not None:
            del self._reassemblies[key]
            datagram = _datagram(packet, leg, reassembly.pieces[0], *whole)
            if datagram is not None:
                yield datagram

    def _given_up(self) -> Iterator[CapturedDatagram]:
        """End the oldest reassembly, and yield its datagram if the capture leaves out later fragments."""
        reassembly = self._reassemblies.pop(next(iter(self._reassemblies)))
        leg, ip = reassembly.leg, reassembly.first
        if (leg, ip.source, ip.destination) in self._with_later_fragments:
            self.incomplete += 1
            return
        datagram = _datagram(reassembly.packet, leg, ip, ip.content, 2**16)
        if datagram is not None:
            self.first_fragments += 1
            yield datagram


def _is_sent_on_loopback(packet: CapturedPacket) -> bool:
    """Whether a cooked packet goes out on the loopback interface, where it comes in at once."""
    data = packet.data
    if packet.link_type == 113:
        return data[:4] == struct.pack(">HH", _OUTGOING, _LOOPBACK)
    return packet.link_type == 276 and data[8:11] == struct.pack(">HB", _LOOPBACK, _OUTGOING)


def _locate_ip(packet: CapturedPacket) -> tuple[int, Leg] | None:
    """Return the place of the IP header, and the leg; None: the link type is not supported."""
    data, interface, outbound = packet.data, packet.interface, packet.outbound
    match packet.link_type:
        case 1:  # Ethernet
            kind, at = data[12:14], 14
        case 113:  # Linux cooked
            kind, at, outbound = data[14:16], 16, data[:2] == b"\0\4"
        case 276:  # Linux cooked, version 2
            kind, at, outbound = data[:2], 20, data[10:11] == b"\4"
            interface = int.from_bytes(data[4:8])
        case 12 | 14 | 101 | 228 | 229:  # raw IP
            return 0, Leg(interface, (), outbound)
        case 0 | 108:  # loopback of BSD and OpenBSD
            return 4, Leg(interface, (), outbound)
        case _:
            return None
    vlans: tuple[int, ...] = ()
    while kind in _VLAN and len(vlans) < _MOST_VLANS:
        vlans += (int.from_bytes(data[at : at + 2]) & 0xFFF,)
        kind, at = data[at + 2 : at + 4], at + 4
    return at, Leg(interface, vlans, outbound)


def _ip_packet(packet: CapturedPacket, at: int) -> _IpPacket | None:
    """Return a packet that may have a UDP datagram or a part of one."""
    data = packet.data
    if at >= len(data):
        return None
    if data[at] >> 4 == 4:
        return _ipv4_packet(packet, at)
    return _ipv6_packet(packet, at) if data[at] >> 4 == 6 else None


def _ipv4_packet(packet: CapturedPacket, at: int) -> _IpPacket | None:
    data = packet.data
    if len(data) < at + 20 or data[at + 9] != _UDP or data[at] & 15 < 5:
        return None
    # A length of 0 is that of a packet that the kernel has not yet divided.
    end = (
        at + int.from_bytes(data[at + 2 : at + 4]) if data[at + 2 : at + 4] != b"\0\0" else packet.size_bytes
    )
    begin = at + 4 * (data[at] & 15)
    position = int.from_bytes(data[at + 6 : at + 8])
    is_fragment = position & 0x3FFF != 0
    return _IpPacket(
        data[at + 12 : at + 16],
        data[at + 16 : at + 20],
        _UDP,
        data[begin:end],
        end - begin,
        data[at + 4 : at + 6] if is_fragment else None,
        8 * (position & 0x1FFF),
        not position & 0x2000,
    )


def _ipv6_packet(packet: CapturedPacket, at: int) -> _IpPacket | None:
    data = packet.data
    if len(data) < at + 40:
        return None
    length = int.from_bytes(data[at + 4 : at + 6])
    end = at + 40 + length if length else packet.size_bytes
    source, destination = data[at + 8 : at + 24], data[at + 24 : at + 40]
    following, begin = _skip_options(data[at + 6], data, at + 40)
    fragment, position = None, 0
    if following == _IPV6_FRAGMENT and begin + 8 <= len(data):
        position = int.from_bytes(data[begin + 2 : begin + 4])
        fragment = data[begin + 4 : begin + 8] if position & 0xFFF9 else None
        following, begin = data[begin], begin + 8
    if fragment is None:
        following, begin = _skip_options(following, data, begin)
    if following != _UDP and (fragment is None or following not in _IPV6_OPTIONS):
        return None
    return _IpPacket(
        source,
        destination,
        following,
        data[begin:end],
        end - begin,
        fragment,
        position & 0xFFF8,
        not position & 1,
    )


def _skip_options(following: int, data: bytes, at: int) -> tuple[int, int]:
    for _ in range(_MOST_EXTENSIONS):
        if following not in _IPV6_OPTIONS or at + 2 > len(data):
            break
        following, at = data[at], at + 8 * (1 + data[at + 1])
    return following, at


def _datagram(
    packet: CapturedPacket, leg: Leg, ip: _IpPacket, content: bytes, size_bytes: int
) -> CapturedDatagram | None:
    """Return the datagram in the content of an IP packet, of which the beginning was captured."""
    following, udp = _skip_options(ip.following, content, 0)
    if following != _UDP or udp + 8 > len(content):
        return None
    length = int.from_bytes(content[udp + 4 : udp + 6]) or size_bytes - udp
    if not 8 <= length <= size_bytes - udp:
        return None
    flow = CapturedFlow(
        leg,
        ip.source,
        int.from_bytes(content[udp : udp + 2]),
        ip.destination,
        int.from_bytes(content[udp + 2 : udp + 4]),
    )
    payload = content[udp + 8 : udp + length]
    is_merged = ip.fragment is None and length > 1480
    return CapturedDatagram(packet.t_ns, flow, payload, length - 8, packet.interface, is_merged)
