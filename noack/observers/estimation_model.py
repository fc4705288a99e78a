"""The discrete-time model that an observer uses.

Over a step h of the plant the model is x⁺ = Âd x + B̂d u + q, y = C x + v. The time between two
measurements is T = steps · h.
"""

from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Vector


class NoiseVariances(NamedTuple):
    """Variances of the random disturbances and the noise of a scenario, entry by entry."""

    at_state: Vector
    """Of the disturbances at = "state", (n,)."""
    at_input: Vector
    """Of the disturbances at = "input", (m,)."""
    output: Vector
    """Of the measurement noise v, (p,)."""


class EstimationModel(NamedTuple):
    """The model on the plant's time grid, with the covariances of its noise."""

    Ad: Matrix
    """Âd, (n, n)."""
    Bd: Matrix
    """B̂d, (n, m)."""
    Gd: Matrix
    """Effect of a disturbance w of ẋ that is constant over a step, (n, n)."""
    C: Matrix
    """(p, n)"""
    Q: Matrix
    """Covariance of q, (n, n)."""
    R: Matrix
    """Covariance of v, (p, p)."""
    steps: int
    """Steps of the plant between two measurements."""

    def process_covariance(self, at_state: Vector, at_input: Vector) -> Matrix:
        """Return the covariance of q for independent disturbances with these variances."""
        return _covariance(self.Gd, at_state) + _covariance(self.Bd, at_input)

    def between_measurements(self) -> tuple[Matrix, Matrix]:
        """Return Â^(T), and the covariance of the process noise over T, (n, n) each."""
        A, Q = np.eye(len(self.Ad)), np.zeros_like(self.Q)
        for _ in range(self.steps):
            A, Q = self.Ad @ A, self.Ad @ Q @ self.Ad.T + self.Q
        return A, Q


def _covariance(through: Matrix, variance: Vector) -> Matrix:
    return np.asarray(through @ np.diag(variance) @ through.T)
