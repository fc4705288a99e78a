"""When a sensor transmits next, as data: the form that every policy has between two events.

With z = (x, e_s), the sensor transmits at the first time t at which

    ‖P z‖² > max(c e^{−ρ(t−t₀)}, f)² + ‖N z‖² + η(t),    η̇ = −λη + ‖P_η z‖² − ‖N_η z‖²,

but not before ``earliest_ns``, on a grid only at its points, and at ``latest_ns`` in any case.
A condition that integrates compares ∫‖P z‖dτ, from the last event to t, instead of ‖P z‖.

η and the integral are the *auxiliary variable* of a condition. The live sensor evaluates the
condition at its measurements: between two of them it takes ‖P_η z‖² − ‖N_η z‖² as it was at the
first, and integrates ‖P z‖ by the trapezoidal rule. Exact simulation finds the first t.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, Vector, norm
from noack.core.ordered_arithmetic import norm_of, product

NEVER_NS = math.inf


class QuadraticForm(NamedTuple):
    """The quadratic form ‖P z‖² − ‖N z‖² of z = (x, e_s)."""

    up: Matrix
    """P, shape (p, 2n)."""
    down: Matrix
    """N, shape (q, 2n); q = 0 for none."""

    @np.errstate(over="ignore", invalid="ignore")  # a run may diverge
    def values(self, z: Matrix) -> Vector:
        """‖P z‖² − ‖N z‖² of k z, shape (k, 2n) → (k,)."""
        up, down = (np.einsum("ij,ij->i", part, part) for part in (z @ self.up.T, z @ self.down.T))
        values: Vector = up - down
        return values


class ErrorForm(QuadraticForm):
    """‖e_s‖²: P z = e_s, and N is empty."""


class DynamicVariable(NamedTuple):
    """Girard's dynamic variable: η̇ = −λη + ψ(z)."""

    decay_per_s: float
    """λ."""
    gain: QuadraticForm
    """ψ."""

    def after(self, dt_s: float, dynamic_variable: float, gain: float) -> float:
        """η after a time in which ψ stays as it is."""
        decay = self.decay_per_s
        gained = -math.expm1(-decay * dt_s) / decay if decay else dt_s
        return dynamic_variable * math.exp(-decay * dt_s) + gained * gain


class TriggerCondition(NamedTuple):
    """The rule between two events."""

    form: QuadraticForm
    level: float = 0.0
    """c ≥ 0."""
    rate_per_s: float = 0.0
    """ρ ≥ 0."""
    since_ns: float = 0.0
    """t₀."""
    floor: float = 0.0
    """f ≥ 0."""
    earliest_ns: float = -math.inf
    latest_ns: float = NEVER_NS
    grid_ns: float = 0.0
    """Period of the times at which the comparison counts, from t = 0 on; 0: it always counts."""
    dynamic_variable: DynamicVariable | None = None
    integrates: bool = False
    """Whether ∫‖P z‖dτ since the last event is compared; then N is empty, and there is no η."""

    @property
    def has_auxiliary(self) -> bool:
        """Whether there is an auxiliary variable: η or the integral."""
        return self.integrates or self.dynamic_variable is not None

    def auxiliary_rates(self, z: Matrix) -> Vector:
        """Rates of the auxiliary variable, per second, at k z, shape (k, 2n) → (k,)."""
        if self.dynamic_variable is not None:
            return self.dynamic_variable.gain.values(z)
        rates: Vector = np.linalg.norm(z @ self.form.up.T, axis=1)
        return rates

    def auxiliary_after(self, dt_s: float, auxiliary: float, first: float, last: float) -> float:
        """The auxiliary variable after a time, from its rates at the first and the last time."""
        if self.dynamic_variable is not None:
            return self.dynamic_variable.after(dt_s, auxiliary, first)
        return auxiliary + dt_s * (first + last) / 2

    def threshold(self, t_ns: float) -> float:
        """max(c e^{−ρ(t−t₀)}, f)."""
        decayed = self.level * math.exp(-self.rate_per_s * (t_ns - self.since_ns) * 1e-9)
        return max(decayed, self.floor)

    def sides(
        self, t_ns: float, x: Vector, e_s: Vector, auxiliary: float = 0.0
    ) -> "ComparisonSides":
        """Both sides of the comparison; without an integral, as square roots."""
        right = self.threshold(t_ns)
        if self.integrates:
            return ComparisonSides(auxiliary, right)
        is_error = isinstance(self.form, ErrorForm) and auxiliary <= 0
        if is_error and math.isfinite(left := norm(e_s)):
            return ComparisonSides(left, right)  # the same bits as below, in less time
        z = np.concatenate([x, e_s])
        if len(self.form.down) or auxiliary > 0:
            parts = right, norm(product(self.form.down, z)), math.sqrt(max(auxiliary, 0.0))
            right = norm_of(parts, 0, len(parts))
        return ComparisonSides(norm(product(self.form.up, z)), right)

    def exceeds(
        self, t_ns: NDArray[Any], z: Matrix, auxiliary: Vector | float = 0.0
    ) -> NDArray[np.bool_]:
        """Whether the comparison holds at k times, counted or not; z has the shape (k, 2n)."""
        decayed = self.level * np.exp(-self.rate_per_s * 1e-9 * (t_ns - self.since_ns))
        right = np.maximum(decayed, self.floor)
        if self.integrates:
            return np.asarray(auxiliary > right)
        right = np.hypot(right, np.linalg.norm(z @ self.form.down.T, axis=1))
        right = np.hypot(right, np.sqrt(np.maximum(auxiliary, 0.0)))
        found: NDArray[np.bool_] = np.linalg.norm(z @ self.form.up.T, axis=1) > right
        return found

    def counts_at(self, t_ns: int) -> bool:
        """Whether the comparison counts at a time."""
        return t_ns >= self.earliest_ns and (self.grid_ns == 0 or t_ns % self.grid_ns == 0)


class ComparisonSides(NamedTuple):
    """The two sides of a comparison: the sensor transmits if ``left`` exceeds ``right``."""

    left: float
    right: float


def error_map(n: int, weight: Matrix | None = None) -> Matrix:
    """[0 W], which takes z to W e_s, shape (n, 2n)."""
    return np.hstack([np.zeros((n, n)), np.eye(n) if weight is None else weight])


def error_form(n: int, weight: Matrix | None = None) -> QuadraticForm:
    """‖W e_s‖²."""
    kind = ErrorForm if weight is None else QuadraticForm
    return kind(error_map(n, weight), empty_map(n))


def state_map(n: int, weight: Matrix | None = None) -> Matrix:
    """[W 0], which takes z to W x, shape (n, 2n)."""
    return np.hstack([np.eye(n) if weight is None else weight, np.zeros((n, n))])


def empty_map(n: int) -> Matrix:
    """No rows: the N of a form without one."""
    return np.zeros((0, 2 * n))


def quadratic_form(Q: Matrix) -> QuadraticForm:
    """The form zᵀQz of a symmetric matrix, (2n, 2n), as the difference of two squares."""
    values, vectors = np.linalg.eigh(Q)
    rows = np.sqrt(np.abs(values))[:, None] * vectors.T
    return QuadraticForm(rows[values > 0], rows[values < 0])
