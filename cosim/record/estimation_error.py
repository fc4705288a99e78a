"""The difference between the plant's state and the state that the sensor measures or estimates."""

import numpy as np
from numpy.typing import NDArray

from cosim.record.run_record import Rows
from noack.config.resolution import steady_state
from noack.config.scenario import Scenario

Reals = NDArray[np.float64]


def true_states(steps: Rows, t_ns: NDArray[np.int64], column: str = "x") -> Reals:
    """Return the plant's own state at some times, (k, n); NaN if its row is missing.

    ``column`` of ``plant_step`` is ``x``, or ``z`` for the whole state of a nonlinear plant.
    """
    found = np.full((len(t_ns), steps[column].shape[1]), np.nan)
    if len(steps):
        place = np.searchsorted(steps["t_ns"], t_ns).clip(max=len(steps) - 1)
        there = steps["t_ns"][place] == t_ns
        found[there] = steps[column][place[there]]
    return found


def expected_rms(resolved: Scenario) -> float:
    """Return the steady-state RMS of ‖x̂ − x‖ from noise and disturbances, for an exact model."""
    return float(np.sqrt(np.trace(steady_state(resolved).covariance)))


class SizeStatistics:
    """Root mean square and maximum of finite norms, part by part."""

    def __init__(self) -> None:
        self._squares, self._count = 0.0, 0
        self.max: float | None = None

    def add(self, norms: Reals) -> None:
        """Add norms, (k,); those that are not finite are ignored."""
        norms = norms[np.isfinite(norms)]
        if len(norms):
            self._squares += float(np.square(norms).sum())
            self._count += len(norms)
            largest = float(norms.max())
            self.max = largest if self.max is None else max(self.max, largest)

    @property
    def rms(self) -> float | None:
        """Their root mean square; None without values."""
        return float(np.sqrt(self._squares / self._count)) if self._count else None
