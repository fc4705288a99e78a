"""Depth-first search through all admissible loss patterns, many runs at a time."""

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
"""Returns an upper bound on the value that the rest of each run can add, (N,)."""

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
    """Search for the largest value over all patterns with at most ``mansd`` consecutive losses.

    Args:
        flow: the loop with its objective.
        mansd: M − 1.
        most_nodes: largest number of nodes; the search stops there.
        known: a value that some pattern reaches; branches that cannot exceed it are pruned.
        ceiling: bound for pruning branches that cannot exceed the largest value so far.
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
    """Pop a block of nodes from the stack, the deepest first."""
    parts, room = [], _BLOCK
    while pile and room > 0:
        nodes = pile.pop()
        if len(nodes.t_s) > room:
            pile.append(nodes.take(slice(None, -room)))
            nodes = nodes.take(slice(-room, None))
        parts.append(nodes)
        room -= len(nodes.t_s)
    return together(parts)
