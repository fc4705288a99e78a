"""Datagrams: random, authentic, authentic but malformed, and modified by an attacker."""

import hashlib
import math
import struct

import numpy as np

from noack.protocol.wire_format import Encoder, Flow, Message, loop_number, read_header
from tests.fuzz.choices import Choices
from tests.wire_decoder import Decoder

KEY = bytes(range(32))
RUN = 0x0123_4567_89AB_CDEF
WORDS = (b"NA\x01", struct.pack("<Q", RUN))


def one_input(data: bytes) -> None:
    _junk(data)
    choices = Choices(data)
    dimension = 1 + choices.below(4)
    flow = choices.one([Flow.MEASUREMENT, Flow.UPDATE, Flow.ACTUATION, Flow.ACKNOWLEDGEMENT])
    if flow is Flow.ACKNOWLEDGEMENT:
        dimension = 0
    decoder, encoder = Decoder(flow, dimension, RUN, KEY), Encoder(RUN, KEY)
    newest, accepted, seen = -1, 0, b""
    for count in range(1, 21):
        if not choices.left:
            return
        odd = choices.below(4) == 0
        datagram = _odd(choices, dimension) if odd else _sound(choices, encoder, flow, dimension)
        from_peer = choices.below(4) != 0
        match choices.below(4):
            case 1:
                datagram = seen or datagram
            case 2:
                datagram = _changed(choices, datagram)
        message = decoder.decode(datagram, from_peer=from_peer)
        expected = from_peer and _is_sound(datagram, flow, dimension, newest)
        assert (message is not None) == expected
        accepted += expected
        assert (decoder.accepted, sum(decoder.rejected.values())) == (accepted, count - accepted)
        if message is not None:
            assert message.sequence > newest
            newest, seen = message.sequence, datagram
            assert encoder.encode(message) == datagram


def _junk(data: bytes) -> None:
    """Without the key, no datagram is accepted."""
    loop_number(data)
    header = read_header(data)
    assert (header is None) == (len(data) < 32 or data[:2] != b"NA")
    for flow in Flow:
        assert Decoder(flow, min(max(len(data) - 48, 0) // 8, 64), RUN, KEY).decode(data) is None


def _sound(choices: Choices, encoder: Encoder, flow: Flow, dimension: int) -> bytes:
    """Return a datagram that a process of the run may send, or nearly so."""
    sequence, t_ns = choices.integer() % 2**64, choices.integer()
    t_ns = (t_ns + 2**63) % 2**64 - 2**63
    vector = np.array([choices.real() for _ in range(dimension)])
    return encoder.encode(Message(flow, sequence, t_ns, vector))


def _odd(choices: Choices, dimension: int) -> bytes:
    """Return a datagram with the correct key but any header or any content length."""
    magic, version = choices.one([b"NA", b"NB", b"\0\0"]), choices.one([1, 0, 2, 255])
    flow, n = choices.one([1, 2, 3, 4, 0, 5, 255]), choices.one([dimension, 0, 1, 64, 65, 65_535])
    loop, run = choices.one([0, 1, 65_535]), choices.one([RUN, RUN ^ 1, 0])
    sequence, t_ns = choices.integer() % 2**64, choices.integer() % 2**63
    numbers = choices.one([dimension, n % 65, 0])
    content = struct.pack("<2sBBHHQQq", magic, version, flow, n, loop, run, sequence, t_ns)
    content += struct.pack(f"<{numbers}d", *(choices.real() for _ in range(numbers)))
    content += choices.take(choices.one([0, 0, 1, 8]))
    return content + _tag(content)


def _changed(choices: Choices, datagram: bytes) -> bytes:
    """Return the datagram with a bit flipped, truncated or extended."""
    match choices.below(3):
        case 0:
            bit = choices.below(8 * len(datagram))
            number = int.from_bytes(datagram, "little") ^ (1 << bit)
            return number.to_bytes(len(datagram), "little")
        case 1:
            return datagram[: choices.below(len(datagram))]
        case _:
            return datagram + choices.take(1 + choices.below(16))


def _tag(content: bytes) -> bytes:
    return hashlib.blake2b(content, key=KEY, digest_size=16).digest()


def _is_sound(datagram: bytes, flow: Flow, dimension: int, newest: int) -> bool:
    """Whether a datagram must be accepted according to ``docs/wire.md``."""
    if len(datagram) != 48 + 8 * dimension or _tag(datagram[:-16]) != datagram[-16:]:
        return False
    magic, version, kind, n, loop, run, sequence, t_ns = struct.unpack_from("<2sBBHHQQq", datagram)
    vector = struct.unpack_from(f"<{dimension}d", datagram, 32)
    return (
        (magic, version, kind, n, loop, run) == (b"NA", 1, flow.value, dimension, 0, RUN)
        and newest < sequence < 2**63
        and 0 <= t_ns < 2**62
        and all(math.isfinite(entry) for entry in vector)
    )
