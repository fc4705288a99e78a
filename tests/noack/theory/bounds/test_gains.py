"""The gains of a disturbed plant, against simulated runs."""

import numpy as np

from noack.theory.bounds.gains import ErrorGains, Forcing, NormalForcing, PlantGains
from tests.oracles.lossy_loops import random_system


def test_the_response_to_normal_disturbances_stays_within_its_radius() -> None:
    """Of many normal runs, at most about the assumed share exceeds the bound; it is not far off."""
    rng, period_s = np.random.default_rng(0), 0.02
    for _ in range(5):
        system = random_system(rng, n=2, mismatch=0.0)
        models = ErrorGains(system.H, system.K, system.weight, 0.0)
        D, radius = rng.normal(size=(2, 2)), 3.0
        normal = NormalForcing(D, period_s, limit=radius, radius=radius)
        forcing = Forcing(np.zeros((2, 0)), np.zeros(0), np.zeros(system.B.shape[1]), normal)
        start = np.zeros((2, 1))
        plant = PlantGains(models, system.A, system.B, start, 0.0, forcing=forcing)
        M, C = plant.closed_loop, rng.normal(size=(1, 2))
        bound = plant.disturbed(C)
        # Euler's method with small steps, independent of matrix exponentials.
        x, fine, largest = np.zeros((400, 2)), 50, np.zeros(400)
        for _ in range(int(10 / -np.linalg.eigvals(M).real.max() / period_s)):
            push = rng.normal(size=(400, 2)) @ D.T
            for _ in range(fine):
                x = x + period_s / fine * (x @ M.T + push)
            largest = np.maximum(largest, np.abs(x @ C.T)[:, 0])
        stationary = np.abs(x @ C.T)[:, 0]
        assert (stationary > bound).mean() < 0.03  # chi squared with 2 degrees beyond 3²: 0.011
        assert largest.max() > 0.3 * bound
