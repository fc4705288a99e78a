"""The values of given patterns, and their improvement by changes of single decisions."""

import numpy as np

from cosim.analysis.adversary.pattern_flow import PatternFlow
from cosim.analysis.adversary.search_nodes import (
    DecisionLog,
    Pattern,
    PatternSearch,
    after_events,
    root,
    together,
)
from cosim.simulation.continuous import MAX_EVENTS, TooManyEventsError
from noack.core.linear_systems import Vector
from noack.impairments.loss_guarantee import LossAutomaton, LossGuarantee

_RANDOM = 64
_IMPROVED = 3
_NODES_FOR_A_GUESS = 20_000
_LONGEST = 1000
_PERIODS = 24
"""Longest period of the regular patterns of a constraint."""


def follow(
    flow: PatternFlow, automaton: LossAutomaton, patterns: list[Pattern]
) -> tuple[Vector, list[Pattern]]:
    """Run patterns to the horizon; return their values and the applied decisions.

    An update is delivered if the guarantee does not allow its loss.

    Raises:
        TooManyEventsError: a run has more than 100,000 events, or two at the same time.
    """
    count, log = len(patterns), DecisionLog()
    longest = max(map(len, patterns), default=0)
    wanted = np.ones((count, longest + 1), dtype=bool)
    for row, pattern in zip(wanted, patterns, strict=True):
        row[: len(pattern)] = pattern
    nodes = together([root(flow)] * count)
    run, value, last = np.arange(count), nodes.value.copy(), nodes.entry.copy()
    for event in range(MAX_EVENTS):
        segments = flow(nodes.t_s, nodes.z)
        value[run] = flow.objective.joined(nodes.value, segments.value)
        last[run] = nodes.entry
        going = np.flatnonzero(segments.is_event)
        if not len(going):
            return value, [log.decisions(int(entry)) for entry in last]
        after_loss = automaton.after_loss(nodes.state[going])
        delivered = wanted[run[going], min(event, longest)] | (after_loss < 0)
        state = np.where(delivered, automaton.after_delivery(nodes.state[going]), after_loss)
        following = after_events(flow, nodes, segments, value[run], going, delivered, state, log)
        run, nodes = run[going], following
    raise TooManyEventsError(f"trigger: more than {MAX_EVENTS} events: they accumulate")


def guess(search: PatternSearch, own: Pattern, rng: np.random.Generator) -> float:
    """Try the pattern ``own``, regular and random patterns; return an inter-event time in s."""
    search.step = "guesses"
    flow, automaton = search.flow, search.automaton
    events = len(follow(flow, automaton, [(False,) * _LONGEST])[1][0])
    tried = [own, *_candidates(search.guarantee, events, rng)]
    values, patterns = follow(flow, automaton, tried)
    search.nodes += events + sum(map(len, patterns))
    search.runs += len(patterns)
    for i in np.argsort(-values, kind="stable")[:_IMPROVED]:
        improve(search, patterns[i], float(values[i]), _NODES_FOR_A_GUESS)
    return flow.horizon_s / (events + 1)


def _candidates(guarantee: LossGuarantee, events: int, rng: np.random.Generator) -> list[Pattern]:
    """Return patterns of that many events: without losses, regular ones, random ones.

    A regular pattern loses the first updates of each period; with a further constraint, the period
    may be its window.
    """
    most = events if guarantee.longest_burst is None else guarantee.longest_burst
    if most == 0:
        return [()]
    others = [window.packets for window in guarantee.windows[1:] if window.packets <= _PERIODS]
    regular = [
        tuple((i + phase) % period >= lost for i in range(events))
        for lost in range(1, most + 1)
        for period in (lost + 1, *(one for one in others if one > lost + 1))
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
        changed = [(*pattern[:i], not one, *pattern[i + 1 :]) for i, one in enumerate(pattern)]
        values, patterns = follow(flow, automaton, changed)
        visited += sum(map(len, patterns))
        search.runs += len(patterns)
        top = int(values.argmax())
        if not values[top] > value:
            break
        value, pattern = float(values[top]), patterns[top]
    search.offer(value, pattern, visited)
