"""Random time-triggered loops under losses."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, solve_continuous_are

from cosim.analysis.margin_search import read_guarantee
from cosim.cli.options import find_scenario
from netem.guarantee.loss_guarantee import LossGuarantee
from noack.core.linear_systems import Matrix
from noack.proof.search.growth import PeriodicLoop
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load, validate
from noack.theory.time_triggered.graph import Graph
from noack.theory.witnesses.coordinates import floats
from noack.theory.witnesses.loss_margin import LossMargin

GUARANTEES = ("M", "(m, K)", "M, recovery", "(m, K), recovery")


class RandomLoop(NamedTuple):
    """A loop with a guarantee."""

    margin: LossMargin
    guarantee: LossGuarantee
    kind: str
    growth: float
    """The growth of the worst pattern that a search of its own found."""


def _matrices(rng: np.random.Generator, largest: int) -> tuple[Matrix, Matrix, Matrix]:
    n, m = int(rng.integers(1, largest + 1)), int(rng.integers(1, largest // 2 + 1))
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, m))
    K = -B.T @ solve_continuous_are(A, B, np.eye(n), np.eye(m))
    return A, B, K


def random_loop(seed: int) -> RandomLoop:
    """Return the loop with a number: linear-quadratic regulators of random plants.

    One of six consists of two loops that do not influence each other.
    """
    rng = np.random.default_rng([seed, 43])
    # The plant, its regulator, and how it is sampled.
    if rng.random() < 1 / 6:
        both = zip(_matrices(rng, 2), _matrices(rng, 2), strict=True)
        A, B, K = (block_diag(nominal, other) for nominal, other in both)
    else:
        A, B, K = _matrices(rng, 4)
    mode, step_s = ("model", "zoh")[seed % 2], 0.02
    period_s = step_s * int(rng.integers(2, 21))
    delay_s = 0.0 if rng.random() < 0.7 else 0.4 * step_s
    content = load(find_scenario("double_integrator")).model_dump(mode="json", exclude_none=True)
    del content["outputs"]
    content |= {
        "mode": mode,
        "model": {"A": A.tolist(), "B": B.tolist(), "gain": K.tolist()},
        "plant": {"initial_state": [1.0] * len(A), "rate_hz": 1 / step_s},
        "controller": {"rate_hz": 1 / step_s},
        "trigger": {"policy": "periodic", "period_s": period_s},
    }
    content["network"]["impairments"] = [{"kind": "delay", "delay_s": delay_s}] * (delay_s > 0)
    margin = LossMargin(resolve(validate(content, f"loop {seed}")))
    # The guarantee: M, with a limit in a window, and with deliveries between bursts, in turn.
    number = seed // 2 % len(GUARANTEES)
    burst = int(rng.integers(1, 8))
    words = f"mansd {burst}"
    if number % 2:
        words += f" atmost {rng.integers(1, burst + 2)} in {burst + rng.integers(2, 6)}"
    if number >= 2:
        words += f" recover {rng.integers(2, 4)}"
    guarantee = read_guarantee(words)
    growth = _fastest(margin.bursts_loop.under(guarantee))
    return RandomLoop(margin, guarantee, f"{mode}, {GUARANTEES[number]}", growth)


def _fastest(loop: PeriodicLoop) -> float:
    """Return the growth of the fastest cycle that a search finds."""
    matrices = np.array([floats(loop.matrix(burst)) for burst in loop.bursts])
    ends = ((burst.source, burst.target, burst.units) for burst in loop.bursts)
    graph = Graph(*(np.array(column) for column in zip(*ends, strict=True)))
    T = graph.balancing(matrices)
    balanced = T[graph.targets] @ matrices @ np.linalg.inv(T)[graph.sources]
    return float(np.exp(graph.fastest_cycle(balanced, 30, 200)[0]))
