"""Systems given by a differential equation, integrated from step to step with error control."""

import warnings
from collections.abc import Callable, Sequence

import numpy as np
from scipy.integrate import ode

from noack.linear import Vector

Derivative = Callable[[float, Vector, Vector], Sequence[float] | Vector]
"""dz/dt = f(t, z, v): seconds, (N,), and the physical input v, (m,)."""

_RELATIVE, _ABSOLUTE = 1e-9, 1e-12
_MOST_STEPS = 10_000


def _same(values: Vector) -> Vector:
    return values


class OdeSystem:
    """``dz/dt = f(t, z, v)`` under a held input: Dormand & Prince's pair of orders 5 and 4.

    Every step of the plant starts the integrator anew, as the input jumps there: what it does
    depends on z, v and t alone, so that a replay repeats it bit for bit. Where it cannot reach its
    tolerance, or f cannot be evaluated, z is NaN from then on, and the run has diverged.

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
        self._raised: list[Exception] = []
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
            Exception: whatever f raises that is not of arithmetic.
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
        self._state = reached if self._integrator.successful() else np.full_like(reached, np.nan)

    def _guarded(self, t_s: float, z: Vector, v: Vector) -> Sequence[float] | Vector:
        """``f``, which raises nothing: the integrator would go on calling it all the same."""
        if not self._raised:
            try:
                return self._derivative(t_s, z, v)
            except Exception as error:
                self._raised.append(error)
        return np.full_like(z, np.nan)
