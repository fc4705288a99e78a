"""The values of given patterns, and their improvement by changes of single decisions."""

import numpy as np

from cosim.analysis.adversary.search_nodes import (
    DecisionLog,
    Pattern,
    PatternSearch,
    after_events,
    root,
    together,
)
from cosim.analysis.adversary.segments import SegmentFlow
from cosim.simulation.continuous.continuous_run import MAX_EVENTS, TooManyEventsError
from noack.core.linear_systems import Vector

_RANDOM = 64
_IMPROVED = 3
_NODES_FOR_A_GUESS = 20_000
_LONGEST = 1000


def follow(flow: SegmentFlow, mansd: int, patterns: list[Pattern]) -> tuple[Vector, list[Pattern]]:
    """Run patterns to the horizon; return their values and the applied decisions.

    An update is delivered if its loss would exceed ``mansd``.

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
        value[run] = flow.measure.joined(nodes.value, segments.value)
        last[run] = nodes.entry
        going = np.flatnonzero(segments.is_event)
        if not len(going):
            return value, [log.decisions(int(entry)) for entry in last]
        forced = nodes.dropouts[going] >= mansd
        delivered = wanted[run[going], min(event, longest)] | forced
        run, nodes = run[going], after_events(nodes, segments, value[run], going, delivered, log)
    raise TooManyEventsError(f"trigger: more than {MAX_EVENTS} events: they accumulate")


def guess(search: PatternSearch, own: Pattern, rng: np.random.Generator) -> float:
    """Try the pattern ``own``, regular and random patterns; return an inter-event time in s."""
    search.step = "guesses"
    flow, mansd = search.flow, search.mansd
    events = len(follow(flow, mansd, [(False,) * _LONGEST])[1][0])
    values, patterns = follow(flow, mansd, [own, *_candidates(mansd, events, rng)])
    search.nodes += events + sum(map(len, patterns))
    for i in np.argsort(-values, kind="stable")[:_IMPROVED]:
        improve(search, patterns[i], float(values[i]), _NODES_FOR_A_GUESS)
    return flow.horizon_s / (events + 1)


def _candidates(mansd: int, events: int, rng: np.random.Generator) -> list[Pattern]:
    """Return patterns of that many events: without losses, regular ones, random ones."""
    if mansd == 0:
        return [()]
    regular = [
        tuple((i + phase) % (lost + 1) == lost for i in range(events))
        for lost in range(1, mansd + 1)
        for phase in range(lost + 1)
    ]
    share = rng.uniform(size=(_RANDOM, 1))
    random = rng.uniform(size=(_RANDOM, events)) < share
    return [(), *regular, *(tuple(row) for row in random.tolist())]


def improve(search: PatternSearch, pattern: Pattern, value: float, most_nodes: int) -> None:
    """Change single decisions of a pattern of that value as long as this increases the objective.

    It stops after ``most_nodes`` nodes.
    """
    flow, mansd = search.flow, search.mansd
    # A pattern may end at the time of its largest value; complete it up to the horizon.
    pattern = follow(flow, mansd, [pattern])[1][0]
    visited = len(pattern)
    while pattern and visited + len(pattern) ** 2 <= most_nodes:
        changed = [(*pattern[:i], not one, *pattern[i + 1 :]) for i, one in enumerate(pattern)]
        values, patterns = follow(flow, mansd, changed)
        visited += sum(map(len, patterns))
        top = int(values.argmax())
        if not values[top] > value:
            break
        value, pattern = float(values[top]), patterns[top]
    search.offer(value, pattern, visited)
