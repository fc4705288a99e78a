"""The random loops of the benchmark: no pattern that is allowed contradicts a proven bound."""

from itertools import product

import numpy as np
import pytest

from benchmarks.cases.margins import random_loop
from noack.core.clock import NEVER_NS
from noack.core.linear_systems import Matrix
from noack.impairments.loss_guarantee import LossHistory
from noack.theory.margins.exact_matrices import exponential, fixed, stacked
from noack.theory.margins.time_triggered_loop import TimeTriggeredLoop


def period(loop: TimeTriggeredLoop, slot: int, delivered: bool) -> Matrix:
    """Return the map of (x, x_c, u, w) from a transmission to the next one, rounded."""
    from_ns, times = slot * loop.times.period_ns, loop.times
    until_ns, arrival_ns = from_ns + times.period_ns, from_ns + times.delay_ns
    if not delivered:
        return loop._between(from_ns, until_ns, NEVER_NS).interval().middle
    start = fixed(np.eye(len(loop._latch.entries)))
    state = loop._between(from_ns, arrival_ns, NEVER_NS) @ start
    updated = exponential(loop._H, times.delay_ns) @ start.rows(loop._x)
    state = stacked(state.rows(loop._x), updated, state.rows(loop._inputs))
    return (loop._between(arrival_ns, until_ns, NEVER_NS) @ state).interval().middle


@pytest.mark.parametrize("seed", [3, 5, 7, 9, 10, 13, 14, 15])  # others take up to a minute
def test_patterns_of_random_loops_grow_as_proven(seed: int) -> None:
    """Patterns are played step by step, without the maps between deliveries or their graph."""
    random = random_loop(seed)
    found = random.margin.stability(random.guarantee)
    loop, slots = random.margin.loop, random.margin.loop.times.slots
    steps = [[period(loop, slot, fate) for fate in (False, True)] for slot in range(slots)]
    fastest, longest = 0.0, 9
    for length in range(1, longest + 1):
        for pattern in product((True, False), repeat=length):
            history, whole = LossHistory(random.guarantee.rules), pattern * 12
            if not pattern[0] or any(history.add(not fate) for fate in whole):
                continue
            repeated = np.lcm(length, slots)
            Π = np.eye(len(steps[0][0]))
            for k in range(repeated):
                Π = steps[k % slots][pattern[k % length]] @ Π
            radius = np.abs(np.linalg.eigvals(Π)).max() ** (1 / repeated) * random.scale
            fastest = max(fastest, float(radius))
    assert found.verdict == ("stable" if random.growth < 1 else "destabilised")
    assert fastest <= found.upper * (1 + 1e-9)
    if len(found.pattern) <= longest:
        assert fastest == pytest.approx(found.lower, rel=1e-6)
    assert found.lower >= random.growth * (1 - 1e-9)
