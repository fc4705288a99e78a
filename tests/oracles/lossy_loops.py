"""Random loops for the paper's Theorem 2: a model of any kind, and plants that are far from it.

Those of :mod:`tests.checker.random_loops` have regulators, and plants that a proof can cover.
"""

from dataclasses import dataclass

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
    """A loop with model mismatch, its trigger, and its largest number of consecutive losses."""

    A: Matrix
    B: Matrix
    K: Matrix
    H: Matrix
    x0: Vector
    alpha: float
    beta: float
    mansd: int


def systems() -> st.SearchStrategy[System]:
    """Loops of every kind."""
    return seeds.map(lambda seed: random_system(np.random.default_rng(seed)))


def spectral_abscissa(matrix: Matrix) -> float:
    """The largest real part of the eigenvalues."""
    return float(np.linalg.eigvals(matrix).real.max())


def random_system(rng: np.random.Generator) -> System:
    """A loop of any kind."""
    n, m = int(rng.integers(1, 6)), int(rng.integers(1, 3))
    H = rng.uniform(-1, 1, (n, n)) * rng.choice([1.0, 3.0])
    H -= (spectral_abscissa(H) + rng.uniform(0.5, 2.0)) * np.eye(n)
    B_model, K = rng.uniform(-1, 1, (n, m)), rng.uniform(-1, 1, (m, n))
    alpha = float(rng.choice([0.2, 0.5, 0.8])) * -spectral_abscissa(H)
    change_A, change_B = rng.uniform(-1, 1, (n, n)), rng.uniform(-1, 1, (n, m))
    mismatch = float(rng.choice([0.0, 0.1, 0.5]))
    while spectral_abscissa(H + mismatch * (change_A + change_B @ K)) >= -alpha:
        mismatch /= 2
    return System(
        A=H - B_model @ K + mismatch * change_A,
        B=B_model + mismatch * change_B,
        K=K,
        H=H,
        x0=rng.uniform(-1, 1, n),
        alpha=alpha,
        beta=float(rng.choice([0.01, 0.05, 0.3, 1.0])),
        mansd=int(rng.integers(7)),
    )
