"""What a witness proves of random loops is never exceeded in runs of them."""

import numpy as np
import pytest

from noack.core.balls import number
from noack.proof.elaborate.loop import Loop
from noack.proof.search.results import Proof
from noack.theory.witnesses.documents import find_witness
from noack.theory.witnesses.effort import NoWitnessError
from tests.checker.proofs import RANDOM, proved
from tests.checker.random_loops import long_run_s, random_loop
from tests.checker.runs import exceeded

_RUNS = 6


def require_not_exceeded(loop: Loop, proof: Proof, rng: np.random.Generator, runs: int) -> None:
    for _ in range(runs):
        assert exceeded(loop, proof, rng, long_run_s(loop)) == []


@pytest.mark.parametrize(("kind", "seed"), [(kind, seed) for kind, seed, _ in RANDOM])
def test_bounds_of_a_few_random_loops_are_not_exceeded(kind: str, seed: int) -> None:
    found = proved(f"random_{kind.replace(' ', '_')}_{seed}")
    require_not_exceeded(found.loop, found.proof, np.random.default_rng(seed), _RUNS)


def test_runs_come_near_the_bounds() -> None:
    """Runs that could not exceed a bound that is too small would show nothing."""
    rng = np.random.default_rng(1)
    loop, proof = proved("double_integrator").loop, proved("double_integrator").proof
    smaller = [
        bound._replace(decaying=bound.decaying * share)
        for bound in proof.bounds
        for share in [number({"x": 0.9, "e_s": 0.8, "e_c": 0.2, "drift": 0.1}[bound.output])]
    ]
    changed = proof._replace(bounds=tuple(smaller))
    found = {each.output for _ in range(3) for each in exceeded(loop, changed, rng, 6.0)}
    assert found >= {"x", "e_s", "e_c", "drift"}


@pytest.mark.deep
@pytest.mark.timeout(2400)
@pytest.mark.parametrize(
    ("kind", "seeds", "least"),
    [
        ("threshold", range(100, 125), 6),
        ("noisy", range(12), 1),
        ("long delays", range(12), 6),
        ("periodic", range(30), 15),
    ],
)
def test_bounds_of_random_loops_are_not_exceeded(kind: str, seeds: range, least: int) -> None:
    found = 0
    for seed in seeds:
        rng = np.random.default_rng(seed)
        loop = random_loop(rng, kind)
        outputs = ("x", "e_c") if kind != "periodic" else ("x",) if seed % 2 else ("e_c",)
        try:
            proof = find_witness(loop, outputs).proof
        except NoWitnessError:
            continue
        found += 1
        require_not_exceeded(loop, proof, rng, _RUNS)
    assert found >= least
