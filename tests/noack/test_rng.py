import hashlib
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from noack.rng import stream

seeds = st.integers(0, 2**64 - 1)
names = st.lists(st.text("abc/", max_size=4), min_size=1, max_size=4)


@given(seeds, names)
def test_a_stream_is_fixed_by_its_seed_and_name(seed: int, name: list[str]) -> None:
    first, again = stream(seed, *name), stream(seed, *name)
    other = stream(seed, "something", "else")
    other.random(100)  # drawing from one leaves the others alone
    assert first.random(20).tobytes() == again.random(20).tobytes()


def test_a_stream_is_what_it_is_documented_to_be() -> None:
    """NumPy's PCG64DXSM, seeded by the seed and a hash of the name: the same everywhere, always."""
    digest = hashlib.blake2b(b"netem\0update\0loss\0" + b"0", digest_size=16).digest()
    key = [int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4)]
    by_hand = np.random.PCG64DXSM(np.random.SeedSequence(2, spawn_key=key))
    found = stream(2, "netem", "update", "loss", "0").bit_generator
    np.testing.assert_array_equal(found.random_raw(5), by_hand.random_raw(5))


def test_the_numbers_of_published_runs_stay_the_same() -> None:
    """Written down once: a scenario's seeds must mean the same draws in every later version."""
    found = stream(2, "netem", "update", "loss", "0").random(3)
    assert found.tolist() == [0.676940330421062, 0.34315593350369966, 0.8542103866233243]


def test_other_seeds_and_names_give_other_numbers() -> None:
    paths = [("a",), ("b",), ("a", "b"), ("ab",), ("a", ""), ("", "a"), ("plant",)]
    seeds = [0, 1, 2, 2**32, 2**32 + 1, 2**64 - 1]
    firsts = {stream(seed, *path).random() for seed, path in itertools.product(seeds, paths)}
    assert len(firsts) == len(seeds) * len(paths)


def test_neighbouring_streams_are_uncorrelated() -> None:
    draws = np.array([stream(0, "loss", str(k)).random(20_000) for k in range(8)])
    correlation = np.corrcoef(draws) - np.eye(8)
    assert np.abs(correlation).max() < 5 / np.sqrt(20_000)  # five standard errors


def test_a_nameless_stream_or_a_negative_seed_is_refused() -> None:
    with pytest.raises(ValueError, match="needs a name"):
        stream(0)
    with pytest.raises(ValueError, match="non-negative"):
        stream(-1, "a")
