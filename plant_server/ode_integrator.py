"""Systems given by a differential equation, integrated from step to step with error control."""

import warnings
from collections.abc import Callable, Sequence

import numpy as np
from scipy.integrate import ode

from noack.core.linear_systems import Vector
from plant_server.system import SystemFailedError

Derivative = Callable[[float, Vector, Vector], Sequence[float] | Vector]
"""dz/dt = f(t, z, v): seconds, (N,), and the physical input v, (m,)."""

_RELATIVE, _ABSOLUTE = 1e-9, 1e-12
_MOST_STEPS = 10_000
_ESCAPE = 1e4
"""What grows by more within a step of the plant escapes to infinity in finite time."""
_GAVE_UP = {
    -2: f"it takes the integrator more than {_MOST_STEPS:,} steps from one sample to the next",
    -3: "the integrator's steps become too small; they jump there",
    -4: "they are too stiff for an explicit integrator",
}
"""What dopri5 says."""


def _same(values: Vector) -> Vector:
    return values


class OdeSystem:
    """``dz/dt = f(t, z, v)`` under a held input: Dormand & Prince's pair of orders 5 and 4.

    Every step of the plant starts the integrator anew, as the input jumps there: what it does
    depends on z, v and t alone, so that a replay repeats it bit for bit. Where z escapes to
    infinity, or f cannot be evaluated, z is NaN from then on, and the run has diverged.

    Args:
        derivative: f.
        z0: z(0), shape (N,).
        output: x as a function of z, shape (n,); by default z itself.
        physical: v as a function of u, shape (m,); by default u itself.
        relative, absolute: tolerances of each step of the integrator, the second in z's units.
        internal: whether z is to be on record.
    """

    def __init__(
        self,
        derivative: Derivative,
        z0: Vector,
        *,
        output: Callable[[Vector], Vector] = _same,
        physical: Callable[[Vector], Vector] = _same,
        relative: float = _RELATIVE,
        absolute: float = _ABSOLUTE,
        internal: bool = True,
    ) -> None:
        self._physical = physical
        self._output = output
        self._internal = internal
        self._state = np.array(z0, dtype=np.float64)
        self._derivative = derivative
        self._raised: list[BaseException] = []
        self._integrator = ode(self._guarded)
        self._integrator.set_integrator(
            "dopri5", rtol=relative, atol=absolute, nsteps=_MOST_STEPS, verbosity=-1
        )

    @property
    def x(self) -> Vector:
        """The deviation from the operating point, shape (n,)."""
        return self._output(self._state)

    @property
    def z(self) -> Vector:
        """The system's own state, shape (N,); empty if it is not to be on record."""
        return self._state if self._internal else self._state[:0]

    def advance(self, u: Vector, t_ns: int, dt_ns: int) -> None:
        """Integrate over one step.

        Raises:
            SystemFailedError: the tolerance cannot be reached, although f is finite.
            BaseException: whatever f raises that is not of arithmetic.
        """
        t_s = t_ns * 1e-9
        self._raised.clear()
        self._integrator.set_f_params(self._physical(u))
        self._integrator.set_initial_value(self._state, t_s)
        with warnings.catch_warnings(action="ignore"):  # it says so in its status, too
            end = self._integrator.integrate(t_s + dt_ns * 1e-9)
        reached = np.asarray(end, dtype=np.float64)
        for error in self._raised:
            # What f meets far outside of where it means anything is divergence.
            if not isinstance(error, ArithmeticError | ValueError):
                raise error
            reached = np.full_like(self._state, np.nan)
        if not self._integrator.successful():
            self._require_divergence(reached)
            reached = np.full_like(self._state, np.nan)
        self._state = reached

    def _require_divergence(self, z: Vector) -> None:
        """Raise SystemFailedError if the integrator gave up where f is finite, and z not large."""
        with np.errstate(all="ignore"):
            slope = np.asarray(self._guarded(self._integrator.t, z, *self._integrator.f_params))
            escaped = not np.linalg.norm(z) < _ESCAPE * np.linalg.norm(self._state)
        if np.isfinite(slope).all() and not escaped:
            why = _GAVE_UP.get(self._integrator.get_return_code(), "its tolerance is out of reach")
            raise SystemFailedError(
                f"the plant's equations cannot be followed at {self._integrator.t:.6g} s: {why}"
            )

    def _guarded(self, t_s: float, z: Vector, v: Vector) -> Sequence[float] | Vector:
        """``f``, which raises nothing: the integrator would go on calling it all the same."""
        if not self._raised:
            try:
                return self._derivative(t_s, z, v)
            except BaseException as error:
                self._raised.append(error)
        return np.full_like(z, np.nan)
