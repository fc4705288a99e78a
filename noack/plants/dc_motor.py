"""A DC motor: armature voltage to shaft angle, with Coulomb friction and exact stiction.

L di/dt = V − R i − Ke ω, J dω/dt = Kt i − b ω − T_f, dθ/dt = ω. While the shaft turns, the friction
torque T_f is T_c sign(ω). While it stands, T_f balances Kt i up to T_c: the shaft sticks as long as
|Kt i| ≤ T_c. So the motor is linear between two changes of the friction's direction. Each linear
motion is computed in closed form. The time of each change is a root of ω(t), or of |Kt i| − T_c
while the shaft sticks. Nothing is smoothed and no integrator is used: the electrical time constant
L/R may be arbitrarily short.
"""

import cmath
import math
from collections.abc import Iterator
from typing import ClassVar, Literal

import numpy as np

from netem.core.settings_section import NonNegative, Positive
from noack.core.linear_systems import Matrix, Vector
from noack.plants.plant_settings import PlantSettings, PlantStart, SystemFailedError

_MAX_CHANGES = 10_000
"""Largest number of changes of the friction's direction within a step."""
_BISECTIONS = 100
"""Most bisections; fewer find a time as exactly as double precision permits."""
_REAL = 1e-9
"""A time with a larger relative imaginary part is not an extremum."""


class DcMotorSettings(PlantSettings):
    """A DC motor with viscous and Coulomb friction; a voltage turns its shaft.

    The default parameters are those of the Control Tutorials for MATLAB and Simulink (University of
    Michigan, "DC Motor Position"), which has no Coulomb friction.
    """

    states: ClassVar = ("shaft angle, rad", "speed, rad/s", "armature current, A")
    inputs: ClassVar = ("armature voltage, V",)
    scenario: ClassVar = "dc_motor"
    has_equations: ClassVar = True

    kind: Literal["dc_motor"]
    resistance_ohm: Positive = 4.0
    """R of the armature."""
    inductance_h: Positive = 2.75e-6
    """L of the armature."""
    torque_constant_n_m_per_a: Positive = 0.0274
    """Kt: torque per current."""
    voltage_constant_v_s_per_rad: Positive = 0.0274
    """Ke: back electromotive force per speed."""
    inertia_kg_m2: Positive = 3.2284e-6
    """J of rotor and load."""
    friction_n_m_s: NonNegative = 3.5077e-6
    """b, viscous friction."""
    coulomb_friction_n_m: NonNegative = 0.0
    """T_c, Coulomb friction; also the largest torque at which the shaft sticks."""

    def linearisation(self) -> tuple[Matrix, Matrix]:
        """Return A and B without Coulomb friction, which has no linearisation at standstill."""
        matrix, voltage = self.dynamics()
        A, B = np.zeros((3, 3)), np.zeros((3, 1))
        A[0, 1], A[1:, 1:], B[1:, 0] = 1.0, matrix, voltage
        return A, B

    def dynamics(self) -> tuple[Matrix, Vector]:
        """Return M and p of d(ω, i)/dt = M (ω, i) + p V, without Coulomb friction."""
        J, L = self.inertia_kg_m2, self.inductance_h
        rows = [
            [-self.friction_n_m_s / J, self.torque_constant_n_m_per_a / J],
            [-self.voltage_constant_v_s_per_rad / L, -self.resistance_ohm / L],
        ]
        return np.array(rows), np.array([0.0, 1 / L])

    def system(self, start: PlantStart) -> "DcMotor":
        return DcMotor(self, start.x0)


