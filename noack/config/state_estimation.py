"""What an observer knows of the plant: its model on the plant's grid, and what it makes of noise.

Over a step of the plant, h, the model is x⁺ = Âd x + B̂d u + q, y = C x + v; between two
measurements lie ``steps`` of them, T = steps · h.
"""

from typing import NamedTuple

import numpy as np

from noack.config.disturbances import variance_at
from noack.config.observers import KalmanSettings, LuenbergerSettings
from noack.config.resolution import loop_of
from noack.config.scenario import Scenario
from noack.core.linear_systems import Matrix, Vector, discretise


class EstimationModel(NamedTuple):
    """The model of a resolved scenario as its observer has it."""

    Ad: Matrix
    """Âd, (n, n)."""
    Bd: Matrix
    """B̂d, (n, m)."""
    C: Matrix
    """(p, n)"""
    Q: Matrix
    """Covariance of q, what is random in a step of the plant, (n, n)."""
    R: Matrix
    """Covariance of v, (p, p)."""
    steps: int
    """Steps of the plant between two measurements."""

    def over_a_measurement(self) -> tuple[Matrix, Matrix]:
        """Â^(T), and the covariance of what is random over T, (n, n) each."""
        A, Q = np.eye(len(self.Ad)), np.zeros_like(self.Q)
        for _ in range(self.steps):
            A, Q = self.Ad @ A, self.Ad @ Q @ self.Ad.T + self.Q
        return A, Q


class SteadyState(NamedTuple):
    """What becomes of the estimation error if the plant is the model."""

    gain: Matrix
    """The observer's gain in the end, (n, p)."""
    radius: float
    """Spectral radius of (I − L C)Â^(T): what is left of the error after T, in the end; infinite if
    no steady state is found."""
    covariance: Matrix
    """Of x̂ − x right after a measurement, (n, n), by the random disturbances and noise alone;
    infinite if the error does not die."""


def true_model(resolved: Scenario) -> EstimationModel:
    """The model, with the disturbances and noise that the scenario really has."""
    loop, plant = loop_of(resolved), resolved.plant
    Ad, Bd = discretise(loop.A_model, loop.B_model, resolved.timing.plant_period_ns)
    _, G = discretise(loop.A_model, np.eye(loop.n), resolved.timing.plant_period_ns)
    at_state = variance_at("state", plant.disturbances, loop.n)
    at_input = variance_at("input", plant.disturbances, loop.m)
    Q = _spread(G, at_state) + _spread(Bd, at_input)
    C = np.eye(loop.n) if plant.measurement.C is None else np.array(plant.measurement.C)
    R = np.diag(plant.measurement.variance(loop.n))
    return EstimationModel(Ad, Bd, C, Q, R, plant.measure_every)


def believed_model(resolved: Scenario) -> EstimationModel:
    """The model with the covariances that the Kalman filter has been told, if it has."""
    model, kalman = true_model(resolved), resolved.observer
    if not isinstance(kalman, KalmanSettings):
        return model
    loop, disturbances = loop_of(resolved), resolved.plant.disturbances
    Q, R = model.Q, model.R
    if kalman.Q is not None:
        Q = np.array(kalman.Q)
    elif kalman.process_std is not None or kalman.input_std is not None:
        _, G = discretise(loop.A_model, np.eye(loop.n), resolved.timing.plant_period_ns)
        at_state = variance_at("state", disturbances, loop.n)
        at_input = variance_at("input", disturbances, loop.m)
        if kalman.process_std is not None:
            at_state = np.square(kalman.process_std)
        if kalman.input_std is not None:
            at_input = np.square(kalman.input_std)
        Q = _spread(G, at_state) + _spread(model.Bd, at_input)
    if kalman.R is not None:
        R = np.array(kalman.R)
    elif kalman.noise_std is not None:
        R = np.diag(np.square(kalman.noise_std))
    return model._replace(Q=Q, R=R)


def steady_state(resolved: Scenario) -> SteadyState:
    """What the observer of a resolved scenario comes to.

    The Kalman filter's gain is that of the discrete algebraic Riccati equation. The covariance P
    solves P = F P Fᵀ + (I − LC) Q (I − LC)ᵀ + L R Lᵀ, F = (I − LC)Â^(T), with the scenario's own Q
    and R, whatever the filter has been told. Without an observer x̂ = y, L = I.
    """
    # Much to import for a sensor.
    from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

    told, true, observer = believed_model(resolved), true_model(resolved), resolved.observer
    A, Q = told.over_a_measurement()
    n, C = len(A), told.C
    if isinstance(observer, LuenbergerSettings):
        L = np.array(observer.gain)
    elif isinstance(observer, KalmanSettings):
        try:
            predicted = solve_discrete_are(A.T, C.T, Q, told.R)
        except (np.linalg.LinAlgError, ValueError):  # the numbers are too far apart for it
            nowhere = np.full((n, n), np.inf)
            return SteadyState(np.full((n, len(C)), np.nan), np.inf, nowhere)
        L = np.linalg.solve(C @ predicted @ C.T + told.R, C @ predicted).T
    else:
        L = np.eye(n)
    rest = np.eye(n) - L @ C
    radius = float(np.abs(np.linalg.eigvals(rest @ A)).max())
    if radius >= 1:
        return SteadyState(L, radius, np.full((n, n), np.inf))
    _, Q = true.over_a_measurement()
    added = rest @ Q @ rest.T + L @ true.R @ L.T
    return SteadyState(L, radius, solve_discrete_lyapunov(rest @ A, added))


def _spread(through: Matrix, variance: Vector) -> Matrix:
    return np.asarray(through @ np.diag(variance) @ through.T)
