"""Named random streams: every random choice of a run comes from one of them.

A stream depends on its seed and its name only, so that (for example) the loss sequence of a link is
the same whatever the plant, the timing or the other links draw.
"""

import hashlib

import numpy as np


def stream(seed: int, *name: str) -> np.random.Generator:
    """Return the random stream called ``name`` under ``seed``.

    Args:
        seed: non-negative integer of the scenario.
        name: the stream's path, e.g. ``("netem", "update", "loss")``.

    Raises:
        ValueError: ``seed`` is negative or ``name`` is empty.
    """
    if not name:
        raise ValueError("a random stream needs a name")
    digest = hashlib.blake2b("\0".join(name).encode(), digest_size=16).digest()
    words = np.frombuffer(digest, dtype="<u4").tolist()
    return np.random.Generator(np.random.PCG64DXSM(np.random.SeedSequence(seed, spawn_key=words)))
