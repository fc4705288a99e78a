"""The wire format on words of 8 bytes, with its keyed BLAKE2b (RFC 7693), for compiled code.

It does what :mod:`noack.protocol.wire_format` does, for the datagrams of many loops.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noack.config.fleet_layout import HEADER_WORDS
from noack.protocol.datagram_seal import KEY_BYTES, TAG_BYTES
from noack.protocol.wire_format import (
    HEADER_BYTES,
    MAGIC,
    SEQUENCES,
    TIMES_NS,
    VERSION,
    Rejection,
)

_PREFIX = int.from_bytes(MAGIC, "little") | VERSION << 16
_BLOCK_BYTES = 128
_BLOCK_WORDS = 16
REASONS = tuple(Rejection)
"""The reasons for a rejection; compiled code returns −1 − its place here."""
(_LENGTH, _VERSION, _RUN, _FLOW, _LOOP, _TAG, _SOURCE, _RANGE, _STALE, _NOT_FINITE) = (
    -1 - REASONS.index(reason)
    for reason in (
        Rejection.LENGTH, Rejection.VERSION, Rejection.RUN, Rejection.FLOW, Rejection.LOOP,
        Rejection.TAG, Rejection.SOURCE, Rejection.RANGE, Rejection.STALE, Rejection.NOT_FINITE,
    )
)  # fmt: skip

_START = np.array(
    [
        0x6A09E667F3BCC908, 0xBB67AE8584CAA73B, 0x3C6EF372FE94F82B, 0xA54FF53A5F1D36F1,
        0x510E527FADE682D1, 0x9B05688C2B3E6C1F, 0x1F83D9ABFB41BD6B, 0x5BE0CD19137E2179,
    ],
    np.uint64,
)  # fmt: skip
_ORDER = np.array(
    [
        [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15],
        [14, 10, 4, 8, 9, 15, 13, 6, 1, 12, 0, 2, 11, 7, 5, 3],
        [11, 8, 12, 0, 5, 2, 15, 13, 10, 14, 3, 6, 7, 1, 9, 4],
        [7, 9, 3, 1, 13, 12, 11, 14, 2, 6, 5, 10, 4, 0, 15, 8],
        [9, 0, 5, 7, 2, 4, 10, 15, 14, 1, 11, 12, 6, 8, 3, 13],
        [2, 12, 6, 10, 0, 11, 8, 3, 4, 13, 7, 5, 15, 14, 1, 9],
        [12, 5, 1, 15, 14, 13, 4, 10, 0, 7, 6, 3, 9, 2, 8, 11],
        [13, 11, 7, 14, 12, 1, 3, 9, 5, 0, 15, 4, 8, 6, 2, 10],
        [6, 15, 14, 9, 11, 3, 0, 8, 12, 2, 13, 7, 1, 4, 10, 5],
        [10, 2, 8, 4, 7, 6, 1, 5, 15, 11, 9, 14, 3, 12, 13, 0],
    ],
    np.int64,
)
_ALL = np.uint64(0xFFFFFFFFFFFFFFFF)
_R32, _R24, _R16, _R63 = np.uint64(32), np.uint64(24), np.uint64(16), np.uint64(63)
_L40, _L48, _L1 = np.uint64(40), np.uint64(48), np.uint64(1)


def mix(a: Any, b: Any, c: Any, d: Any, one: Any, two: Any) -> Any:
    """BLAKE2b's function G."""
    a = a + b + one
    d = d ^ a
    d = (d >> _R32) | (d << _R32)
    c = c + d
    b = b ^ c
    b = (b >> _R24) | (b << _L40)
    a = a + b + two
    d = d ^ a
    d = (d >> _R16) | (d << _L48)
    c = c + d
    b = b ^ c
    b = (b >> _R63) | (b << _L1)
    return a, b, c, d


