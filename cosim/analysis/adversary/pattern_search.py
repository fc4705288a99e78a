"""Searches for the worst pattern of losses, many runs at a time.

* :class:`PatternSearch` continues :class:`Nodes`, runs that end at an event, by both outcomes of
  that event's update, and keeps the worst run.
* :func:`search_tree` goes through all admissible patterns, depth first.
* :func:`search_beam` continues only the most promising runs if there are too many patterns. All
  runs pass through the same time windows; at the end of each window, the runs are thinned out. Of
  runs that nearly coincide, one remains. The runs are grouped by the state of the guarantee's
  automaton and their part of the window; from each group first the best run is selected, then the
  second best, and so on. One half of the selection ranks runs by their value so far, the other half
  by the value ahead: what the loop would reach over the next window without events.
* :func:`try_likely_patterns` values given patterns, and :func:`improve` changes single decisions of
  one.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.adversary.loop_flows import Flags, Pattern, SampledFlow, SegmentEnds
from cosim.simulation.continuous import TooManyEventsError
from cosim.simulation.exact_simulation import MAX_EVENTS
from netem.core.row_operations import firsts_of_equal
from netem.guarantee.loss_guarantee import LossAutomaton, LossGuarantee
from noack.core.linear_systems import Matrix, Vector

Indices = NDArray[np.int64]
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

    def take(self, selection: Indices | Flags | slice) -> "Nodes":
        """Return a selection of the runs."""
        return Nodes._make(column[selection] for column in self)


def start_nodes(flow: SampledFlow) -> Nodes:
    """Return the start of all runs."""
    start, zero = flow.start(), np.zeros(1, int)
    return Nodes(start.end_s, start.z, zero, start.value, zero + START)


def concatenate(groups: Sequence[Nodes]) -> Nodes:
    """Return several groups as one."""
    return Nodes(*map(np.concatenate, zip(*groups, strict=True)))


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
        decisions: list[bool] = []
        while entry != START:
            block = int(np.searchsorted(starts, entry, side="right")) - 1
            row = entry - int(starts[block])
            decisions.append(bool(self._delivered[block][row]))
            entry = int(self._parents[block][row])
        return tuple(reversed(decisions))


class PatternSearch:
    """A search through the loss patterns that a guarantee allows."""

    def __init__(
        self,
        flow: SampledFlow,
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
        segments = self.flow(nodes.t_s, nodes.z)
        value = objective.combine(nodes.value, segments.value)
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
        can_be_lost = after_loss >= 0
        continued = np.concatenate([events[can_be_lost], events])
        delivered = np.repeat([False, True], [int(can_be_lost.sum()), len(events)])
        after_delivery = self.automaton.after_delivery(nodes.state[events])
        state = np.concatenate([after_loss[can_be_lost], after_delivery])
        step = Step(nodes, segments, value, continued, delivered, state)
        return after_events(self.flow, step, self._log)


class Step(NamedTuple):
    """N runs followed to the ends of their segments, and k decisions about the events there."""

    nodes: Nodes
    """The runs at the starts of the segments."""
    segments: SegmentEnds
    value: Vector
    """Values of the runs at the ends of the segments, (N,)."""
    continued: Indices
    """The run of each decision, (k,)."""
    delivered: Flags
    """Whether the update of the event arrives, (k,)."""
    state: Indices
    """The automaton's state after it, (k,)."""


def after_events(flow: SampledFlow, step: Step, log: DecisionLog) -> Nodes:
    """Return the runs just after the events of a step, (k,); its decisions are added to the log.

    Raises:
        TooManyEventsError: two events at the same time.
    """
    nodes, continued, delivered = step.nodes, step.continued, step.delivered
    t_s = step.segments.end_s[continued]
    stuck = t_s <= nodes.t_s[continued]
    if (stuck & (nodes.entry[continued] != START)).any():
        raise TooManyEventsError(f"trigger: the events accumulate at {t_s[stuck][0]:.9g} s")
    z = flow.after_events(t_s, step.segments.z[continued], delivered)
    return Nodes(t_s, z, step.state, step.value[continued], log.add(nodes.entry[continued], delivered))


_BLOCK = 4096
"""Runs that :func:`search_tree` follows at a time."""


def search_tree(search: PatternSearch, most_nodes: int) -> bool:
    """Search all patterns, within ``most_nodes`` nodes; return whether the maximum was found.

    It was if all patterns were covered, or if one of them diverges.

    Raises:
        TooManyEventsError: two events at the same time.
    """
    search.step, most_nodes, earlier_runs = "all patterns", most_nodes + search.nodes, search.runs
    pile = [start_nodes(search.flow)]
    while pile and search.value < float("inf"):
        nodes = _top(pile)
        if search.nodes + len(nodes.t_s) > most_nodes:
            return False
        if len(nodes.t_s):
            pile.append(search.successors(nodes))
    search.runs -= earlier_runs  # each pattern counts once
    return True