class DcMotor:
    """The motor; x is shaft angle, speed and current, and z is empty."""

    def __init__(self, settings: DcMotorSettings, x0: Vector) -> None:
        self._settings = settings
        self._turning = _LinearMotion(settings)
        self._deceleration = settings.coulomb_friction_n_m / settings.inertia_kg_m2
        self._breakaway_a = settings.coulomb_friction_n_m / settings.torque_constant_n_m_per_a
        self.x = np.array(x0, dtype=np.float64)
        self.z = np.zeros(0)

    def expressions(self, t_s: float, x: Vector, u: Vector) -> tuple[Vector, Vector]:
        """Return dx/dt and x; while the shaft sticks, sign(0) stands for any number from −1 to 1."""
        matrix, voltage = self._settings.dynamics()
        rates = np.concatenate([x[1:2], matrix @ x[1:] + voltage * u[0]])
        if self._deceleration:
            rates[1] = rates[1] - self._deceleration * np.sign(x[1])
        return rates, x

    def advance(self, u: Vector, t_ns: int, dt_ns: int) -> None:
        """Advance through all changes of the friction's direction within the step."""
        angle, speed, current = self.x.tolist()
        voltage, left_s = float(u[0]), dt_ns * 1e-9
        if not all(map(math.isfinite, (angle, speed, current, voltage))):
            self.x = np.full(3, np.nan)
            return
        for _ in range(_MAX_CHANGES):
            direction = self._direction(speed, current, voltage)
            if direction == 0:
                used_s, current = self._stick(current, voltage, left_s)
            else:
                forced = -direction * self._deceleration
                motion = _Motion(self._turning, speed, current, voltage, forced)
                stop_s = self._stop_s(motion, direction, left_s) if self._deceleration else None
                used_s = left_s if stop_s is None else stop_s
                angle += motion.turned(used_s)
                speed, current = motion.at(used_s)
                speed = speed if stop_s is None else 0.0
            left_s -= used_s
            if left_s <= 0.0:
                self.x = np.array([angle, speed, current])
                return
        raise SystemFailedError(
            f"the motor's friction changes its direction more than {_MAX_CHANGES:,} times in a step"
        )

    def _direction(self, speed: float, current: float, voltage: float) -> int:
        """The friction's direction, 1 or −1; 0 if the shaft sticks."""
        if speed != 0.0 or self._deceleration == 0.0:
            return -1 if speed < 0.0 else 1
        if abs(current) > self._breakaway_a:
            return 1 if current > 0.0 else -1
        # At the limit itself, the shaft breaks away if the current continues to grow.
        steady = voltage / self._settings.resistance_ohm
        grows = abs(current) == self._breakaway_a and abs(steady) > abs(current)
        return int(math.copysign(1, current)) if grows and steady * current > 0 else 0

    def _stick(self, current: float, voltage: float, left_s: float) -> tuple[float, float]:
        """Return how long the shaft sticks, and the current at the end of that time."""
        time_constant_s = self._settings.inductance_h / self._settings.resistance_ohm
        steady = voltage / self._settings.resistance_ohm
        limit = math.copysign(self._breakaway_a, steady)
        if abs(steady) > self._breakaway_a:
            stuck_s = time_constant_s * math.log((current - steady) / (limit - steady))
            if stuck_s < left_s:
                return stuck_s, limit
        return left_s, steady + (current - steady) * math.exp(-left_s / time_constant_s)

    @staticmethod
    def _stop_s(motion: "_Motion", direction: int, left_s: float) -> float | None:
        """Return the first time in (0, left_s] at which the speed changes its sign, or None.

        Between two extrema the speed is monotone, so a change of sign brackets one root.
        """
        low = 0.0
        for high in motion.extrema(left_s):
            if direction * motion.at(high)[0] < 0.0:
                for _ in range(_BISECTIONS):
                    middle = 0.5 * (low + high)
                    if not low < middle < high:
                        break
                    if direction * motion.at(middle)[0] < 0.0:
                        high = middle
                    else:
                        low = middle
                return high
            low = high
        return None