def compress(chain: Any, block: Any, hashed_bytes: Any, last: bool) -> None:
    """BLAKE2b's function F: add a block, (16,) words, to the state ``chain``, (8,)."""
    a0, a1, a2, a3 = chain[0], chain[1], chain[2], chain[3]
    b0, b1, b2, b3 = chain[4], chain[5], chain[6], chain[7]
    c0, c1, c2, c3 = _START[0], _START[1], _START[2], _START[3]
    d0, d1, d2, d3 = _START[4] ^ np.uint64(hashed_bytes), _START[5], _START[6], _START[7]
    if last:
        d2 = d2 ^ _ALL
    for turn in range(12):
        k = turn % 10
        a0, b0, c0, d0 = mix(a0, b0, c0, d0, block[_ORDER[k, 0]], block[_ORDER[k, 1]])
        a1, b1, c1, d1 = mix(a1, b1, c1, d1, block[_ORDER[k, 2]], block[_ORDER[k, 3]])
        a2, b2, c2, d2 = mix(a2, b2, c2, d2, block[_ORDER[k, 4]], block[_ORDER[k, 5]])
        a3, b3, c3, d3 = mix(a3, b3, c3, d3, block[_ORDER[k, 6]], block[_ORDER[k, 7]])
        a0, b1, c2, d3 = mix(a0, b1, c2, d3, block[_ORDER[k, 8]], block[_ORDER[k, 9]])
        a1, b2, c3, d0 = mix(a1, b2, c3, d0, block[_ORDER[k, 10]], block[_ORDER[k, 11]])
        a2, b3, c0, d1 = mix(a2, b3, c0, d1, block[_ORDER[k, 12]], block[_ORDER[k, 13]])
        a3, b0, c1, d2 = mix(a3, b0, c1, d2, block[_ORDER[k, 14]], block[_ORDER[k, 15]])
    chain[0] ^= a0 ^ c0
    chain[1] ^= a1 ^ c1
    chain[2] ^= a2 ^ c2
    chain[3] ^= a3 ^ c3
    chain[4] ^= b0 ^ d0
    chain[5] ^= b1 ^ d1
    chain[6] ^= b2 ^ d2
    chain[7] ^= b3 ^ d3


def keyed_state(key: bytes) -> NDArray[np.uint64]:
    """Return the state after the key, (8,)."""
    if len(key) != KEY_BYTES:
        raise ValueError(f"the run's key has {KEY_BYTES} bytes, not {len(key)}")
    chain = _START.copy()
    chain[0] ^= np.uint64(0x01010000 | KEY_BYTES << 8 | TAG_BYTES)
    with np.errstate(over="ignore"):  # sums are modulo 2⁶⁴
        compress(chain, np.frombuffer(key.ljust(_BLOCK_BYTES, b"\0"), "<u8"), _BLOCK_BYTES, False)
    return chain


def compute_tag(keyed: Any, words: Any, begin: int, count: int, chain: Any, block: Any) -> None:
    """Write the tag of ``count`` words to the first two words of ``chain``, (8,).

    ``block``, (16,), is overwritten.
    """
    for k in range(8):
        chain[k] = keyed[k]
    done = 0
    while True:
        taken = min(count - done, _BLOCK_WORDS)
        for k in range(taken):
            block[k] = np.uint64(words[begin + done + k])
        for k in range(taken, _BLOCK_WORDS):
            block[k] = np.uint64(0)
        done += taken
        compress(chain, block, _BLOCK_BYTES + 8 * done, done == count)
        if done == count:
            break


def complete_datagram(wire: Any, words: Any, begin: int, loop: int) -> None:
    """Write the header's first two words and the tag of a message whose rest is written."""
    settings = wire.settings[0]
    words[begin] = settings.sends | loop << 48
    words[begin + 1] = settings.run_id
    count = HEADER_WORDS + settings.entries_sent
    compute_tag(wire.keyed, words, begin, count, wire.chain, wire.block)
    words[begin + count] = np.int64(wire.chain[0])
    words[begin + count + 1] = np.int64(wire.chain[1])


def loop_of_datagram(
    wire: Any, loops: Any, words: Any, reals: Any, begin: int, size_bytes: int, from_peer: bool
) -> int:
    """Return the loop of a valid datagram, else −1 − the place of the reason in REASONS."""
    settings = wire.settings[0]
    entries = settings.entries_received
    count = HEADER_WORDS + entries
    if size_bytes < HEADER_BYTES:
        return _LENGTH
    first = words[begin]
    if first & 0xFFFFFF != _PREFIX:
        return _VERSION
    if size_bytes != 8 * count + TAG_BYTES or (first >> 32) & 0xFFFF != entries:
        return _LENGTH
    if words[begin + 1] != settings.run_id:
        return _RUN
    if (first >> 24) & 0xFF != settings.flow_received:
        return _FLOW
    loop = int((first >> 48) & 0xFFFF)
    if loop >= len(loops):
        return _LOOP
    compute_tag(wire.keyed, words, begin, count, wire.chain, wire.block)
    # Both words are compared in any case: the time must not depend on the first.
    wrong = np.int64(wire.chain[0]) ^ words[begin + count]
    wrong |= np.int64(wire.chain[1]) ^ words[begin + count + 1]
    if wrong != 0:
        return _TAG
    if not from_peer:
        return _SOURCE
    sequence, t_ns = words[begin + 2], words[begin + 3]
    if sequence < 0 or t_ns < 0 or t_ns >= TIMES_NS:  # numbers from SEQUENCES = 2⁶³ on are negative
        return _RANGE
    if sequence <= loops[loop].newest:
        return _STALE
    for k in range(begin + HEADER_WORDS, begin + count):
        if not math.isfinite(reals[k]):
            return _NOT_FINITE
    return loop


assert SEQUENCES == 2**63
