"""Datagrams from outside: random, authentic but malformed, modified by an attacker."""

import struct

import numpy as np

from noack.protocol.wire_format import Encoder, Flow, Message, loop_number, read_header
from tests.fuzz.edits import Choices
from tests.helpers.wire_decoder import Decoder
from tests.oracles.wire import KEY, RUN, BothReceivers, tag


def wire_input(choices: Choices) -> None:
    """Both receivers agree; what they accept is encoded to the same bytes again."""
    _junk(choices.choose((b"", b"NA", b"NA\1")) + choices.junk())
    dimension = 1 + choices.below(4)
    flow = choices.choose([Flow.MEASUREMENT, Flow.UPDATE, Flow.ACTUATION, Flow.ACKNOWLEDGEMENT])
    if flow is Flow.ACKNOWLEDGEMENT:
        dimension = 0
    receivers, encoder, seen = BothReceivers(flow, dimension, run_id=RUN), Encoder(RUN, KEY), b""
    for _ in range(20):
        if not choices.more():
            return
        odd = choices.below(4) == 0
        datagram = _odd(choices, dimension) if odd else _sound(choices, encoder, flow, dimension)
        from_peer = choices.below(4) != 0
        match choices.below(4):
            case 1:
                datagram = seen or datagram
            case 2:
                datagram = _changed(choices, datagram)
        receivers.examine(datagram, from_peer=from_peer)
        if receivers.message is not None:
            seen = datagram
            assert encoder.encode(receivers.message) == datagram


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
    return encoder.encode(Message(flow, sequence, t_ns, vector, error_level=choices.choose([0, 128])))


def _odd(choices: Choices, dimension: int) -> bytes:
    """Return a datagram with the correct key but any header or any content length."""
    magic, version = choices.choose([b"NA", b"NB", b"\0\0"]), choices.choose([1, 0, 2, 255])
    flow, n = choices.choose([1, 2, 3, 4, 0, 5, 255]), choices.choose([dimension, 0, 1, 64, 65, 255])
    loop, run = choices.choose([0, 1, 65_535]), choices.choose([RUN, RUN ^ 1, 0])
    level = choices.choose([0, 1, 255])
    sequence, t_ns = choices.integer() % 2**64, choices.integer() % 2**63
    numbers = choices.choose([dimension, n % 65, 0])
    content = struct.pack("<2sBBBBHQQq", magic, version, flow, n, level, loop, run, sequence, t_ns)
    content += struct.pack(f"<{numbers}d", *(choices.real() for _ in range(numbers)))
    content += choices.take(choices.choose([0, 0, 1, 8]))
    return content + tag(content)


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


PARSERS = {
    "wire": wire_input,
}
