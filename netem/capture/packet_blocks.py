"""Formats events as enhanced packet blocks: the part of a capture that must be fast.

A block holds the datagram with an IP and a UDP header, and as options a comment, the direction, the
packet id, and the number of missing events before it. The code is compiled (numba) and runs without
the interpreter lock, so that the packet path in another thread does not wait. All of it is in one
file, because numba's cache detects changes of the compiled file only.

Sources: draft-ietf-opsawg-pcapng §4.3, RFC 791, RFC 8200, RFC 768, RFC 1071 (the checksum).
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

from noack.core.code_cache import CALLED_BY_CODE, cache_folder, compiler

Bytes = NDArray[np.uint8]
Counts = NDArray[np.int64]
Events = NDArray[np.void]
_Function = TypeVar("_Function", bound=Callable[..., Any])
FOLDER = cache_folder("capture", [Path(__file__)])
"""Cache folder of the compiled code; None if there is no cache."""
_compiled = cast(Callable[[_Function], _Function], compiler(FOLDER, nogil=True))
_integer = cast(Callable[[Any], int], np.int64)  # uint64 with int64 would give float64
_part = cast(Callable[[_Function], _Function], numba.njit(**CALLED_BY_CODE))

MAX_HEADER_BYTES = 40 + 8
"""IPv6 and UDP."""

_BLOCK_BYTES = 32 + MAX_HEADER_BYTES + 3 + 512  # 512: twice the maximum size of the options
_MAX_IPV4_BYTES = 65_535 - 20
_MAX_IPV6_BYTES = 65_535
_UDP_BYTES = 8

_ENHANCED_PACKET = 6
_COMMENT, _FLAGS, _DROPCOUNT, _PACKET_ID = 1, 2, 4, 5
_INBOUND, _OUTBOUND = 1, 2
_DELIVERED, _FORCED, _CORRUPTED, _UNKNOWN = 0, 2, 3, 6


def _rows(*texts: bytes) -> Bytes:
    return np.stack([np.frombuffer(text.ljust(32, b"\0"), np.uint8) for text in texts])


# In the order of noack.protocol.record_tables.Fate; the last row is for any other number.
_FATES = _rows(
    b"delivered",
    b"dropped by the loss model",
    b"forced: delivered",
    b"corrupted",
    b"dropped by a full queue",
    b"dropped in a blackout",
    b"unknown fate",
)
_DIRECTIONS = _rows(b"; forward, flow ", b"; reverse, flow ")
_STALE = b"delivered out of order (stale)"


@_compiled
def blocks_bytes(events: Events, data_bytes: int, interfaces: int) -> int:
    """Return an upper bound on the bytes of the events' blocks, or −1 − i if event i is invalid."""
    total = 0
    for i in range(events.size):
        event = events[i]
        size = _integer(event["size_bytes"])
        offset = _integer(event["offset"])
        udp_limit = _MAX_IPV4_BYTES if event["family"] == 4 else _MAX_IPV6_BYTES
        if (
            event["interface"] >= interfaces
            or event["t_ns"] < 0
            or (event["family"] != 4 and event["family"] != 6)
            or size + _UDP_BYTES > udp_limit
            or offset < 0
            or offset > data_bytes - size
        ):
            return -1 - i
        total += size + _BLOCK_BYTES
    return total


