"""When a sensor transmits next, as data: what every policy comes down to between two events.

With z = (x, e_s), the sensor transmits at the first time t at which

    ‖P z‖² > max(c e^{−ρ(t−t₀)}, f)² + ‖N z‖² + η(t),    η̇ = −λη + ‖P_η z‖² − ‖N_η z‖²,

though not before ``earliest_ns`` and, on a grid, at its points only; and at ``latest_ns`` anyhow.
The live sensor evaluates this at its measurements; exact simulation finds the first t between them.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, Vector, norm

NEVER_NS = math.inf


class QuadraticForm(NamedTuple):
    """The quadratic form ‖P z‖² − ‖N z‖² of z = (x, e_s)."""

    up: Matrix
    """P, shape (p, 2n)."""
    down: Matrix
    """N, shape (q, 2n); q = 0 for none."""

    def value(self, z: Vector) -> float:
        """‖P z‖² − ‖N z‖² of a z of shape (2n,)."""
        up, down = norm(self.up @ z), norm(self.down @ z)
        return up * up - down * down  # where a float's power would raise, its product is infinite

    def values(self, z: Matrix) -> Vector:
        """The same of k z, shape (k, 2n) → (k,)."""
        up, down = (np.einsum("ij,ij->i", part, part) for part in (z @ self.up.T, z @ self.down.T))
        values: Vector = up - down
        return values


class DynamicVariable(NamedTuple):
    """What a dynamic rule has saved up: η̇ = −λη + ψ(z)."""

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
    """Distance of the points at which the rule is looked at, from t = 0 on; 0: it always is."""
    dynamic_variable: DynamicVariable | None = None

    def threshold(self, t_ns: float) -> float:
        """max(c e^{−ρ(t−t₀)}, f)."""
        faded = self.level * math.exp(-self.rate_per_s * (t_ns - self.since_ns) * 1e-9)
        return max(faded, self.floor)

    def sides(
        self, t_ns: float, x: Vector, e_s: Vector, dynamic_variable: float = 0.0
    ) -> "ComparisonSides":
        """Both sides of the rule's comparison, as square roots.

        Args:
            t_ns: time.
            x: the plant's state, shape (n,).
            e_s: the sensor's error, shape (n,).
            dynamic_variable: η.
        """
        z = np.concatenate([x, e_s])
        left, right = norm(self.form.up @ z), self.threshold(t_ns)
        if len(self.form.down) or dynamic_variable > 0:
            right = math.hypot(
                right, norm(self.form.down @ z), math.sqrt(max(dynamic_variable, 0.0))
            )
        return ComparisonSides(left, right)

    def exceeds(
        self, t_ns: NDArray[Any], z: Matrix, dynamic_variable: Vector | float = 0.0
    ) -> NDArray[np.bool_]:
        """Whether the comparison holds at k times, whether it counts there or not.

        Args:
            t_ns: times, shape (k,).
            z: (x, e_s) at them, shape (k, 2n).
            dynamic_variable: η at them.
        """
        faded = self.level * np.exp(-self.rate_per_s * 1e-9 * (t_ns - self.since_ns))
        down = np.linalg.norm(z @ self.form.down.T, axis=1)
        right = np.hypot(np.maximum(faded, self.floor), down)
        right = np.hypot(right, np.sqrt(np.maximum(dynamic_variable, 0.0)))
        found: NDArray[np.bool_] = np.linalg.norm(z @ self.form.up.T, axis=1) > right
        return found

    def is_looked_at(self, t_ns: int) -> bool:
        """Whether the comparison counts at a time; what is due at the latest does anyhow."""
        return t_ns >= self.earliest_ns and (self.grid_ns == 0 or t_ns % self.grid_ns == 0)


class ComparisonSides(NamedTuple):
    """What is compared: the sensor transmits if ``left`` exceeds ``right``."""

    left: float
    right: float


def error_map(n: int, weight: Matrix | None = None) -> Matrix:
    """[0 W], which takes z to W e_s, shape (n, 2n)."""
    return np.hstack([np.zeros((n, n)), np.eye(n) if weight is None else weight])


def state_map(n: int, weight: Matrix | None = None) -> Matrix:
    """[W 0], which takes z to W x, shape (n, 2n)."""
    return np.hstack([np.eye(n) if weight is None else weight, np.zeros((n, n))])


def empty_map(n: int) -> Matrix:
    """No rows, for an N that is not there."""
    return np.zeros((0, 2 * n))


def quadratic_form(Q: Matrix) -> QuadraticForm:
    """The form zᵀQz of a symmetric matrix, as the difference of two squares.

    Args:
        Q: symmetric, shape (2n, 2n).
    """
    values, vectors = np.linalg.eigh(Q)
    rows = np.sqrt(np.abs(values))[:, None] * vectors.T
    return QuadraticForm(rows[values > 0], rows[values < 0])
