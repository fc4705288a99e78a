import hashlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from noack.config.fleet_layout import LOOP, STRIDE
from noack.protocol.wire_format import Decoder, Encoder, Flow, Message, Rejection
from noack.runtime.fleet.driver_layout import WIRE, WireMemory
from noack.runtime.fleet.wire_words import (
    REASONS,
    complete_datagram,
    compute_tag,
    keyed_state,
    loop_of_datagram,
)

KEY, RUN_ID, LOOPS, NEWEST = bytes(range(7, 39)), 2**64 - 3, 5, 40


def wire() -> WireMemory:
    settings = np.zeros(1, WIRE)
    settings["sends"] = int.from_bytes(b"NA\1\2\2\0", "little")
    settings["run_id"] = np.uint64(RUN_ID).view(np.int64)
    settings["entries_sent"] = settings["entries_received"] = 2
    settings["flow_received"] = Flow.UPDATE
    blank = np.zeros(8, np.uint64), np.zeros(16, np.uint64)
    return WireMemory(settings.view(np.recarray), keyed_state(KEY), *blank)


@given(st.lists(st.integers(-(2**63), 2**63 - 1), min_size=4, max_size=70))
def test_the_tag_is_keyed_blake2b(words: list[int]) -> None:
    content, memory = np.array(words, np.int64), wire()
    with np.errstate(over="ignore"):
        compute_tag(memory.keyed, content, 0, len(words), memory.chain, memory.block)
    expected = hashlib.blake2b(content.tobytes(), key=KEY, digest_size=16).digest()
    assert memory.chain[:2].tobytes() == expected


def examined(datagram: bytes, *, from_peer: bool = True) -> int | Rejection:
    words = np.frombuffer(datagram[: 8 * STRIDE].ljust(8 * STRIDE, b"\0"), np.int64).copy()
    loops = np.zeros(LOOPS, LOOP).view(np.recarray)
    loops.newest = NEWEST
    with np.errstate(over="ignore"):
        found = loop_of_datagram(
            wire(), loops, words, words.view(np.float64), 0, len(datagram), from_peer
        )
    return found if found >= 0 else REASONS[-1 - found]


vectors = st.lists(st.floats(), min_size=1, max_size=3).map(np.array)


@given(
    st.sampled_from([Flow.UPDATE, Flow.MEASUREMENT]), st.integers(NEWEST - 2, 2**64 - 1),
    st.integers(-5, 2**63 - 1), vectors, st.integers(0, LOOPS),
    st.none() | st.integers(0, 8 * 64 - 1), st.integers(0, 3), st.booleans(),
)  # fmt: skip
def test_a_datagram_is_judged_as_by_the_decoder(
    flow: Flow, sequence: int, t_ns: int, vector: np.ndarray, loop: int, bit: int | None,
    cut: int, from_peer: bool,
) -> None:  # fmt: skip
    encoder = Encoder(RUN_ID, KEY)
    datagram = bytearray(encoder.encode(Message(flow, sequence, t_ns, vector, loop)))
    if bit is not None and bit // 8 < len(datagram):
        datagram[bit // 8] ^= 1 << bit % 8
    data = bytes(datagram[: len(datagram) - cut])
    claimed = int.from_bytes(data[6:8], "little")
    decoder = Decoder(Flow.UPDATE, 2, RUN_ID, KEY, loop=claimed if claimed < LOOPS else 0)
    decoder._newest = NEWEST
    accepted = decoder.decode(data, from_peer=from_peer)
    (reason,) = [one for one, n in decoder.rejected.items() if n] or [None]
    assert examined(data, from_peer=from_peer) == (claimed if accepted is not None else reason)


@pytest.mark.parametrize("loop", [0, 4])
def test_a_datagram_is_that_of_the_encoder(loop: int) -> None:
    message = Message(Flow.UPDATE, 2**63 - 1, 2**62 - 1, np.array([-0.0, 1e-310]), loop)
    words = np.zeros(8, np.int64)
    words[2:4] = message.sequence, message.t_ns
    words.view(np.float64)[4:6] = message.vector
    with np.errstate(over="ignore"):
        complete_datagram(wire(), words, 0, loop)
    assert words.tobytes() == Encoder(RUN_ID, KEY).encode(message)