@_compiled
def put_blocks(events: Events, data: Bytes, missing: Counts, written: Counts, out: Bytes) -> int:
    """Write the events' enhanced packet blocks into ``out`` and return their bytes.

    Args:
        events: (n,) of type :data:`netem.relay_events.EVENT`, checked by :func:`blocks_bytes`.
        data: the payloads.
        missing: (interfaces,) missing events before these; written in the next block, then reset.
        written: (interfaces,) number of written events; incremented.
        out: output buffer, at least as large as :func:`blocks_bytes` returns.
    """
    at = 0
    for i in range(events.size):
        event = events[i]
        interface = _integer(event["interface"])
        start = at
        size = _integer(event["size_bytes"])
        t_ns = _integer(event["t_ns"])
        packet = start + 28
        payload = _put_headers(out, packet, event)
        offset = _integer(event["offset"])
        out[payload : payload + size] = data[offset : offset + size]
        _put_u16_network(out, payload - 2, _udp_checksum(out, packet, payload, size))
        at = _pad(out, payload + size)

        at = _put_comment(out, at, event)
        at = _put_u16(out, at, _FLAGS)
        at = _put_u16(out, at, 4)
        at = _put_u32(out, at, _OUTBOUND if event["departure"] else _INBOUND)
        at = _put_u16(out, at, _PACKET_ID)
        at = _put_u16(out, at, 8)
        at = _put_u32(out, at, _integer(event["packet"]))
        at = _put_u32(out, at, _identity(event))
        lost = _integer(missing[interface])
        if lost:
            at = _put_u16(out, at, _DROPCOUNT)
            at = _put_u16(out, at, 8)
            at = _put_u32(out, at, lost)
            at = _put_u32(out, at, lost >> 32)
            missing[interface] = 0
        at = _put_u32(out, at, 0)  # end of options

        block_bytes = at + 4 - start
        _put_u32(out, start, _ENHANCED_PACKET)
        _put_u32(out, start + 4, block_bytes)
        _put_u32(out, start + 8, interface)
        _put_u32(out, start + 12, t_ns >> 32)
        _put_u32(out, start + 16, t_ns)
        _put_u32(out, start + 20, payload + size - packet)
        _put_u32(out, start + 24, payload + size - packet)
        at = _put_u32(out, at, block_bytes)
        written[interface] += 1
    return at


@_part
def _identity(event: Any) -> int:
    """Return the upper half of a packet id, which is the same at both interfaces."""
    link = _integer(event["interface"]) >> 1
    return link << 25 | _integer(event["direction"]) << 24 | _integer(event["flow"]) & 0xFFFFFF


@_part
def _put_headers(out: Bytes, at: int, event: Any) -> int:
    """Write the IP header and the UDP header, with UDP checksum 0."""
    udp_bytes = _integer(event["size_bytes"]) + _UDP_BYTES
    source, destination = event["source"], event["destination"]
    if event["family"] == 4:
        out[at : at + 20] = 0
        out[at] = 0x45
        _put_u16_network(out, at + 2, 20 + udp_bytes)
        out[at + 6] = 0x40  # not fragmented
        out[at + 8] = 64  # hop limit
        out[at + 9] = 17  # UDP
        out[at + 12 : at + 16] = source[:4]
        out[at + 16 : at + 20] = destination[:4]
        _put_u16_network(out, at + 10, 0xFFFF - _folded(_sum(out, at, 20)))
        at += 20
    else:
        out[at : at + 8] = 0
        out[at] = 0x60
        _put_u16_network(out, at + 4, udp_bytes)
        out[at + 6] = 17
        out[at + 7] = 64
        out[at + 8 : at + 24] = source
        out[at + 24 : at + 40] = destination
        at += 40
    at = _put_u16_network(out, at, _integer(event["source_port"]))
    at = _put_u16_network(out, at, _integer(event["destination_port"]))
    at = _put_u16_network(out, at, udp_bytes)
    return _put_u16_network(out, at, 0)


@_part
def _udp_checksum(out: Bytes, packet: int, payload: int, size_bytes: int) -> int:
    udp = payload - _UDP_BYTES
    addresses = packet + 12 if udp - packet == 20 else packet + 8
    pseudo = _sum(out, addresses, udp - addresses) + 17 + size_bytes + _UDP_BYTES
    checksum = 0xFFFF - _folded(pseudo + _sum(out, udp, _UDP_BYTES + size_bytes))
    return checksum if checksum else 0xFFFF  # 0 would mean "no checksum"


@_part
def _sum(data: Bytes, at: int, size_bytes: int) -> int:
    """Sum of big-endian 16-bit words; an odd last byte is padded with 0."""
    upper: int = 0
    lower: int = 0
    for i in range(at, at + size_bytes - 1, 2):
        upper += data[i]
        lower += data[i + 1]
    if size_bytes % 2:
        upper += data[at + size_bytes - 1]
    return (upper << 8) + lower


@_part
def _folded(total: int) -> int:
    while total > 0xFFFF:
        total = (total & 0xFFFF) + (total >> 16)
    return total


