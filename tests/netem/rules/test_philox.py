"""Known answers of Philox, and statistical tests of the random numbers that netem uses."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from noack.core.core_library import core, ffi
from noack.core.random_streams import uniform_pair

ONES = 0xFFFFFFFF
WORDS = st.integers(0, ONES)


def philox(c0: int, c1: int, c2: int, c3: int, k0: int, k1: int) -> tuple[int, ...]:
    words = ffi.new("int64_t[4]")
    core.noack_philox([c0, c1, c2, c3], [k0, k1], words)
    return tuple(words)


def test_the_known_answers_of_random123() -> None:
    """From kat_vectors of the authors' library: zeros, ones, digits of pi."""
    assert philox(*[0] * 6) == (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)
    assert philox(*[ONES] * 6) == (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)
    pi = (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344, 0xA4093822, 0x299F31D0)
    assert philox(*pi) == (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1)


@given(WORDS, WORDS, WORDS, st.integers(0, 2**63 - 1), st.integers(0, 3))
def test_uniform_numbers_are_the_words_of_the_counter(
    key0: int, key1: int, flow: int, packet: int, block: int
) -> None:
    a, b, c, d = philox(packet & ONES, packet >> 32, flow, block, key0, key1)
    expected = tuple(((x << 32 | y) >> 11) / 2**53 for x, y in ((a, b), (c, d)))
    found = uniform_pair(key0, key1, flow, packet, block)
    assert all(0 <= u < 1 and u * 2**53 == int(u * 2**53) for u in found)
    # Upper 27 bits: from the first word; lower 26 bits: the upper bits of the second word.
    for u, (x, y) in zip(found, ((a, b), (c, d)), strict=True):
        assert divmod(int(u * 2**53), 2**26) == (x >> 5, y >> 6)
    assert np.allclose(found, expected, rtol=0, atol=2**-27)
