"""Random streams, numbers as text, and arrays of the core's structures."""

import gc
import hashlib
import math

import numpy as np
import pytest

from netem.core.core_library import _ARRAYS, reals_at, set_fields
from netem.core.number_format import at_least, at_most, plus_minus
from netem.core.random_streams import stream, stream_key, stream_keys, uniforms, words
from noack.core.core_library import ffi, new_structure


def test_a_stream_is_the_documented_generator() -> None:
    """NumPy's PCG64DXSM, seeded by the seed and a hash of the name; the same on every machine."""
    digest = hashlib.blake2b(b"netem\0update\0loss\0" + b"0", digest_size=16).digest()
    key = [int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4)]
    by_hand = np.random.PCG64DXSM(np.random.SeedSequence(2, spawn_key=key))
    generator = stream(2, "netem", "update", "loss", "0").bit_generator
    np.testing.assert_array_equal(generator.random_raw(5), by_hand.random_raw(5))
    # The expected numbers are constants: a seed gives the same draws in every version.
    numbers = stream(2, "netem", "update", "loss", "0").random(3)
    assert numbers.tolist() == [0.676940330421062, 0.34315593350369966, 0.8542103866233243]
    with pytest.raises(ValueError, match="needs a name"):
        stream(0)


def test_a_streams_key_is_the_seed_sequences_state() -> None:
    """Two words of the state that seeds the stream of that name; the expected values are fixed."""
    digest = hashlib.blake2b(b"netem\0a\0loss", digest_size=16).digest()
    key = [int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4)]
    words = np.random.SeedSequence(2, spawn_key=key).generate_state(2)
    assert stream_key(2, "netem", "a", "loss") == tuple(words.tolist())
    assert stream_key(2, "netem", "a", "loss") == (0xA1E54851, 0x9C1E9ED0)
    assert all(type(word) is int for word in stream_key(2, "netem", "a", "loss"))


def test_a_row_of_a_table_does_not_depend_on_the_requested_rows() -> None:
    whole = words(7, "a", "table", rows=range(100), width=6)
    assert whole.shape == (100, 6)
    for rows in (range(1), range(37, 41), range(99, 100)):
        some = words(7, "a", "table", rows=rows, width=6)
        np.testing.assert_array_equal(some, whole[rows.start : rows.stop])
    assert words(7, "a", "table", rows=range(0), width=6).shape == (0, 6)
    assert len(np.unique(whole)) == 600
    for other in (words(8, "a", "table", rows=range(100), width=6),
                  words(7, "another", rows=range(100), width=6)):  # fmt: skip
        assert (whole != other).all()


def test_a_table_equals_the_generators_sequence() -> None:
    low, high = stream_key(7, "t")
    sequence = np.random.Generator(np.random.Philox(key=low | high << 32)).random(40)
    np.testing.assert_array_equal(uniforms(7, "t", rows=range(10), width=4).ravel(), sequence)


def test_keys_computed_together_equal_single_keys() -> None:
    seeds = [0, 1, 2**32 - 1, 2**32, 2**64 - 1, *range(7, 2**63, 2**58)]
    for path in (("netem", "a", "loss"), ("b",)):
        keys = stream_keys(np.array(seeds, np.uint64), *path)
        assert keys.tolist() == [list(stream_key(seed, *path)) for seed in seeds]
    assert stream_keys(np.array([], np.uint64), "a").shape == (0, 2)


# --- numbers as text ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mean", "halfwidth", "written"),
    [
        (36.0, 16.2, "36 ± 16"),
        (-0.2496, 3.4, "−0.2 ± 3.4"),
        (9.97, 0.996, "10.0 ± 1.0"),
        (1.23456e9, 2.34e7, "1.235e+09 ± 2.3e+07"),
        (3.14159, math.inf, "3.142"),
        (0.05, 2.5e-15, "0.05"),  # rounding
        (math.nan, 1.0, "nan"),
    ],
)
def test_a_mean_has_as_many_digits_as_its_interval_supports(
    mean: float, halfwidth: float, written: str
) -> None:
    assert plus_minus(mean, halfwidth) == written


# --- structures with arrays ------------------------------------------------------------------------


def test_arrays_are_copies_that_live_with_their_structure() -> None:
    given = np.arange(6.0).reshape(2, 3).T
    numbers = {"changes": 2, "hz": given, "since_ns": np.array([3, -1]), "is_zero": None}
    structure = new_structure("noack_reference", numbers)
    shown = reals_at(structure.hz, 3, 2)
    given[:] = 0
    gc.collect()
    assert shown.tolist() == [[0.0, 3.0], [1.0, 4.0], [2.0, 5.0]]
    assert (structure.since_ns[0], structure.since_ns[1], structure.changes) == (3, -1, 2)
    assert structure.is_zero == ffi.NULL
    shown[0, 1] = 7.0  # shares the memory
    assert structure.hz[1] == 7.0
    assert len(_ARRAYS[structure]) == 2
    arrays = len(_ARRAYS)
    del structure
    assert len(_ARRAYS) == arrays - 1


def test_fields_of_inner_structures_are_set_and_replaced() -> None:
    plant = new_structure("noack_plant", {"machine": {"n": 3, "period": (5, 0, 1)}, "x": np.ones(3)})
    set_fields(plant, {"x": np.full(3, 2.0), "noise": {"width": 1}})
    assert (plant.machine.n, plant.machine.period.ns, plant.x[2], plant.noise.width) == (3, 5, 2.0, 1)


@pytest.mark.parametrize(("value", "most", "least"), [
    (1.23401, "1.235", "1.234"), (1.23399, "1.234", "1.233"), (0.1, "0.1", "0.1"),
    (-1.23401, "-1.234", "-1.235"),
    (1 + 2e-16, "1", "1"), (99999.5, "1e+05", "9.999e+04"), (0.0, "0", "0"), (math.inf, "inf", "inf"),
    (None, "-", "-"),
])  # fmt: skip
def test_a_bound_is_rounded_away_from_what_it_bounds(value: float | None, most: str, least: str) -> None:
    assert (at_most(value), at_least(value)) == (most, least)
