"""Runs of the loop that are computed together, with the loss decisions of each."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.adversary.segments import SegmentFlow, Segments
from cosim.simulation.continuous.continuous_run import TooManyEventsError
from noack.core.linear_systems import Matrix, Vector

Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]

Report = Callable[[int, float], None]
"""Receives the nodes visited and the best value so far."""

START = -1
"""The entry of a run without any decision."""


class Nodes(NamedTuple):
    """N runs, each just after an event and the delivery or loss of its update."""

    t_s: Vector
    """(N,)"""
    z: Matrix
    """(x, e_s, e_c), (N, 3n)."""
    dropouts: Indices
    """Current number of consecutive losses, (N,)."""
    value: Vector
    """The objective's value of the run up to ``t_s``, (N,)."""
    entry: Indices
    """Index of the last decision in the log, (N,)."""

    def take(self, which: Indices | Flags | slice) -> "Nodes":
        """Return a selection of the runs."""
        return Nodes(
            self.t_s[which],
            self.z[which],
            self.dropouts[which],
            self.value[which],
            self.entry[which],
        )


def root(flow: SegmentFlow) -> Nodes:
    """Return the start: sensor and controller have x(0), by the first packet or the scenario."""
    x0 = flow.system.loop.x0
    z = np.concatenate([x0, np.zeros(2 * len(x0))])[None]
    return Nodes(
        np.zeros(1), z, np.zeros(1, int), np.array([flow.measure.nothing]), np.array([START])
    )


def together(parts: Sequence[Nodes]) -> Nodes:
    """Return several groups as one."""
    return Nodes(*map(np.concatenate, zip(*parts, strict=True)))


class DecisionLog:
    """A log of decisions; each entry refers to the decision before it."""

    def __init__(self) -> None:
        self._parents: list[Indices] = []
        self._delivered: list[Flags] = []
        self._length = 0

    def add(self, parents: Indices, delivered: Flags) -> Indices:
        """Append decisions; return their indices."""
        self._parents.append(parents)
        self._delivered.append(delivered)
        self._length += len(parents)
        return np.arange(self._length - len(parents), self._length)

    def decisions(self, entry: int) -> tuple[bool, ...]:
        """Return whether the update of each event up to this entry was delivered."""
        starts = np.cumsum([0, *map(len, self._parents)])
        found: list[bool] = []
        while entry != START:
            block = int(np.searchsorted(starts, entry, side="right")) - 1
            row = entry - int(starts[block])
            found.append(bool(self._delivered[block][row]))
            entry = int(self._parents[block][row])
        return tuple(reversed(found))


class WorstPatternFound(NamedTuple):
    """The result of a search."""

    value: float
    """The largest value found, or the search's initial value if none was larger."""
    decisions: tuple[bool, ...] | None
    """Whether the update of each event arrives, up to the time of the value; None if no pattern
    exceeded the initial value."""
    nodes: int
    """Segments between events that were computed."""
    complete: bool
    """Whether the search covered every pattern."""


class Best:
    """The run with the largest objective so far."""

    def __init__(self, flow: SegmentFlow, value: float = -np.inf) -> None:
        self._measure = flow.measure
        self.value = value
        self.entry: int | None = None
        """Last decision of that run; None until a run exceeds the initial value."""

    def see(self, nodes: Nodes, segments: Segments) -> Vector:
        """Evaluate the segments that follow nodes; return the values of the runs, (N,)."""
        value = self._measure.joined(nodes.value, segments.value)
        # A sum is compared only when the run is complete.
        pending = segments.is_event & self._measure.additive
        candidates = np.where(pending, -np.inf, value)
        top = int(candidates.argmax())
        if candidates[top] > self.value:
            self.value, self.entry = float(candidates[top]), int(nodes.entry[top])
        return value

    def found(self, log: DecisionLog, nodes: int, *, complete: bool) -> WorstPatternFound:
        """Return the result of the search."""
        decisions = None if self.entry is None else log.decisions(self.entry)
        return WorstPatternFound(self.value, decisions, nodes, complete)


def after_events(
    nodes: Nodes,
    segments: Segments,
    value: Vector,
    these: Indices,
    delivered: Flags,
    log: DecisionLog,
) -> Nodes:
    """Return the runs ``these`` just after the events at the end of their segments.

    Args:
        nodes: the runs before the segments.
        segments: the segments; those of ``these`` end in events.
        value: values of the runs at the end of the segments, (N,).
        these: indices of the runs, (k,).
        delivered: whether the update of each run arrives, (k,).
        log: receives the decisions.

    Raises:
        TooManyEventsError: two events at the same time.
    """
    t_s = segments.end_s[these]
    stuck = t_s <= nodes.t_s[these]
    if (stuck & (nodes.entry[these] != START)).any():
        raise TooManyEventsError(f"trigger: the events accumulate at {t_s[stuck][0]:.9g} s")
    z, n = segments.z[these], segments.z.shape[1] // 3
    z[:, n : 2 * n] = 0.0
    z[delivered, 2 * n :] = 0.0
    return Nodes(
        t_s,
        z,
        np.where(delivered, 0, nodes.dropouts[these] + 1),
        value[these],
        log.add(nodes.entry[these], delivered),
    )


def branches(
    nodes: Nodes, segments: Segments, value: Vector, mansd: int, log: DecisionLog
) -> Nodes:
    """Return all successors: each update lost (if ``mansd`` allows it) and delivered."""
    events = np.flatnonzero(segments.is_event)
    losable = events[nodes.dropouts[events] < mansd]
    fates = np.repeat([False, True], [len(losable), len(events)])
    return after_events(nodes, segments, value, np.concatenate([losable, events]), fates, log)
