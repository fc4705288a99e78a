"""Depth-first search through all admissible loss patterns, many runs at a time."""

from collections.abc import Callable

from cosim.analysis.adversary.search_nodes import Nodes, PatternSearch, root, together
from noack.core.linear_systems import Vector

Ceiling = Callable[[Nodes], Vector]
"""Returns an upper bound on the value that the rest of each run can add, (N,)."""

_BLOCK = 4096


def search_tree(search: PatternSearch, most_nodes: int, ceiling: Ceiling | None = None) -> bool:
    """Search all patterns; return whether every one was covered within ``most_nodes`` nodes.

    The ``ceiling`` prunes branches that cannot exceed the largest value so far.

    Raises:
        TooManyEventsError: two events at the same time.
    """
    search.step, most_nodes, before = "all patterns", most_nodes + search.nodes, search.runs
    pile = [root(search.flow)]
    while pile and search.value < float("inf"):
        nodes = _top(pile)
        if ceiling is not None:
            nodes = nodes.take(nodes.value + ceiling(nodes) > search.value)
        if search.nodes + len(nodes.t_s) > most_nodes:
            return False
        if len(nodes.t_s):
            pile.append(search.successors(nodes))
    search.runs -= before  # each pattern counts once
    return True


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
