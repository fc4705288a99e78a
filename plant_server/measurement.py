"""The measurement of a plant: y = C x + v, where v is a function of the measurement's number."""

import numpy as np

from noack.config.scenario import Scenario
from noack.core.linear_systems import Matrix, Vector
from noack.core.random_streams import normals, uniforms
from plant_server.disturbance_signal import BLOCK


class MeasurementModel:
    """Measures the state, with noise.

    C has the shape (p, n); None is the identity, with exactly y = x + v. ``std`` is the standard
    deviation of a normally distributed part of v, ``bound`` the bound of a uniform part, (p,) each.
    """

    def __init__(self, C: Matrix | None, std: Vector, bound: Vector, seed: int) -> None:
        self.C = C
        self._std, self._bound, self._seed = std, bound, seed
        self.is_noisy = bool(std.any() or bound.any())

    def noise(self, first: int, count: int = BLOCK) -> Matrix:
        """Return v of the ``count`` measurements from number ``first`` on, (count, p)."""
        rows, width = range(first, first + count), len(self._std)
        name = ("plant", "measurement")
        normal = normals(self._seed, *name, "normal", rows=rows, width=width)
        unit = uniforms(self._seed, *name, "uniform", rows=rows, width=width)
        noise: Matrix = self._std * normal + self._bound * (2.0 * unit - 1.0)
        return noise


def measurement_model_of(resolved: Scenario) -> MeasurementModel | None:
    """Return the measurement model of a resolved scenario; None if y is exactly x."""
    settings, n = resolved.plant.measurement, resolved.model.dimensions[0]
    if settings.selects_all(n) and not settings.is_noisy:
        return None
    p = resolved.message_sizes.outputs
    std, bound = (
        np.zeros(p) if given is None else np.array(given)
        for given in (settings.noise_std, settings.noise_bound)
    )
    C = None if settings.selects_all(n) else np.array(settings.C)
    return MeasurementModel(C, std, bound, resolved.seeds.noise)
