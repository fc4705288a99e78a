"""A system of differential equations, integrated from step to step with error control."""

import warnings
from collections.abc import Sequence

import numpy as np
from scipy.integrate import ode

from noack.core.linear_systems import Vector
from noack.plants.plant_settings import PlantEquations, SystemFailedError

_MAX_STEPS = 10_000
_ESCAPE = 1e4
"""If a state grows by this factor within a step of the plant, it has diverged."""
_GAVE_UP = {
    -2: f"the integrator needs more than {_MAX_STEPS:,} steps from one sample to the next",
    -3: "the integrator's steps become too small; the equations jump there",
    -4: "they are too stiff for an explicit integrator",
}
"""Status codes of dopri5, as text."""


class OdeSystem:
    """``dz/dt = f(t, z, v)`` under a constant input: Dormand & Prince's pair of orders 5 and 4.

    The integrator restarts at every step of the plant, because the input changes abruptly there. So
    the result depends on z, v and t alone, and a replay repeats it bit for bit. If z diverges, or f
    cannot be evaluated, z is NaN from then on: the run has diverged.
    """

    def __init__(self, equations: PlantEquations, x0: Vector) -> None:
        self._equations = equations
        self._state = np.array(equations.initial(x0), dtype=np.float64)
        self._raised: list[BaseException] = []
        self._advance = equations.advance or self._advance_by_derivative
        self._integrator = ode(self._guarded)
        self._integrator.set_integrator(
            "dopri5", rtol=equations.relative, atol=equations.absolute, nsteps=_MAX_STEPS,
            verbosity=-1,
        )  # fmt: skip

    @property
    def x(self) -> Vector:
        """The deviation from the operating point, shape (n,)."""
        return self._equations.output(self._state)

    @property
    def z(self) -> Vector:
        """The system's own state, shape (N,); empty if it is not recorded."""
        return self._state if self._equations.is_recorded else self._state[:0]

    def advance(self, u: Vector, t_ns: int, dt_ns: int) -> None:
        """Integrate over one step.

        Raises:
            SystemFailedError: the tolerance cannot be met, although f is finite.
            BaseException: f raised an exception that is not an arithmetic error.
        """
        v = self._equations.physical(u)
        self._raised.clear()
        reached, code, t_s = self._state.copy(), 0, t_ns * 1e-9
        try:
            code, t_s = self._advance(reached, v, t_s, dt_ns * 1e-9)
        except ArithmeticError as raised:  # from compiled code
            self._raised.append(raised)
        for error in self._raised:
            # Far outside the equations' domain an arithmetic error is divergence.
            if not isinstance(error, ArithmeticError | ValueError):
                raise error
            reached = np.full_like(self._state, np.nan)
        if code < 0:
            self._require_divergence(reached, v, t_s, code)
            reached = np.full_like(self._state, np.nan)
        self._state = reached

    def _advance_by_derivative(
        self, z: Vector, v: Vector, t_s: float, duration_s: float
    ) -> tuple[int, float]:
        self._integrator.set_f_params(v)
        self._integrator.set_initial_value(z, t_s)
        with warnings.catch_warnings(action="ignore"):  # the status has the same information
            z[:] = self._integrator.integrate(t_s + duration_s)
        return self._integrator.get_return_code(), self._integrator.t

    def _require_divergence(self, z: Vector, v: Vector, t_s: float, code: int) -> None:
        """Raise SystemFailedError if the integrator gave up although f is finite and z small."""
        with np.errstate(all="ignore"):
            slope = np.asarray(self._guarded(t_s, z, v))
            escaped = not np.linalg.norm(z) < _ESCAPE * np.linalg.norm(self._state)
        if np.isfinite(slope).all() and not escaped:
            why = _GAVE_UP.get(code, "the tolerance cannot be met")
            raise SystemFailedError(
                f"the plant's equations cannot be integrated at {t_s:.6g} s: {why}"
            )

    def _guarded(self, t_s: float, z: Vector, v: Vector) -> Sequence[float] | Vector:
        """Return f, or NaN after an exception: an exception cannot stop the integrator."""
        if not self._raised:
            try:
                return self._equations.derivative(t_s, z, v)
            except BaseException as error:
                self._raised.append(error)
        return np.full_like(z, np.nan)
