"""Philippe, Essick, Dullerud, Jungers, Stability of discrete-time switching systems with constrained
switching sequences, Automatica 72, 2016: growth and worst cycle as in SwitchOnSafety.jl, PEDJ16s4.jl.

Either of two gains may fail, but not twice in succession; both fail only after success.
"""

import numpy as np
import pytest

from tests.oracles.switched_loops import SwitchedLoop

A, B, K = np.array([[0.94, 0.56], [0.14, 0.46]]), np.array([[0.0], [1.0]]), np.array([-0.49, 0.27])
WORKS = {1: [1, 1], 2: [0, 1], 3: [1, 0], 4: [0, 0]}
"""Which of the two gains work, by mode."""
EDGES = (123, 212, 131, 312, 231, 323, 331, 344, 431)
"""From node, to node, mode."""
CYCLE = [2, 1, 2, 3, 1, 1, 1, 1]


def test_growth_and_worst_cycle_are_the_published_ones() -> None:
    edges = [tuple(int(digit) for digit in str(number)) for number in EDGES]
    loop = SwitchedLoop([(v - 1, w - 1, A + B * (K * WORKS[mode])) for v, w, mode in edges])
    assert 0.9748171979372 <= loop.upper(5e-3) < 0.98
    growth, cycle = loop.fastest_cycle()
    assert growth == pytest.approx(0.9748171979372, abs=5e-13)
    modes = [EDGES[number] % 10 for number in cycle]
    assert CYCLE in [modes[i:] + modes[:i] for i in range(len(modes))]