class _LinearMotion:
    """The linear dynamics of (ω, i): their matrix M = [[a, b], [c, d]] and its eigenvalues.

    All computations are with plain numbers: for two states, arrays would take ten times as long.
    """

    def __init__(self, settings: DcMotorSettings) -> None:
        matrix, voltage = settings.dynamics()
        (self.a, self.b), (self.c, self.d) = matrix.tolist()
        self.per_voltage = float(voltage[1])
        # No cancellation: a and d are not positive, and b and c have opposite signs.
        self.determinant = self.a * self.d - self.b * self.c
        half = 0.5 * (self.a + self.d)
        self.fast = half - cmath.sqrt(half * half - self.determinant)
        self.slow = self.determinant / self.fast

    def solve(self, first: float, second: float) -> tuple[float, float]:
        """Return M⁻¹ applied to a vector."""
        return (
            (self.d * first - self.b * second) / self.determinant,
            (self.a * second - self.c * first) / self.determinant,
        )


class _Motion:
    """(ω, i)(t) = w + e^{Mt} (start − w) with the steady state w = −M⁻¹ c.

    e^{Mt} = e^{λt} I + S(t) (M − λ I), where λ and λ' are the slow and the fast eigenvalue and
    S(t) = (e^{λt} − e^{λ't}) / (λ − λ'), which tends to t e^{λt} if they are equal.

    Args:
        linear: the dynamics.
        speed: ω(0).
        current: i(0).
        voltage: the armature voltage.
        forced: a further angular acceleration.
    """

    def __init__(
        self, linear: _LinearMotion, speed: float, current: float, voltage: float, forced: float
    ) -> None:
        self._linear = linear
        self._speed, self._current = linear.solve(-forced, -linear.per_voltage * voltage)
        self._deviation = x, y = speed - self._speed, current - self._current
        self._rate = linear.a * x + linear.b * y, linear.c * x + linear.d * y
        self._shifted = self._rate[0] - linear.slow * x, self._rate[1] - linear.slow * y

    def _decayed(self, t_s: float) -> tuple[float, float]:
        """Return e^{Mt} (start − w)."""
        slow = self._linear.slow
        gap = slow - self._linear.fast
        decay = cmath.exp(slow * t_s)
        ratio = decay * (-_expm1(-gap * t_s) / gap if gap != 0 else t_s)
        (x, y), (p, q) = self._deviation, self._shifted
        return (decay * x + ratio * p).real, (decay * y + ratio * q).real

    def at(self, t_s: float) -> tuple[float, float]:
        """Return speed and current after a time."""
        speed, current = self._decayed(t_s)
        return self._speed + speed, self._current + current

    def turned(self, t_s: float) -> float:
        """Return the angle by which the shaft has turned: the integral of ω."""
        speed, current = self._decayed(t_s)
        x, y = self._deviation
        return self._speed * t_s + self._linear.solve(speed - x, current - y)[0]

    def extrema(self, end_s: float) -> Iterator[float]:
        """Return the times in (0, end_s) at which dω/dt = 0, in order; then end_s.

        dω/dt = e^{λt} (a + r (1 − e^{−(λ−λ')t}) / (λ − λ')) with a = dω/dt(0).
        """
        slow, gap = self._linear.slow, self._linear.slow - self._linear.fast
        a = self._rate[0]
        r = complex(self._linear.a * a + self._linear.b * self._rate[1] - slow * a)
        if r != 0 and (gap == 0 or 1 + a * gap / r != 0):
            first = -a / r if gap == 0 else -cmath.log(1 + a * gap / r) / gap
            if gap.imag:  # the speed oscillates: an extremum every half period
                spacing_s = 2 * math.pi / abs(gap.imag)
                begin_s = first.real % spacing_s
                count = max(math.ceil((end_s - begin_s) / spacing_s), 0)
                yield from (begin_s + k * spacing_s for k in range(count))
            elif abs(first.imag) <= _REAL * abs(first) and 0.0 < first.real < end_s:
                yield first.real
        yield end_s


def _expm1(z: complex) -> complex:
    """e^z − 1 without cancellation; the standard library has it for real numbers only."""
    a, b = z.real, z.imag
    return complex(math.expm1(a) * math.cos(b) - 2.0 * math.sin(0.5 * b) ** 2, math.exp(a) * math.sin(b))
