"""What disturbs a plant, as a function of the number of its step."""

from collections.abc import Callable

import numpy as np

from noack.config.disturbances import (
    AnyDisturbance,
    GaussianDisturbance,
    Place,
    SineDisturbance,
    StepDisturbance,
    UniformDisturbance,
)
from noack.config.scenario import Scenario
from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix, Vector
from noack.core.random_streams import normals, uniforms

_BLOCK = 256
"""Steps that are computed at once; what is random depends on the step's number, not on this."""

Rows = Callable[[range], Matrix]
"""Steps → what is added during each of them, (k, entries)."""


class Disturbance:
    """The sum of all disturbances at the input, and of all at the state.

    Args:
        at_input: each one at the input.
        at_state: each one at the state.
    """

    def __init__(self, at_input: list[Rows], at_state: list[Rows]) -> None:
        self._parts = at_input, at_state
        self._first = -1
        self._d = self._w = np.zeros((0, 0))

    def __call__(self, step: int) -> tuple[Vector, Vector]:
        """Return d, shape (m,), and w, shape (n,), of a step; (0,) where nothing is added."""
        first = step - step % _BLOCK
        if first != self._first:
            self._first = first
            steps = range(first, first + _BLOCK)
            self._d, self._w = (_summed(rows, steps) for rows in self._parts)
        # A copy lies in memory as in a replay that begins elsewhere.
        return self._d[step - first].copy(), self._w[step - first].copy()


def disturbance_of(resolved: Scenario) -> Disturbance | None:
    """Return what disturbs the plant of a resolved scenario; None if nothing does."""
    disturbances = resolved.plant.disturbances
    if not disturbances:
        return None
    seed, period_ns = resolved.seeds.disturbance, resolved.timing.plant_period_ns
    found: dict[Place, list[Rows]] = {"input": [], "state": []}
    for number, one in enumerate(disturbances):
        found[one.at].append(_rows_of(one, seed, number, period_ns))
    return Disturbance(found["input"], found["state"])


def _rows_of(settings: AnyDisturbance, seed: int, number: int, period_ns: int) -> Rows:
    """One disturbance, of a stream of its own if it is random."""
    size, name = np.array(settings.size[1]), ("plant", "disturbance", str(number))

    def rows(steps: range) -> Matrix:
        match settings:
            case UniformDisturbance():
                unit = uniforms(seed, *name, rows=steps, width=len(size))
                return np.asarray(size * (2.0 * unit - 1.0))
            case GaussianDisturbance():
                return np.asarray(size * normals(seed, *name, rows=steps, width=len(size)))
            case SineDisturbance(hz=hz, phase_rad=phase_rad):
                t_s = np.array(steps) * period_ns * 1e-9
                return np.outer(np.sin(2 * np.pi * hz * t_s + phase_rad), size)
            case StepDisturbance(from_s=from_s, until_s=until_s):
                t_ns = np.array(steps) * period_ns
                there = t_ns >= round(from_s * NS_PER_S)
                if until_s is not None:
                    there &= t_ns < round(until_s * NS_PER_S)
                return np.outer(there, size)

    return rows


def _summed(parts: list[Rows], steps: range) -> Matrix:
    if not parts:
        return np.zeros((len(steps), 0))
    return np.asarray(sum(rows(steps) for rows in parts))