def _top(pile: list[Nodes]) -> Nodes:
    """Pop a block of nodes from the stack, the deepest first."""
    blocks, room = [], _BLOCK
    while pile and room > 0:
        nodes = pile.pop()
        if len(nodes.t_s) > room:
            pile.append(nodes.take(slice(None, -room)))
            nodes = nodes.take(slice(-room, None))
        blocks.append(nodes)
        room -= len(nodes.t_s)
    return concatenate(blocks)


_ALIKE = 1e-4
"""Runs nearly coincide if their times, in windows, and their features, of size 1, round to the same
multiples of this: far above the errors of rounding."""
_PARTS = 2
"""Parts of a window whose runs are ranked apart: an earlier run has had less time for its value."""
_WIDTH_WITHIN_WINDOW = 8
"""Runs that continue within a window, for each one that continues to the next window."""


def search_beam(search: PatternSearch, width: int, window_s: float) -> None:
    """Search for a large value; ``width`` runs continue from one window to the next.

    A window has about the length of an inter-event time.

    Raises:
        TooManyEventsError: two events at the same time.
    """
    search.step = "beam search"
    selection = _RunSelection(search.flow, window_s)
    waiting, until_s = start_nodes(search.flow), 0.0
    while len(waiting.t_s) and search.value < np.inf:
        until_s = max(until_s, float(waiting.t_s.min())) + window_s
        in_window = waiting.t_s < until_s
        active, later = waiting.take(in_window), [waiting.take(~in_window)]
        while len(active.t_s):
            following = search.successors(active)
            in_window = following.t_s < until_s
            later.append(following.take(~in_window))
            active = selection.thin(following.take(in_window), _WIDTH_WITHIN_WINDOW * width)
        waiting = selection.thin(concatenate(later), width)


