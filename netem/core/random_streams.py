"""Named random streams: every random choice of a run comes from one of them.

A stream depends on its seed and its name only. So the loss sequence of a link, for example, does
not depend on the random numbers of the plant, the timing or other links.
"""

import hashlib
import struct
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from netem.core.core_library import core, ffi


def stream(seed: int, *name: str) -> "np.random.Generator":
    """Return the random stream of this path, e.g. ``("netem", "update", "loss")``, under a seed.

    Raise ValueError if the seed is negative or the path is empty.
    """
    return np.random.Generator(np.random.PCG64DXSM(_sequence(seed, name)))


def words(seed: int, *name: str, rows: range, width: int) -> NDArray[np.uint64]:
    """Return ``rows`` of a random table as words of 64 bits, shape (k, width).

    Each row depends on its number only: Philox4x64 is counter-based and computes any row directly.
    """
    blocks = -(-width // 4)
    low, high = stream_key(seed, *name)
    table = np.random.Philox(key=low | high << 32, counter=rows.start * blocks)
    values = table.random_raw(len(rows) * blocks * 4)
    return np.asarray(values).reshape(len(rows), blocks * 4)[:, :width]


def uniforms(seed: int, *name: str, rows: range, width: int) -> NDArray[np.float64]:
    """Return rows of a table of numbers uniform in [0, 1); see :func:`words`."""
    return np.asarray((words(seed, *name, rows=rows, width=width) >> np.uint64(11)) * 2.0**-53)


def normals(seed: int, *name: str, rows: range, width: int) -> NDArray[np.float64]:
    """Return rows of a table of standard normal numbers; see :func:`words`.

    They are computed by inversion of the distribution function, so each uses exactly one word.
    """
    # Imported here because the import is slow and few programs need normal numbers.
    from scipy.special import ndtri

    centred = uniforms(seed, *name, rows=rows, width=width) + 2.0**-54
    return np.asarray(ndtri(np.minimum(centred, 1 - 2.0**-53)))


def uniform_pair(key0: int, key1: int, flow: int = 0, packet: int = 0, block: int = 0) -> tuple[float, float]:
    """Return two numbers in [0, 1) of a datagram, as the core draws them; see native/network/random.c."""
    pair = ffi.new("double[2]")
    core.noack_uniforms(key0, key1, flow, packet, block, pair)
    return pair[0], pair[1]


def stream_key(seed: int, *name: str) -> tuple[int, int]:
    """Return the key of a counter-based random stream (:func:`stream`): two words of 32 bits."""
    low, high = _sequence(seed, name).generate_state(2).tolist()
    return low, high


def stream_keys(seeds: NDArray[np.uint64], *name: str) -> NDArray[np.int64]:
    """Return the keys of :func:`stream_key` under k seeds below 2⁶⁴ at once, shape (k, 2)."""
    return _keys(seeds, np.array(_words(name), np.uint32)[:, None])


def named_stream_keys(seeds: Sequence[int], names: Sequence[tuple[str, ...]]) -> NDArray[np.int64]:
    """Return the key of :func:`stream_key` of each seed below 2⁶⁴ and name, shape (k, 2)."""
    return _keys(np.array(seeds, np.uint64), np.array([*map(_words, names)], np.uint32).T)


def _keys(seeds: NDArray[np.uint64], names: NDArray[np.uint32]) -> NDArray[np.int64]:
    # numpy's SeedSequence for many seeds at once. A seed below 2¹²⁸ is four words of entropy.
    entropy = np.zeros((8, len(seeds)), np.uint32)
    entropy[0] = seeds & np.uint64(0xFFFFFFFF)
    entropy[1] = seeds >> np.uint64(32)
    entropy[4:] = names
    entropy_hash = _Hash(0x43B0D7E5, 0x931E8875)
    pool = [entropy_hash(word) for word in entropy[:4]]
    for source in range(4):
        for into in range(4):
            if source != into:
                pool[into] = _mixed(pool[into], entropy_hash(pool[source]))
    for word in entropy[4:]:
        for into in range(4):
            pool[into] = _mixed(pool[into], entropy_hash(word))
    output_hash = _Hash(0x8B51F9DD, 0x58F38DED)
    return np.stack([output_hash(pool[0]), output_hash(pool[1])], axis=1).astype(np.int64)


class _Hash:
    """SeedSequence's hash of words of 32 bits; its constant changes with each use."""

    def __init__(self, constant: int, factor: int) -> None:
        self._constant, self._factor = constant, factor

    def __call__(self, values: NDArray[np.uint32]) -> NDArray[np.uint32]:
        values = values ^ np.uint32(self._constant)
        self._constant = self._constant * self._factor & 0xFFFFFFFF
        values *= np.uint32(self._constant)
        values ^= values >> np.uint32(16)
        return values


def _mixed(a: NDArray[np.uint32], b: NDArray[np.uint32]) -> NDArray[np.uint32]:
    values = a * np.uint32(0xCA01F9DD) - b * np.uint32(0x4973F715)
    values ^= values >> np.uint32(16)
    return values


def _sequence(seed: int, name: tuple[str, ...]) -> "np.random.SeedSequence":
    return np.random.SeedSequence(seed, spawn_key=_words(name))


@lru_cache(4096)
def _words(name: tuple[str, ...]) -> tuple[int, ...]:
    if not name:
        raise ValueError("a random stream needs a name")
    digest = hashlib.blake2b("\0".join(name).encode(), digest_size=16).digest()
    return struct.unpack("<4I", digest)
