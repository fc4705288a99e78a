"""The model of sensor and controller between updates: dx/dt = H(x − x_r), solved exactly.

The set-point x_r changes at the same times in sensor and controller, so both models stay equal.
"""

from bisect import bisect_right

import numpy as np

from noack.core.linear_systems import Matrix, Propagator, Vector


class ModelFlow:
    """Propagates the state of the model with the closed-loop matrix H, (n, n), per second.

    ``setpoint`` is the initial x_r, (n,); None is 0.
    """

    def __init__(self, H: Matrix, setpoint: Vector | None = None) -> None:
        self.propagate = Propagator(H)
        self._since_ns: list[int] = []
        self._setpoints = [setpoint]
        self.moved = setpoint is not None
        """Whether any set-point differs from 0."""

    def change(self, since_ns: int, setpoint: Vector | None) -> None:
        """Change the set-point from ``since_ns`` on; times must not decrease."""
        if not _same(self._setpoints[-1], setpoint):
            self._since_ns.append(since_ns)
            self._setpoints.append(setpoint)
            self.moved = True

    def __call__(self, x: Vector, from_ns: int, to_ns: int) -> Vector:
        """Return the state at ``to_ns`` of a model with state ``x``, (n,), at ``from_ns``."""
        if not self.moved:
            return self.propagate(x, to_ns - from_ns)
        place = bisect_right(self._since_ns, from_ns)
        while place < len(self._since_ns) and self._since_ns[place] < to_ns:
            x = self._about(self._setpoints[place], x, self._since_ns[place] - from_ns)
            from_ns = self._since_ns[place]
            place += 1
        return self._about(self._setpoints[place], x, to_ns - from_ns)

    def _about(self, setpoint: Vector | None, x: Vector, dt_ns: int) -> Vector:
        if setpoint is None or dt_ns == 0:
            return self.propagate(x, dt_ns)
        moved: Vector = setpoint + self.propagate(x - setpoint, dt_ns)
        return moved


def _same(one: Vector | None, other: Vector | None) -> bool:
    if one is None or other is None:
        return one is other
    return bool(np.array_equal(one, other))