class _RunSelection:
    """The selection of the runs that continue."""

    def __init__(self, flow: SampledFlow, window_s: float) -> None:
        self._flow, self._window_s = flow, window_s

    def thin(self, nodes: Nodes, width: int) -> Nodes:
        """Return at most ``width`` of the runs."""
        if len(nodes.t_s) <= width:
            return nodes
        nodes = nodes.take(self._distinct(nodes))
        group = self._group(nodes)
        ahead = self._flow.value_ahead(nodes.t_s, nodes.z, self._window_s)
        if self._flow.objective.additive:
            return nodes.take(_round_robin(nodes.value + ahead, group)[:width])
        by_value = _round_robin(nodes.value, group, ahead)[: width // 2]
        by_value_ahead = _round_robin(ahead, group)
        chosen = np.concatenate([by_value, by_value_ahead[~np.isin(by_value_ahead, by_value)]])
        return nodes.take(chosen[:width])

    def _group(self, nodes: Nodes) -> Indices:
        since_s = nodes.t_s - nodes.t_s.min()
        section = np.minimum(since_s * _PARTS / self._window_s, _PARTS).astype(int)
        return np.asarray(nodes.state * (_PARTS + 1) + section)

    def _distinct(self, nodes: Nodes) -> Indices:
        """Return, for each group of nearly equal runs, the one with the largest value."""
        alike = self._flow.features(nodes.t_s, nodes.z)
        features = np.column_stack([nodes.t_s / self._window_s, alike, nodes.state])
        order = np.argsort(-nodes.value, kind="stable")
        _, first = np.unique(np.round(features[order] / _ALIKE), axis=0, return_index=True)
        return np.asarray(order[np.sort(first)])


def _round_robin(score: Vector, group: Indices, second_score: Vector | None = None) -> Indices:
    """Return indices in selection order: first the best of each group, then the second best, etc."""
    second_score = score if second_score is None else second_score
    order = np.lexsort((-second_score, -score, group))
    starts = firsts_of_equal(group[order])
    rank = np.empty(len(order), int)
    rank[order] = np.arange(len(order)) - np.repeat(starts, np.diff(starts, append=len(order)))
    return np.asarray(np.lexsort((-second_score, -score, rank)))


_RANDOM = 64
"""Random patterns: their shares of losses are spread over 0 to 1, on average 1.5 % apart."""
_IMPROVED = 3
"""Patterns that are improved, since the best one may lead to a local maximum only."""
_NODES_PER_IMPROVEMENT = 20_000
"""Segments that the improvement of a pattern may compute."""
_LONGEST = 1000
"""Consecutive events whose updates are lost wherever possible; few runs have more events."""
_PERIODS = 24
"""Longest period of the regular patterns of a constraint."""


def follow(
    flow: SampledFlow, automaton: LossAutomaton, patterns: list[Pattern]
) -> tuple[Vector, list[Pattern]]:
    """Run patterns to the horizon; return their values and the applied decisions.

    An update is delivered if the guarantee does not allow its loss.

    Raises:
        TooManyEventsError: a run has more than 100,000 events, or two at the same time.
    """
    count, log = len(patterns), DecisionLog()
    longest = max(map(len, patterns), default=0)
    planned = np.ones((count, longest + 1), dtype=bool)
    for row, pattern in zip(planned, patterns, strict=True):
        row[: len(pattern)] = pattern
    nodes = concatenate([start_nodes(flow)] * count)
    run, value, last = np.arange(count), nodes.value.copy(), nodes.entry.copy()
    for event in range(MAX_EVENTS):
        segments = flow(nodes.t_s, nodes.z)
        value[run] = flow.objective.combine(nodes.value, segments.value)
        last[run] = nodes.entry
        going = np.flatnonzero(segments.is_event)
        if not len(going):
            return value, [log.decisions(int(entry)) for entry in last]
        after_loss = automaton.after_loss(nodes.state[going])
        delivered = planned[run[going], min(event, longest)] | (after_loss < 0)
        state = np.where(delivered, automaton.after_delivery(nodes.state[going]), after_loss)
        step = Step(nodes, segments, value[run], going, delivered, state)
        following = after_events(flow, step, log)
        run, nodes = run[going], following
    raise TooManyEventsError(f"trigger: more than {MAX_EVENTS} events: they accumulate")


def try_likely_patterns(search: PatternSearch, scenario_pattern: Pattern, rng: np.random.Generator) -> float:
    """Try the scenario's, regular and random patterns.

    Returns:
        The mean inter-event time if all losses that the guarantee allows occur, in s.
    """
    search.step = "guesses"
    flow, automaton = search.flow, search.automaton
    events = len(follow(flow, automaton, [(False,) * _LONGEST])[1][0])
    candidates = [scenario_pattern, *likely_patterns(search.guarantee, events, rng)]
    values, patterns = follow(flow, automaton, candidates)
    search.nodes += events + sum(map(len, patterns))
    search.runs += len(patterns)
    for i in np.argsort(-values, kind="stable")[:_IMPROVED]:
        improve(search, patterns[i], float(values[i]), _NODES_PER_IMPROVEMENT)
    return flow.horizon_s / (events + 1)


def likely_patterns(guarantee: LossGuarantee, events: int, rng: np.random.Generator) -> list[Pattern]:
    """Return patterns of that many events: without losses, regular ones, random ones.

    A regular pattern loses the first updates of each period; with a further constraint, the period
    may be its window.
    """
    longest = events if guarantee.longest_burst is None else guarantee.longest_burst
    if longest == 0:
        return [()]
    lengths = [window.packets for window in guarantee.windows[1:] if window.packets <= _PERIODS]
    regular = [
        tuple((i + phase) % period >= lost for i in range(events))
        for lost in range(1, longest + 1)
        for period in (
            lost + 1,
            *(length for length in lengths if length > lost + 1),
        )
        for phase in range(period)
    ]
    share = rng.uniform(size=(_RANDOM, 1))
    random = rng.uniform(size=(_RANDOM, events)) < share
    return [(), *regular, *(tuple(row) for row in random.tolist())]


def improve(search: PatternSearch, pattern: Pattern, value: float, most_nodes: int) -> None:
    """Change single decisions of a pattern of that value as long as this increases the objective.

    It stops after ``most_nodes`` nodes.
    """
    flow, automaton = search.flow, search.automaton
    # A pattern may end at the time of its largest value; complete it up to the horizon.
    pattern = follow(flow, automaton, [pattern])[1][0]
    visited = len(pattern)
    while pattern and visited + len(pattern) ** 2 <= most_nodes:
        changed = [(*pattern[:i], not delivered, *pattern[i + 1 :]) for i, delivered in enumerate(pattern)]
        values, patterns = follow(flow, automaton, changed)
        visited += sum(map(len, patterns))
        search.runs += len(patterns)
        top = int(values.argmax())
        if not values[top] > value:
            break
        value, pattern = float(values[top]), patterns[top]
    search.offer(value, pattern, visited)
