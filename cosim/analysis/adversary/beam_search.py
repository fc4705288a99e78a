"""Beam search: if there are too many patterns, only the most promising of each kind are continued.

All runs pass through the same time windows. At the end of each window the runs are thinned out. Of
runs that nearly coincide, one remains. The runs are grouped by the state of the guarantee's
automaton and their part of the window; from each group first the best run is selected, then the
second best, and so on. One half of the selection ranks runs by their value so far, the other half
by their promise: what the loop would reach over the next window without events.
"""

import numpy as np

from cosim.analysis.adversary.pattern_flow import PatternFlow
from cosim.analysis.adversary.search_nodes import Indices, Nodes, PatternSearch, root, together
from noack.core.linear_systems import Vector

_ALIKE = 1e-4
_PARTS = 2
_CROWD = 8


def search_beam(search: PatternSearch, width: int, window_s: float) -> None:
    """Search for a large value; ``width`` runs continue from one window to the next.

    A window has about the length of an inter-event time.

    Raises:
        TooManyEventsError: two events at the same time.
    """
    search.step = "beam search"
    choice = _Choice(search.flow, window_s)
    waiting, until_s = root(search.flow), 0.0
    while len(waiting.t_s) and search.value < np.inf:
        until_s = max(until_s, float(waiting.t_s.min())) + window_s
        now = waiting.t_s < until_s
        active, later = waiting.take(now), [waiting.take(~now)]
        while len(active.t_s):
            following = search.successors(active)
            now = following.t_s < until_s
            later.append(following.take(~now))
            active = choice.thin(following.take(now), _CROWD * width)
        waiting = choice.thin(together(later), width)


class _Choice:
    """The selection of the runs that continue."""

    def __init__(self, flow: PatternFlow, window_s: float) -> None:
        self._flow, self._window_s = flow, window_s

    def thin(self, nodes: Nodes, width: int) -> Nodes:
        """Return at most ``width`` of the runs."""
        if len(nodes.t_s) <= width:
            return nodes
        nodes = nodes.take(self._distinct(nodes))
        kind = self._kind(nodes)
        promise = self._flow.promise(nodes.t_s, nodes.z, self._window_s)
        if self._flow.objective.additive:
            return nodes.take(_turns(nodes.value + promise, kind)[:width])
        by_value = _turns(nodes.value, kind, promise)[: width // 2]
        by_promise = _turns(promise, kind)
        chosen = np.concatenate([by_value, by_promise[~np.isin(by_promise, by_value)]])
        return nodes.take(chosen[:width])

    def _kind(self, nodes: Nodes) -> Indices:
        since_s = nodes.t_s - nodes.t_s.min()
        part = np.minimum(since_s * _PARTS / self._window_s, _PARTS).astype(int)
        return np.asarray(nodes.state * (_PARTS + 1) + part)

    def _distinct(self, nodes: Nodes) -> Indices:
        """Return, for each group of nearly equal runs, the one with the largest value."""
        alike = self._flow.features(nodes.t_s, nodes.z)
        features = np.column_stack([nodes.t_s / self._window_s, alike, nodes.state])
        order = np.argsort(-nodes.value, kind="stable")
        _, first = np.unique(np.round(features[order] / _ALIKE), axis=0, return_index=True)
        return np.asarray(order[np.sort(first)])


def _turns(score: Vector, kind: Indices, then: Vector | None = None) -> Indices:
    """Return indices in selection order: first the best of each kind, then the second best, etc."""
    then = score if then is None else then
    order = np.lexsort((-then, -score, kind))
    starts = np.flatnonzero(np.diff(kind[order], prepend=-1))
    rank = np.empty(len(order), int)
    rank[order] = np.arange(len(order)) - np.repeat(starts, np.diff(starts, append=len(order)))
    return np.asarray(np.lexsort((-then, -score, rank)))
