"""All admissible patterns: depth first over the decision at every event, many runs at a time."""

from collections.abc import Callable

import numpy as np

from cosim.analysis.adversary.search_nodes import (
    Best,
    DecisionLog,
    Nodes,
    Report,
    WorstPatternFound,
    branches,
    root,
    together,
)
from cosim.analysis.adversary.segments import SegmentFlow
from noack.core.linear_systems import Vector

Ceiling = Callable[[Nodes], Vector]
"""An upper bound of what the rest of each run can add to its value, (N,)."""

_BLOCK = 4096


def search_tree(
    flow: SegmentFlow,
    mansd: int,
    most_nodes: int,
    *,
    known: float = -np.inf,
    ceiling: Ceiling | None = None,
    report: Report = lambda nodes, value: None,
) -> WorstPatternFound:
    """Look for the largest value over all patterns with at most ``mansd`` consecutive losses.

    Args:
        flow: the loop with its objective.
        mansd: M − 1.
        most_nodes: the search stops beyond.
        known: a value that is reached for sure: what cannot exceed it is left out.
        ceiling: lets branches be left out that cannot exceed the best.
        report: receives the progress.

    Raises:
        TooManyEventsError: two events at the same time.
    """
    log, best, pile = DecisionLog(), Best(flow, known), [root(flow)]
    visited = 0
    while pile and best.value < np.inf:
        nodes = _top(pile)
        if ceiling is not None:
            nodes = nodes.take(nodes.value + ceiling(nodes) > best.value)
        if visited + len(nodes.t_s) > most_nodes:
            return best.found(log, visited, complete=False)
        if not len(nodes.t_s):
            continue
        segments = flow(nodes.t_s, nodes.z, best.value)
        value = best.see(nodes, segments)
        following = branches(nodes, segments, value, mansd, log)
        if len(following.t_s):
            pile.append(following)
        visited += len(nodes.t_s)
        report(visited, best.value)
    return best.found(log, visited, complete=True)


def _top(pile: list[Nodes]) -> Nodes:
    """Take a block of nodes off the pile, the deepest first."""
    parts, room = [], _BLOCK
    while pile and room > 0:
        nodes = pile.pop()
        if len(nodes.t_s) > room:
            pile.append(nodes.take(slice(None, -room)))
            nodes = nodes.take(slice(-room, None))
        parts.append(nodes)
        room -= len(nodes.t_s)
    return together(parts)
