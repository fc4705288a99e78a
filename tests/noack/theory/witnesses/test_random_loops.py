"""Random loops: no pattern that is allowed contradicts a proven bound."""

from itertools import product

import numpy as np
import pytest

from noack.guarantee.loss_guarantee import LossHistory
from noack.theory.time_triggered.time_triggered_loop import LoopTimes, TimeTriggeredLoop
from noack.theory.witnesses.coordinates import floats
from tests.oracles.random_loops import random_loop


@pytest.mark.parametrize("seed", [3, 5, 7, 9, 10, 13, 14, 15])  # others take up to a minute
def test_patterns_of_random_loops_grow_as_proven(seed: int) -> None:
    """Patterns are played step by step, without the graph of bursts."""
    random = random_loop(seed)
    stability = random.margin.stability(random.guarantee)
    times = random.margin.loop.times
    A, B, K, H = map(floats, random.margin.loop.matrices)
    exact = TimeTriggeredLoop(
        A, B, K, H, LoopTimes(times.step, times.tick, times.phase, times.unit, times.rest)
    )
    slots = times.slots
    steps = [[exact.period(slot, fate).middle for fate in (False, True)] for slot in range(slots)]
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
    assert stability.verdict == ("stable" if random.growth < 1 else "destabilised")
    assert fastest <= stability.upper * (1 + 1e-9)
    if len(stability.pattern) <= longest:
        assert fastest == pytest.approx(stability.lower, rel=1e-6)
    assert stability.lower >= random.growth * (1 - 1e-9)
