"""A loop whose gains may fail, but not as they like (Philippe, Essick, Dullerud, Jungers, 2016)."""

import numpy as np

from cosim.studies.paper.published_result import ComparedValue, PublishedResult, value_row
from noack.theory.margins.exact_matrices import exactly
from noack.theory.margins.joint_spectral_radius import joint_spectral_radius
from noack.theory.margins.switched_system import Edge

_A, _B, _K = [[0.94, 0.56], [0.14, 0.46]], [[0.0], [1.0]], [-0.49, 0.27]
_WORKS = {1: [1, 1], 2: [0, 1], 3: [1, 0], 4: [0, 0]}
"""Which of the two gains work, by mode."""
_EDGES = (123, 212, 131, 312, 231, 323, 331, 344, 431)
"""From node, to node, mode."""
_SOURCE, _RADIUS = "library's test", 0.9748171979372
"""Published growth per step, and where it stands."""
_CYCLE = (2, 1, 2, 3, 1, 1, 1, 1)
"""The modes of the published cycle that grows most."""
_METHOD = "by noack margin's enclosures: a cycle from below, invariant polytopes from above"


def edges() -> list[Edge]:
    """Return the system: either gain may fail, not twice in succession; both only after success."""
    edges = []
    for text in map(str, _EDGES):
        source, target, mode = map(int, text)
        matrix = np.array(_A) + np.array(_B) * (np.array(_K) * _WORKS[mode])
        edges.append(Edge(source, target, exactly(matrix)))
    return edges


def _rows() -> list[ComparedValue]:
    radius = joint_spectral_radius(edges(), accuracy=1e-11)
    modes = [_EDGES[number] % 10 for number in radius.cycle]
    rotated = [tuple(modes[i:] + modes[:i]) for i in range(len(modes))]
    computed_cycle = _CYCLE if _CYCLE in rotated else rotated[0]
    published, computed = (",".join(map(str, cycle)) for cycle in (_CYCLE, computed_cycle))
    return [
        value_row("growth, lower bound", _SOURCE, _RADIUS, radius.lower, _METHOD, digits=12),
        value_row("growth, upper bound", _SOURCE, _RADIUS, radius.upper, _METHOD, digits=10),
        ComparedValue("its modes", _SOURCE, "=", published, computed, _METHOD, _CYCLE in rotated),
    ]


RESULT = PublishedResult(
    about="growth of a loop whose gains fail, under every allowed sequence of failures",
    reference="Philippe, Essick, Dullerud, Jungers, Stability of discrete-time switching systems "
    "with constrained switching sequences, Automatica 72, 2016; value: github.com/blegat/"
    "SwitchOnSafety.jl",
    rows=_rows,
    notes=("not available: the paper's text; the value is from a test of that library, PEDJ16s4.jl",),
)
