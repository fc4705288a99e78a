"""The newest actuation at the plant, and which of its inputs is due.

An actuation for the model time t carries N inputs, for t, t + h, …, t + (N − 1)h, where h is the
period of the controller (packetised predictive control; by default N = 1). Input j is applied from
t + jh on, the last one until a newer actuation arrives.
"""

from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Vector
from noack.protocol.record_tables import NO_SEQUENCE
from noack.protocol.wire_format import NO_VECTOR


class Actuation(NamedTuple):
    """An actuation as received by the plant."""

    inputs: Matrix
    """The inputs, (N, m)."""
    x_c: Vector
    """The controller's model state at ``t_ns``, (n,), with watchdog policy ``model``; else (0,)."""
    t_ns: int
    sequence: int

    @property
    def u(self) -> Vector:
        """The input for ``t_ns``, (m,)."""
        u: Vector = self.inputs[0]
        return u


class InputBuffer:
    """Stores the newest actuation.

    Args:
        inputs: m.
        predictions: N.
        period_ns: h.
    """

    def __init__(self, inputs: int, predictions: int = 1, period_ns: int = 1) -> None:
        self._shape = predictions, inputs
        self._period_ns = period_ns
        self.newest = Actuation(np.zeros(self._shape), NO_VECTOR, 0, NO_SEQUENCE)

    def take(self, vector: Vector, t_ns: int, sequence: int) -> Actuation:
        """Store the vector of an actuation, its inputs and then x_c, if it carries it."""
        size = self._shape[0] * self._shape[1]
        # Slices are copied: a slice may have another memory layout than the vectors of a replay.
        inputs, x_c = vector[:size].copy(), vector[size:].copy()
        self.newest = Actuation(inputs.reshape(self._shape), x_c, t_ns, sequence)
        return self.newest

    def due(self, t_ns: int) -> tuple[Vector, int]:
        """Return the input for a time, (m,), and its number j."""
        age = (t_ns - self.newest.t_ns) // self._period_ns
        entry = min(max(age, 0), self._shape[0] - 1)
        return self.newest.inputs[entry], entry
