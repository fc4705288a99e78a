"""The sum of a plant's disturbances, as a function of the step number."""

from collections.abc import Callable
from functools import partial

import numpy as np

from noack.config.scenario import Scenario
from noack.core.linear_systems import Matrix, Vector
from noack.disturbances.disturbance_settings import Place, SignalSource

_BLOCK = 256
"""Number of steps computed at once. A random value depends on its step's number only."""

Signal = Callable[[range], Matrix]
"""Steps → the value added during each step, (k, entries)."""


class Disturbance:
    """The sum of all disturbances at the input, and of all at the state."""

    def __init__(self, at_input: list[Signal], at_state: list[Signal]) -> None:
        self._parts = at_input, at_state
        self._first = -1
        self._d = self._w = np.zeros((0, 0))

    def __call__(self, step: int) -> tuple[Vector, Vector]:
        """Return d, shape (m,), and w, shape (n,), of a step; shape (0,) without a disturbance."""
        first = step - step % _BLOCK
        if first != self._first:
            self._first = first
            steps = range(first, first + _BLOCK)
            self._d, self._w = (_sum(signals, steps) for signals in self._parts)
        # A slice is copied: its memory layout then equals that of a replay from another step.
        return self._d[step - first].copy(), self._w[step - first].copy()


def disturbance_of(resolved: Scenario) -> Disturbance | None:
    """Return the disturbances of a resolved scenario's plant; None if it has none."""
    if not resolved.plant.disturbances:
        return None
    signals: dict[Place, list[Signal]] = {"input": [], "state": []}
    for number, one in enumerate(resolved.plant.disturbances):
        name = ("plant", "disturbance", str(number))
        source = SignalSource(resolved.timing.plant_period_ns, resolved.seeds.disturbance, name)
        signals[one.at].append(partial(one.signal, source=source))
    return Disturbance(signals["input"], signals["state"])


def _sum(signals: list[Signal], steps: range) -> Matrix:
    if not signals:
        return np.zeros((len(steps), 0))
    return np.asarray(sum(signal(steps) for signal in signals))
