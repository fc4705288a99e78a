"""The motion of a plant's system, step by step."""

from collections.abc import Iterable
from typing import Any

import numpy as np

H_NS = 2_000_000


def motion(system: Any, inputs: Iterable[Any], h_ns: int = H_NS) -> np.ndarray:
    """x at the start and after each step, under one input per step, a number or a vector."""
    states = [system.x]
    for step, u in enumerate(inputs):
        system.advance(np.atleast_1d(u), step * h_ns, h_ns)
        states.append(system.x)
    return np.array(states)
