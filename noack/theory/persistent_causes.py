"""The bounds of a scenario's disturbances and noise, which act as long as the run lasts.

Normally distributed values have no bound. All of a run together exceed ``normal`` standard
deviations with at most the probability ``certificate.exceedance_probability``.
"""

from statistics import NormalDist

import numpy as np

from noack.config.scenario import Scenario
from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix, Vector
from noack.theory.gains import Forcing


def normal_bound(resolved: Scenario) -> float | None:
    """Return the assumed bound of all standard normal values of a run; None if it has none."""
    timing, plant = resolved.timing, resolved.plant
    steps = timing.horizon_ns // timing.plant_period_ns + 1
    noisy = int(np.count_nonzero(plant.measurement.noise_std or ()))
    values = steps * (noisy + sum(one.normal_entries for one in plant.disturbances))
    if values == 0:
        return None
    return -NormalDist().inv_cdf(resolved.certificate.exceedance_probability / (2 * values))


def forcing_of(resolved: Scenario, B: Matrix) -> Forcing | None:
    """Return the disturbances of a plant with the input matrix B, (n, m); None if it has none."""
    plant, normal = resolved.plant, normal_bound(resolved) or 0.0
    if not plant.disturbances:
        return None
    columns, durations_s, at_input = [], [], np.zeros(B.shape[1])
    for one in plant.disturbances:
        extent = one.extent(normal)
        extent = extent[:, extent.any(axis=0)]
        if one.at == "input":
            at_input = at_input + np.abs(extent).sum(axis=1)
        columns.append(B @ extent if one.at == "input" else extent)
        # The last step begins before the end.
        lasting_s = one.longest_s + resolved.timing.plant_period_ns / NS_PER_S
        durations_s += [lasting_s] * extent.shape[1]
    return Forcing(np.hstack(columns), np.array(durations_s), at_input)


def noise_bound(resolved: Scenario) -> Vector:
    """Return the bound of each entry of the noise v in y = C x + v, (p,)."""
    measurement, p = resolved.plant.measurement, resolved.message_sizes.outputs
    uniform = np.zeros(p) if measurement.noise_bound is None else np.array(measurement.noise_bound)
    if measurement.noise_std is None:
        return uniform
    return uniform + (normal_bound(resolved) or 0.0) * np.array(measurement.noise_std)
