"""Reads capture files, pcap and pcapng, packet by packet.

Sources: draft-ietf-opsawg-pcap, draft-ietf-opsawg-pcapng. The library dpkt (1.9.8) reads these formats,
too, but it rounds times to floats, and discards what a measurement needs: the interface, the length and
the direction of a packet, and what the capture itself dropped.
"""

import struct
from collections.abc import Iterator
from typing import IO, NamedTuple

_PCAP = {0xA1B2C3D4: 1000, 0xA1B23C4D: 1}
"""Magic numbers, and the unit of their times in ns."""
_SECTION, _INTERFACE, _OBSOLETE, _SIMPLE, _STATISTICS, _PACKET = 0x0A0D0D0A, 1, 2, 3, 5, 6
"""Types of pcapng's blocks."""
_BYTE_ORDER = 0x1A2B3C4D
"""Number in a section header that shows its byte order."""
_MOST_BYTES = 16 * 2**20
"""Largest block of a capture."""
_MOST_INTERFACES = 10_000
_LATEST_NS = 2**62
"""Upper limit of times: differences of two fit 64 bits."""
_RESOLUTION, _OFFSET = 9, 14
"""Options of an interface: the unit and the origin of its times."""
_FLAGS, _DROPPED_BEFORE = 2, 4
"""Options of a packet: its direction, and the packets that the capture dropped before it."""
_DROPPED = (5, 7)
"""Options of an interface's statistics: the packets that the interface and the system dropped."""


class CapturedPacket(NamedTuple):
    """A packet of a capture."""

    t_ns: int  # Unix time
    interface: int
    link_type: int
    outbound: bool | None  # Whether this host sent it; None: the capture does not say
    data: bytes
    size_bytes: int  # More than the data if only its beginning was captured


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


def captured_packets(file: IO[bytes], dropped: dict[int, int] | None = None) -> Iterator[CapturedPacket]:
    """Yield the packets of a capture from its beginning, in the order of the file.

    Args:
        file: the capture.
        dropped: receives the packets that the capture itself dropped, by interface.

    Raises:
        ValueError: it is not a capture, or contradicts the format; one line, with the packet.
    """
    file.seek(0)
    head = file.read(4)
    file.seek(0)
    if not is_capture(head):
        raise ValueError("not a capture (pcap or pcapng)")
    count = 0
    packets = _pcapng(file, {} if dropped is None else dropped) if head == b"\n\r\r\n" else _pcap(file)
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
        yield CapturedPacket(t_ns, 0, link_type & 0xFFFF, None, data, original_bytes)


def _pcapng(file: IO[bytes], dropped: dict[int, int]) -> Iterator[CapturedPacket]:
    order = "<"
    interfaces: list[_Interface] = []
    dropped_between: dict[int, int] = {}
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
            packet, dropped_before = _packet(order, body, interfaces, first)
            if dropped_before:
                number = packet.interface
                dropped_between[number] = dropped_between.get(number, 0) + dropped_before
                dropped[number] = max(dropped.get(number, 0), dropped_between[number])
            yield packet
        elif kind == _STATISTICS:
            number = first + struct.unpack_from(f"{order}I", body)[0]
            dropped[number] = max(dropped.get(number, 0), _dropped(order, body))
        elif kind == _SIMPLE:
            raise ValueError("a packet without a time (simple packet block)")
        elif kind == _OBSOLETE:
            raise ValueError("an obsolete packet block; convert the file with editcap")


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


def _dropped(order: str, body: bytes) -> int:
    """Return the packets that an interface's statistics call dropped, since the capture began."""
    options = _options(order, body[12:])
    return sum(_whole_number(order, options.get(code, b"")) for code in _DROPPED)


def _whole_number(order: str, value: bytes) -> int:
    """Return the number in an option of 64 bits; 0 if it is absent or has another size."""
    return int.from_bytes(value, "little" if order == "<" else "big") if len(value) == 8 else 0


def _packet(order: str, body: bytes, interfaces: list[_Interface], first: int) -> tuple[CapturedPacket, int]:
    """Return a packet, and how many the capture dropped before it."""
    number, high, low, captured_bytes, size_bytes = struct.unpack_from(f"{order}5I", body)
    if first + number >= len(interfaces):
        raise ValueError(f"a packet of interface {number}, which is not described")
    if 20 + captured_bytes > len(body):
        raise ValueError("a packet longer than its block; the file is damaged")
    interface = interfaces[first + number]
    t_ns = (high << 32 | low) * 10**9 // interface.ticks_per_s + interface.offset_ns
    options = _options(order, body[20 + captured_bytes + -captured_bytes % 4 :])
    flags = options.get(_FLAGS, b"")
    direction = struct.unpack(f"{order}I", flags)[0] & 3 if len(flags) == 4 else 0
    outbound = {1: False, 2: True}.get(direction)
    data = body[20 : 20 + captured_bytes]
    packet = CapturedPacket(t_ns, first + number, interface.link_type, outbound, data, size_bytes)
    return packet, _whole_number(order, options.get(_DROPPED_BEFORE, b""))
