"""Finds the UDP datagram in a captured packet: Ethernet, VLAN, loopback, Linux cooked, raw IP.

Sources: the link types of tcpdump.org, RFC 791, RFC 8200, RFC 768, IEEE 802.1Q.
"""

from collections.abc import Callable, Mapping
from ipaddress import ip_address
from typing import NamedTuple

_VLAN = (b"\x81\x00", b"\x88\xa8", b"\x91\x00")
_MOST_VLANS = 4
_UDP = 17
_IPV6_OPTIONS = (0, 43, 60)
"""Extension headers with a length: hop-by-hop, routing, destination options."""
_MOST_EXTENSIONS = 8


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
            other.destination, other.destination_port, other.source, other.source_port,
        )  # fmt: skip


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


def udp_of(interface: int, link_type: int, data: bytes) -> tuple[CapturedFlow, bytes, bool] | None:
    """Return the flow of a packet, the payload, and whether the payload is complete.

    None: it is no UDP datagram, or a fragment of one.

    Raises:
        ValueError: the link type is not supported.
    """
    place = _IP_AT.get(link_type)
    if place is None:
        raise ValueError(f"link type {link_type} is not supported; capture Ethernet or raw IP")
    at = place(data)
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
