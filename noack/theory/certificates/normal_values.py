"""Bounds of normally distributed values, which have none: a run exceeds these with a small probability.

A run of a loop draws finitely many values. Each exceeds its bound with
``certificate.exceedance_probability``, divided by their number; so one of them does with at most this
probability. It is that of each loop of a run.
"""

import math

from noack.disturbances.disturbance_settings import DisturbanceSettings
from noack.disturbances.gaussian import GaussianDisturbance
from noack.disturbances.uniform import UniformDisturbance
from noack.scenario.scenario import Scenario
from noack.scenario.sections import PlantSection


def normal_limit(resolved: Scenario) -> float | None:
    """Return the bound of each value, in standard deviations; None if nothing is normally distributed."""
    plant = resolved.plant
    normal = [each.std for each in plant.disturbances if isinstance(each, GaussianDisturbance)]
    values = sum(sum(map(bool, std)) for std in (*normal, plant.measurement.noise_std or ()))
    if not values:
        return None
    from scipy.special import chdtri  # slow to import

    steps = resolved.timing.last_step + 1
    return math.sqrt(float(chdtri(1, resolved.certificate.exceedance_probability / (steps * values))))


def with_bounded_values(resolved: Scenario) -> PlantSection:
    """Return the plant of a resolved scenario with bounded values in the place of normal ones."""
    plant, limit = resolved.plant, normal_limit(resolved) or 0.0  # None: each standard deviation is 0
    measurement, noise_std = plant.measurement, plant.measurement.noise_std
    if noise_std is not None and any(noise_std):
        known = measurement.noise_bound or (0.0,) * len(noise_std)
        bound = tuple(each + _above(limit, std) for each, std in zip(known, noise_std, strict=True))
        measurement = measurement.model_copy(update={"noise_std": None, "noise_bound": bound})
    disturbances = tuple(_bounded(each, limit) for each in plant.disturbances)
    return plant.model_copy(update={"measurement": measurement, "disturbances": disturbances})


def _bounded(disturbance: DisturbanceSettings, limit: float) -> DisturbanceSettings:
    if not isinstance(disturbance, GaussianDisturbance):
        return disturbance
    content = disturbance.model_dump(exclude={"kind", "std"})
    bound = tuple(_above(limit, std) for std in disturbance.std)
    return UniformDisturbance.model_validate({"kind": "uniform", "bound": bound, **content})


def _above(limit: float, std: float) -> float:
    """Return a bound, with room for rounding; 0 stays 0."""
    return limit * std * (1 + 1e-12)