@_part
def _put_comment(out: Bytes, start: int, event: Any) -> int:
    """Write the comment as an option."""
    fate, losses, mansd = min(event["fate"], _UNKNOWN), event["consecutive_losses"], event["mansd"]
    at = start + 4
    if event["copy"]:
        at = _put(out, at, b"copy, ")
    if event["stale"] and fate == _DELIVERED:
        at = _put(out, at, _STALE)
    else:
        at = _put(out, at, _FATES[fate])
    if fate == _FORCED and event["packet"] == 0 and mansd != 0:
        at = _put(out, at, b" as the first of its flow")
    elif fate == _FORCED:
        at = _put(out, at, b" by the cap")
        if mansd >= 0:
            at = _put_number(out, _put(out, at, b" of "), mansd)
            at = _put(out, at, b" consecutive losses")
    if event["bit"] >= 0:
        if fate != _CORRUPTED:
            at = _put(out, at, b", corrupted")
        at = _put_number(out, _put(out, at, b" in bit "), event["bit"])
    if event["stale"] and fate != _DELIVERED:
        at = _put(out, _put(out, at, b", "), _STALE)
    if event["departure"]:
        at = _put_ms(out, _put(out, at, b", after "), event["delay_ns"])
    else:
        if losses > 0 and fate != _DELIVERED and fate != _FORCED:
            at = _put_number(out, _put(out, at, b", consecutive loss "), losses)
            if mansd >= 0:
                at = _put_number(out, _put(out, at, b", cap "), mansd)
        is_forwarded = fate in (_DELIVERED, _FORCED, _CORRUPTED)
        if is_forwarded and event["delay_ns"] > 0:
            at = _put_ms(out, _put(out, at, b", delayed "), event["delay_ns"])
        if is_forwarded and event["hold_back_ns"] > 0:
            at = _put_ms(out, _put(out, at, b", held back "), event["hold_back_ns"])
            at = _put(out, at, b" for the guarantee")
    at = _put(out, at, _DIRECTIONS[1 if event["direction"] else 0])
    at = _put_number(out, at, event["flow"])
    at = _put_number(out, _put(out, at, b", packet "), event["packet"])
    _put_u16(out, start, _COMMENT)
    _put_u16(out, start + 2, at - start - 4)
    return _pad(out, at)


@_part
def _put_ms(out: Bytes, at: int, time_ns: int) -> int:
    """Write nanoseconds as milliseconds, to the microsecond and without trailing zeros."""
    time_us = (max(time_ns, 0) + 500) // 1000
    at = _put_number(out, at, time_us // 1000)
    rest = time_us % 1000
    if rest:
        out[at] = 46  # the decimal point
        at += 1
        scale = 100
        while rest:
            out[at] = 48 + rest // scale
            rest %= scale
            scale //= 10
            at += 1
    return _put(out, at, b" ms")


@_part
def _put_number(out: Bytes, at: int, value: int) -> int:
    if value < 0:
        out[at] = 45
        at += 1
        value = -value
    digits = 1
    rest = value
    while rest > 9:
        rest //= 10
        digits += 1
    for i in range(at + digits - 1, at - 1, -1):
        out[i] = 48 + value % 10
        value //= 10
    return at + digits


@_part
def _put(out: Bytes, at: int, text: bytes | Bytes) -> int:
    for i in range(len(text)):
        if text[i] == 0:
            break
        out[at] = text[i]
        at += 1
    return at


@_part
def _pad(out: Bytes, at: int) -> int:
    """Pad with 0 to a multiple of 4, where blocks begin."""
    while at % 4:
        out[at] = 0
        at += 1
    return at


@_part
def _put_u16(out: Bytes, at: int, value: int) -> int:
    out[at] = value & 0xFF
    out[at + 1] = value >> 8 & 0xFF
    return at + 2


@_part
def _put_u32(out: Bytes, at: int, value: int) -> int:
    return _put_u16(out, _put_u16(out, at, value), value >> 16)


@_part
def _put_u16_network(out: Bytes, at: int, value: int) -> int:
    out[at] = value >> 8 & 0xFF
    out[at + 1] = value & 0xFF
    return at + 2
