"""What a witness proves of random loops is never exceeded in runs of them."""

from collections.abc import Callable

import numpy as np
import pytest

from noack.theory.witnesses.documents import find_witness
from noack.theory.witnesses.effort import NoWitnessError
from noack_check.balls import number
from noack_check.loop import Loop
from tests.checker.random_loops import random_loop, random_loop_with_long_delays, random_noisy_loop
from tests.checker.runs import exceeded
from tests.checker.test_witnesses import double_integrator

_RUNS = 6


def _found_for(
    seed: int, draw: Callable[[np.random.Generator], Loop] = random_loop, runs: int = _RUNS
) -> bool:
    """Return whether there is a witness, after runs of the loop."""
    rng = np.random.default_rng(seed)
    loop = draw(rng)
    try:
        proof = find_witness(loop).proof
    except NoWitnessError:
        return False
    until = 600 * float(loop.times.sampling.p) / float(loop.times.sampling.q)
    for _ in range(runs):
        assert exceeded(loop, proof, rng, until) == []
    return True


def test_bounds_of_a_few_random_loops_are_not_exceeded() -> None:
    found = [_found_for(seed) for seed in (105, 108)]  # with one state: fast
    assert any(found)


def test_bounds_with_long_delays_and_events_before_the_first_input_are_not_exceeded() -> None:
    assert _found_for(9, random_loop_with_long_delays, 2)  # a relative rule, one later event


def test_runs_come_near_the_bounds() -> None:
    """Runs that could not exceed a bound that is too small would show nothing."""
    rng = np.random.default_rng(1)
    loop = double_integrator()
    proof = find_witness(loop).proof
    smaller = [
        bound._replace(decaying=bound.decaying * share)
        for bound in proof.bounds
        for share in [number({"x": 0.9, "e_s": 0.8, "e_c": 0.2, "drift": 0.1}[bound.output])]
    ]
    changed = proof._replace(bounds=tuple(smaller))
    found = {each.output for _ in range(3) for each in exceeded(loop, changed, rng, 6.0)}
    assert found >= {"x", "e_s", "e_c", "drift"}


@pytest.mark.system
@pytest.mark.timeout(1200)
def test_bounds_of_random_loops_are_not_exceeded() -> None:
    seeds = range(100, 125)
    assert sum(_found_for(seed) for seed in seeds) >= len(seeds) // 4


@pytest.mark.system
@pytest.mark.timeout(1200)
def test_bounds_of_random_loops_with_noise_are_not_exceeded() -> None:
    assert sum(_found_for(seed, random_noisy_loop) for seed in range(12)) >= 1


@pytest.mark.system
@pytest.mark.timeout(1200)
def test_bounds_of_random_loops_with_long_delays_are_not_exceeded() -> None:
    seeds = range(12)
    assert sum(_found_for(seed, random_loop_with_long_delays) for seed in seeds) >= len(seeds) // 2
