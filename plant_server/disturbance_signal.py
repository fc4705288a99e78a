"""The sum of a plant's disturbances, as a function of the step number."""

from collections.abc import Callable
from functools import partial

import numpy as np

from noack.config.scenario import Scenario
from noack.core.linear_systems import Matrix
from noack.disturbances.disturbance_settings import Place, SignalSource

BLOCK = 256
"""Number of steps computed at once. A random value depends on its step's number only."""

Signal = Callable[[range], Matrix]
"""Steps → the value added during each step, (k, entries)."""


class Disturbance:
    """The sum of all disturbances at the input, and of all at the state.

    Args:
        at_input: disturbances of u.
        at_state: disturbances of ẋ.
        widths: their entries, m and n; 0 where there is no disturbance.
    """

    def __init__(
        self, at_input: list[Signal], at_state: list[Signal], widths: tuple[int, int]
    ) -> None:
        self._parts, self.widths = (at_input, at_state), widths

    def block(self, first: int) -> tuple[Matrix, Matrix]:
        """Return d, shape (k, m), and w, (k, n), of the ``BLOCK`` steps from ``first`` on.

        The shape is (k, 0) where there is no disturbance.
        """
        return self.values(range(first, first + BLOCK))

    def values(self, steps: range) -> tuple[Matrix, Matrix]:
        """Return d, shape (k, m), and w, (k, n), of some steps; see :meth:`block`."""
        d, w = (_sum(signals, steps) for signals in self._parts)
        return d, w


def disturbance_of(resolved: Scenario) -> Disturbance | None:
    """Return the disturbances of a resolved scenario's plant; None if it has none."""
    if not resolved.plant.disturbances:
        return None
    signals: dict[Place, list[Signal]] = {"input": [], "state": []}
    for number, one in enumerate(resolved.plant.disturbances):
        name = ("plant", "disturbance", str(number))
        source = SignalSource(resolved.timing.plant_period_ns, resolved.seeds.disturbance, name)
        signals[one.at].append(partial(one.signal, source=source))
    n, m = resolved.model.dimensions
    widths = m * bool(signals["input"]), n * bool(signals["state"])
    return Disturbance(signals["input"], signals["state"], widths)


def _sum(signals: list[Signal], steps: range) -> Matrix:
    if not signals:
        return np.zeros((len(steps), 0))
    return np.asarray(sum(signal(steps) for signal in signals))
