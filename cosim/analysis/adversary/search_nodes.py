"""Runs of the loop that are computed together, the loss decisions of each, and the worst of all."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.adversary.pattern_flow import Flags, PatternFlow, Segments
from cosim.simulation.continuous import TooManyEventsError
from noack.core.linear_systems import Matrix, Vector
from noack.impairments.loss_guarantee import LossAutomaton, LossGuarantee

Indices = NDArray[np.int64]

Pattern = tuple[bool, ...]
"""Whether the update of each event is delivered; events after its end are delivered."""

SearchReport = Callable[[str, int, float], None]
"""Receives the current search step, the segments computed so far, and the largest value so far."""

START = -1
"""The entry of a run without any decision."""


class Nodes(NamedTuple):
    """N runs, each just after an event and the delivery or loss of its update."""

    t_s: Vector
    """(N,)"""
    z: Matrix
    """The states, as the flow has them, (N, entries)."""
    state: Indices
    """State of the guarantee's automaton, (N,); under a cap alone, the consecutive losses."""
    value: Vector
    """The objective's value of the run up to ``t_s``, (N,)."""
    entry: Indices
    """Index of the last decision in the log, (N,)."""

    def take(self, which: Indices | Flags | slice) -> "Nodes":
        """Return a selection of the runs."""
        columns: Sequence[Any] = self
        return Nodes(*(column[which] for column in columns))


def root(flow: PatternFlow) -> Nodes:
    """Return the start of all runs."""
    start, zero = flow.start(), np.zeros(1, int)
    return Nodes(start.end_s, start.z, zero, start.value, zero + START)


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

    def decisions(self, entry: int) -> Pattern:
        """Return whether the update of each event up to this entry was delivered."""
        starts = np.cumsum([0, *map(len, self._parents)])
        found: list[bool] = []
        while entry != START:
            block = int(np.searchsorted(starts, entry, side="right")) - 1
            row = entry - int(starts[block])
            found.append(bool(self._delivered[block][row]))
            entry = int(self._parents[block][row])
        return tuple(reversed(found))


class PatternSearch:
    """A search through the loss patterns that a guarantee allows."""

    def __init__(
        self,
        flow: PatternFlow,
        guarantee: LossGuarantee,
        report: SearchReport = lambda step, nodes, value: None,
    ) -> None:
        self.flow, self.guarantee = flow, guarantee
        self.automaton = LossAutomaton(guarantee)
        self.step = ""
        """Name of the current step, for the report."""
        self.value = -np.inf
        """The largest value so far."""
        self.nodes = 0
        """Segments between events that were computed."""
        self.runs = 0
        """Runs that were computed up to the horizon."""
        self._report = report
        self._log = DecisionLog()
        self._entry: int | None = None
        self._pattern: Pattern = ()

    @property
    def pattern(self) -> Pattern:
        """A pattern that reaches the largest value, at least up to the time of that value."""
        return self._pattern if self._entry is None else self._log.decisions(self._entry)

    def offer(self, value: float, pattern: Pattern, nodes: int = 0) -> None:
        """Take the value of a pattern that was computed elsewhere, from ``nodes`` segments."""
        self.nodes += nodes
        if value > self.value or not self.pattern:
            self.value, self._pattern, self._entry = value, pattern, None
        self._report(self.step, self.nodes, self.value)

    def successors(self, nodes: Nodes) -> Nodes:
        """Follow runs to their next events; return each with a lost and a delivered update.

        Raises:
            TooManyEventsError: two events at the same time.
        """
        objective = self.flow.objective
        segments = self.flow(nodes.t_s, nodes.z, self.value)
        value = objective.joined(nodes.value, segments.value)
        # A sum is compared only when the run is complete.
        candidates = np.where(segments.is_event & objective.additive, -np.inf, value)
        top = int(candidates.argmax())
        if candidates[top] > self.value:
            self.value, self._entry = float(candidates[top]), int(nodes.entry[top])
        self.nodes += len(nodes.t_s)
        self.runs += int((~segments.is_event).sum())
        self._report(self.step, self.nodes, self.value)
        events = np.flatnonzero(segments.is_event)
        after_loss = self.automaton.after_loss(nodes.state[events])
        may = after_loss >= 0
        these = np.concatenate([events[may], events])
        delivered = np.repeat([False, True], [int(may.sum()), len(events)])
        after_delivery = self.automaton.after_delivery(nodes.state[events])
        state = np.concatenate([after_loss[may], after_delivery])
        return after_events(self.flow, nodes, segments, value, these, delivered, state, self._log)


def after_events(
    flow: PatternFlow, nodes: Nodes, segments: Segments, value: Vector, these: Indices,
    delivered: Flags, state: Indices, log: DecisionLog,
) -> Nodes:  # fmt: skip
    """Return the runs ``these``, (k,), just after the events at the end of their segments.

    ``delivered``, (k,), tells whether the update of each run arrives; the ``log`` receives that.
    ``state``, (k,), is the automaton's state after it. ``value``, (N,), has the values of the runs
    at the end of the segments.

    Raises:
        TooManyEventsError: two events at the same time.
    """
    t_s = segments.end_s[these]
    stuck = t_s <= nodes.t_s[these]
    if (stuck & (nodes.entry[these] != START)).any():
        raise TooManyEventsError(f"trigger: the events accumulate at {t_s[stuck][0]:.9g} s")
    z = flow.after_events(t_s, segments.z[these], delivered)
    return Nodes(t_s, z, state, value[these], log.add(nodes.entry[these], delivered))
