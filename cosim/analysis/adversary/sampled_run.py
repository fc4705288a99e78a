"""One run of a sampled loop, with the objective's value, for a given network."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from cosim.analysis.adversary.objective import Objective
from cosim.analysis.adversary.sampled_flow import SampledFlow
from cosim.analysis.adversary.search_nodes import Pattern


class SampledRun(NamedTuple):
    """A run of the loop, by its events."""

    value: float
    at_s: float | None
    """Time of the supremum, or of the later of the two closest events."""
    delivered: Pattern
    """Whether the update of each event is delivered."""
    event_s: tuple[float, ...]


def run_of(flow: SampledFlow, delivered: Callable[[int], bool]) -> SampledRun:
    """Run the loop; ``delivered`` returns the fate of each update."""
    now = flow.start()
    value, at_s = float(now.value[0]), 0.0
    event_s = [] if flow.loop.known_start else [0.0]
    fates = [True] * len(event_s)
    while True:
        now = flow(now.end_s, now.z)
        found = float(now.value[0])
        if now.at_s is not None and found > value:
            at_s = float(now.at_s[0])
        value = float(flow.objective.joined(np.array(value), np.array(found)))
        if not now.is_event[0]:
            break
        fates.append(delivered(len(event_s)))
        event_s.append(float(now.end_s[0]))
        now = now._replace(z=flow.after_events(now.end_s, now.z, np.array(fates[-1:])))
    known = flow.objective is not Objective.COST and value > -np.inf
    return SampledRun(value, at_s if known else None, tuple(fates), tuple(event_s))
