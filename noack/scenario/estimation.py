"""The discrete-time model of an observer, with the noise of the scenario, and its steady state."""

from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, discretise
from noack.observers.observer_settings import EstimationModel
from noack.scenario.scenario import Scenario


class SteadyState(NamedTuple):
    """The estimation error in the steady state, if the plant equals the model."""

    gain: Matrix  # the observer's gain, (n, p)
    radius: float
    """Spectral radius of (I − L C)Â^(T), the factor by which the error shrinks per measurement;
    infinite if no steady state is found."""
    covariance: Matrix
    """Covariance of x̂ − x right after a measurement, (n, n), caused by random disturbances and
    noise only; infinite if the error does not decay."""


def true_model(resolved: Scenario) -> EstimationModel:
    """The model with the covariances of the scenario's disturbances and noise."""
    (A, B), (n, m), plant = resolved.model.matrices, resolved.model.dimensions, resolved.plant
    noise = plant.noise_variances(n, m)
    Ad, Bd = discretise(A, B, float(resolved.timing.plant_period.exact))
    _, Gd = discretise(A, np.eye(n), float(resolved.timing.plant_period.exact))
    C = plant.measurement.matrix(n)
    model = EstimationModel(Ad, Bd, Gd, C, np.zeros_like(Ad), np.diag(noise.output), plant.measure_every)
    return model._replace(Q=model.process_covariance(noise.at_state, noise.at_input))


def assumed_model(resolved: Scenario) -> EstimationModel:
    """The model with the covariances that the observer assumes."""
    model, observer = true_model(resolved), resolved.observer
    if observer is None:
        return model
    noise = resolved.plant.noise_variances(*resolved.model.dimensions)
    return observer.assumed_model(model, noise)


def steady_state(resolved: Scenario) -> SteadyState:
    """Return the steady state of the estimation error of a resolved scenario.

    The covariance P solves P = F P Fᵀ + (I − LC) Q (I − LC)ᵀ + L R Lᵀ with F = (I − LC)Â^(T). Q and
    R are the scenario's own, even if the observer assumes others. Without an observer x̂ = y, L =
    I.
    """
    true, observer = true_model(resolved), resolved.observer
    A, Q = true.between_measurements()
    n, C = len(A), true.C
    L = np.eye(n) if observer is None else observer.steady_gain(assumed_model(resolved))
    if L is None:
        return SteadyState(np.full((n, len(C)), np.nan), np.inf, np.full((n, n), np.inf))
    update_factor = np.eye(n) - L @ C
    radius = float(np.abs(np.linalg.eigvals(update_factor @ A)).max())
    if radius >= 1:
        return SteadyState(L, radius, np.full((n, n), np.inf))
    added = update_factor @ Q @ update_factor.T + L @ true.R @ L.T
    return SteadyState(L, radius, _stationary_covariance(update_factor @ A, added))


_MOST_DOUBLINGS = 64


def _stationary_covariance(F: Matrix, Q: Matrix) -> Matrix:
    """Return Σ F^k Q (F^k)ᵀ over all k ≥ 0, (n, n), of an F whose spectral radius is below 1.

    It is P of P = F P Fᵀ + Q. Sums of twice as many terms follow from each other. Unlike the linear
    equations of P, they are exact to rounding if the gain of an observer is large.
    """
    P = Q
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_MOST_DOUBLINGS):
            longer = P + F @ P @ F.T
            if np.array_equal(longer, P):
                return P
            P, F = longer, F @ F
    return P if np.isfinite(P).all() else np.full_like(Q, np.inf)
