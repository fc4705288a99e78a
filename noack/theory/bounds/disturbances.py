"""The bounds of a scenario's disturbances and noise, which act as long as the run lasts.

Normally distributed values have no bound. All that are used, and their sums in the state and in the
estimation error, together exceed the assumed bounds in a run with at most the probability
``certificate.exceedance_probability``: each with that probability over their number.
"""

import math
from typing import NamedTuple

import numpy as np

from noack.config.scenario import Scenario
from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix, Vector
from noack.theory.bounds.gains import Forcing, NormalForcing


class NormalBounds(NamedTuple):
    """Bounds of normal values that a run exceeds with at most some probability."""

    each: float
    """The probability of each to exceed its bound."""

    def radius(self, size: int) -> float:
        """Return the bound of ‖v‖ for independent standard normal values v, (size,)."""
        # Imported here because the import is slow.
        from scipy.special import chdtri

        return math.sqrt(float(chdtri(size, self.each)))

    @property
    def limit(self) -> float:
        """The bound of a single value."""
        return self.radius(1)


def normal_bounds(resolved: Scenario) -> NormalBounds | None:
    """Return the bounds for a run; None if nothing is normally distributed."""
    timing, plant = resolved.timing, resolved.plant
    values = sum(int(one.deviations().any(axis=0).sum()) for one in plant.disturbances)
    noisy = any(plant.measurement.noise_std or ())
    if not values and not noisy:
        return None
    # At each step the values, their sum in x, and the estimation error.
    steps = timing.horizon_ns // timing.plant_period_ns + 1
    return NormalBounds(resolved.certificate.exceedance_probability / (steps * (values + 2)))


def forcing_of(resolved: Scenario, B: Matrix) -> Forcing | None:
    """Return the disturbances of a plant with the input matrix B, (n, m); None if it has none."""
    plant, bounds, (n, m) = resolved.plant, normal_bounds(resolved), B.shape
    if not plant.disturbances:
        return None
    columns, normal, durations_s = [np.zeros((n, 0))], [np.zeros((n, 0))], list[float]()
    at_input, period_s = np.zeros(m), resolved.timing.plant_period_ns / NS_PER_S
    for one in plant.disturbances:
        extent, deviations = one.extent(), one.deviations()
        if one.at == "input":
            at_input = at_input + np.abs(extent).sum(axis=1)
            if bounds is not None:
                at_input = at_input + bounds.limit * np.abs(deviations).sum(axis=1)
            extent, deviations = B @ extent, B @ deviations
        extent = extent[:, extent.any(axis=0)]
        columns.append(extent)
        normal.append(deviations[:, deviations.any(axis=0)])
        # The last step begins before the end.
        durations_s += [one.longest_s + period_s] * extent.shape[1]
    D = np.hstack(normal)
    of_normal = None
    if bounds is not None and D.size:
        of_normal = NormalForcing(D, period_s, bounds.limit, bounds.radius(n))
    return Forcing(np.hstack(columns), np.array(durations_s), at_input, of_normal)


def noise_bound(resolved: Scenario) -> Vector:
    """Return the bound of each entry of the bounded part of the noise v, y = C x + v, (p,)."""
    given = resolved.plant.measurement.noise_bound
    return np.zeros(resolved.message_sizes.outputs) if given is None else np.array(given)


def noise_deviations(resolved: Scenario) -> Vector:
    """Return the standard deviation of each entry of the normal part of the noise, (p,)."""
    given = resolved.plant.measurement.noise_std
    return np.zeros(resolved.message_sizes.outputs) if given is None else np.array(given)
