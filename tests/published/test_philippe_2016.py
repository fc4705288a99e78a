"""Philippe, Essick, Dullerud, Jungers, Stability of discrete-time switching systems with constrained
switching sequences, Automatica 72, 2016: growth and worst cycle as in SwitchOnSafety.jl, PEDJ16s4.jl.

Either of two gains may fail, but not twice in succession; both fail only after success.
"""

import numpy as np
import pytest

from noack.theory.margins.exact_matrices import exactly
from noack.theory.margins.joint_spectral_radius import joint_spectral_radius
from noack.theory.margins.switched_system import Edge

A, B, K = np.array([[0.94, 0.56], [0.14, 0.46]]), np.array([[0.0], [1.0]]), np.array([-0.49, 0.27])
WORKS = {1: [1, 1], 2: [0, 1], 3: [1, 0], 4: [0, 0]}
"""Which of the two gains work, by mode."""
EDGES = (123, 212, 131, 312, 231, 323, 331, 344, 431)
"""From node, to node, mode."""
CYCLE = [2, 1, 2, 3, 1, 1, 1, 1]


def test_growth_and_worst_cycle_are_the_published_ones() -> None:
    edges = []
    for source, target, mode in (map(int, str(number)) for number in EDGES):
        edges.append(Edge(source, target, exactly(A + B * (K * WORKS[mode]))))
    radius = joint_spectral_radius(edges, accuracy=1e-11)
    assert radius.lower == pytest.approx(0.9748171979372, abs=5e-13)
    assert radius.upper == pytest.approx(0.9748171979372, abs=5e-11)
    modes = [EDGES[number] % 10 for number in radius.cycle]
    assert CYCLE in [modes[i:] + modes[:i] for i in range(len(modes))]
