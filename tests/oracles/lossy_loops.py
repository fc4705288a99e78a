"""Random lossy loops with model mismatch, and loss patterns that their guarantees allow."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
Vector = NDArray[np.float64]

ROUNDING = 1 + 1e-9
"""Simulation and enclosure are both rounded; each error is below this."""

SEARCH = settings(deadline=None, suppress_health_check=list(HealthCheck), phases=[Phase.generate])

seeds = st.integers(0, 2**32)


@dataclass(frozen=True)
class System:
    """A loop with model mismatch, its trigger, and its guarantee."""

    A: Matrix
    B: Matrix
    K: Matrix
    H: Matrix
    weight: Matrix
    x0: Vector
    alpha: float
    beta: float
    known_start: bool
    mansd: int
    window: tuple[int, int] = (1, 1)
    """(m, K): at most m losses in K consecutive updates, if m < K."""
    recovery: int = 0
    """Least number of deliveries between two bursts of losses."""


def systems(**fixed: Any) -> st.SearchStrategy[System]:
    """Loops of every kind; ``fixed`` replaces some of the drawn values."""
    return seeds.map(lambda seed: random_system(np.random.default_rng(seed), **fixed))


def spectral_abscissa(matrix: Matrix) -> float:
    """The largest real part of the eigenvalues."""
    return float(np.linalg.eigvals(matrix).real.max())


def random_system(rng: np.random.Generator, **fixed: Any) -> System:
    """A loop of any kind; ``fixed`` replaces some of the drawn values."""

    def choose(name: str, values: Sequence[Any]) -> Any:
        return fixed.get(name, values[rng.integers(len(values))])

    n, m = choose("n", range(1, 6)), choose("m", (1, 2))
    H = rng.uniform(-1, 1, (n, n)) * choose("spread", (1.0, 3.0))
    H -= (spectral_abscissa(H) + rng.uniform(0.5, 2.0)) * np.eye(n)
    B_model, K = rng.uniform(-1, 1, (n, m)), rng.uniform(-1, 1, (m, n))
    alpha = choose("alpha_share", (0.2, 0.5, 0.8)) * -spectral_abscissa(H)
    change_A, change_B = rng.uniform(-1, 1, (n, n)), rng.uniform(-1, 1, (n, m))
    mismatch = choose("mismatch", (0.0, 0.1, 0.5))
    while spectral_abscissa(H + mismatch * (change_A + change_B @ K)) >= -alpha:
        mismatch /= 2
    weighted = choose("weighted", (False, True))
    weight = rng.uniform(-1, 1, (n, n)) + 1.5 * np.eye(n) if weighted else np.eye(n)
    A, B = H - B_model @ K + mismatch * change_A, B_model + mismatch * change_B
    return System(
        A=A,
        B=B,
        K=K,
        H=H,
        weight=weight,
        x0=rng.uniform(-1, 1, n),
        alpha=alpha,
        beta=choose("beta", (0.01, 0.05, 0.3, 1.0)),
        known_start=choose("known_start", (False, True)),
        mansd=choose("mansd", range(7)),
        window=choose("window", ((1, 1), (1, 4), (2, 5), (3, 12), (4, 40))),
        recovery=choose("recovery", (0, 0, 2, 6)),
    )
