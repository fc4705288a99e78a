"""Linear models of plants about a point: ẋ ≈ f₀ + A (x − x₀) + B (u − u₀), and their error.

If a system has a derivative (:meth:`OdeSystem.rates`), A and B are its differences: central
differences over steps from 0.1 to 4e-7 times the size of the component, extrapolated to the order
4. For each entry the step is used at which the result changes least; an entry that is not larger
than that change becomes 0. Where f jumps at the point, as friction does at standstill, the entry is the
mean of the slopes on both sides: the jump is left out.

Other systems are only moved: n + m small deviations of x and u are applied, each with both signs. x
is taken at the beginning, and a step later. Central differences give x(t + h) = Ad x(t) + Bd u; the
matrix logarithm of [[Ad, Bd], [0, I]] divided by h gives A and B.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from noack.core.linear_systems import Matrix, Vector, discretise, norm, real_logarithm
from noack.plants.plant_settings import PlantSystem

SystemAt = Callable[[Vector], PlantSystem]
"""Makes a system at an initial state, (n,)."""
STEP_NS = 10_000_000
"""Step of the motion, for a system that allows any."""
_OFF = 1e-4  # size of a deviation, relative to the component or 1
_SINGULAR = 1e-9
"""If the smallest singular value of the deviations is below this, x is not a state."""
_WIDEST, _FINER, _STEPS = 0.1, 4.0, 10
"""Steps of a difference: the widest, relative to the component or 1; the ratio of two; the number."""
_NOISE = 100.0
"""An entry that is smaller than this multiple of its change from step to step is 0."""
_STEP_SHARE, _STEADY_SHARE = 0.2, 0.2
"""At a step the slope changes by at least this share of it, and beside it by at most this share of that."""
_ROUNDING = 1e-13
"""Relative rounding error of what the system computes."""
_DIGITS = 10
"""Significant digits of A and B that are kept."""
_SAMPLES = {"derivative": 1000, "motion": 100}

NO_STATE = "x is not its whole state, or it is not smooth"
NOT_FINITE = "its motion is not finite there"
NOT_REPEATED = "its motion is not the same twice from one state and input"
NO_LOGARITHM = "a step of its motion has no real logarithm: no linear system in continuous time"


@dataclass(frozen=True)
class LinearMotion:
    """A linear model of a plant; the matrices are NaN if ``void`` says why there is none."""

    A: Matrix  # (n, n), per second
    B: Matrix  # (n, m)
    drift: Vector  # f₀ at the point, (n,), per second; 0 at an equilibrium
    source: Literal["derivative", "motion"]  # from which A and B are computed
    void: str | None = None


def linearise(
    system_at: SystemAt,
    n: int,
    m: int,
    *,
    x0: Vector | None = None,
    u0: Vector | None = None,
    step_ns: int = STEP_NS,
    beside: Vector | None = None,
) -> LinearMotion:
    """Linearise a system.

    Args:
        system_at: makes the system at an initial state, (n,).
        n: number of states.
        m: number of inputs.
        x0: x₀, (n,); by default 0.
        u0: u₀, (m,); by default 0.
        step_ns: step of a system that is moved.
        beside: deviations of x and u that are usual, (n + m,): where the derivative has a step at the
            point that is steep for these, as smoothed dry friction has, take the slope beside it.
    """
    x0, u0 = np.zeros(n) if x0 is None else x0, np.zeros(m) if u0 is None else u0
    rates = getattr(system_at(x0), "rates", None)
    if rates is None or rates(x0, u0) is None:
        return _by_motion(system_at, x0, u0, step_ns)

    def f(point: Vector) -> Vector:
        return np.asarray(rates(point[:n], point[n:]))

    point = np.concatenate([x0, u0])
    jacobian, drift = _differences(f, point), f(point)
    if beside is not None:
        jacobian = _beside_steps(f, point, jacobian, beside)
    void = None if np.isfinite(jacobian).all() and np.isfinite(drift).all() else NOT_FINITE
    if void is None and not np.array_equal(f(point), drift):
        void = NOT_REPEATED
    return LinearMotion(jacobian[:, :n], jacobian[:, n:], drift, "derivative", void)


def _differences(f: Callable[[Vector], Vector], point: Vector) -> Matrix:
    """Return the Jacobian of f, (n, len(point)); NaN where f is not finite."""
    columns = []
    size = np.abs(f(point))
    for i, value in enumerate(point):
        steps = max(1.0, abs(value)) * _WIDEST / _FINER ** np.arange(_STEPS)
        off = np.zeros_like(point)
        slopes = []
        for step in steps:
            off[i] = step
            slopes.append((f(point + off) - f(point - off)) / (2 * step))
        second = np.array(slopes)
        column = _steadiest((_FINER**2 * second[1:] - second[:-1]) / (_FINER**2 - 1), size)
        rises = second * steps[:, None]  # half of f(+h) - f(-h): J + s h with a jump J
        jumps = np.abs(rises[-1]) > 0.5 * np.abs(rises[-2])
        if jumps.any():
            beside = _steadiest(np.diff(rises, axis=0) / np.diff(steps)[:, None], size)
            column = np.where(jumps, beside, column)
        columns.append(column)
    return np.array(columns).T


def _beside_steps(f: Callable[[Vector], Vector], point: Vector, jacobian: Matrix, widths: Vector) -> Matrix:
    """Return the Jacobian with the slopes beside steps at the point; ``widths`` are usual deviations.

    There is a step if the slopes from a quarter to a half and from a half to all of the width agree, and
    the slope at the point is another one.
    """
    columns = []
    for i, width in enumerate(widths):
        off = np.zeros_like(point)
        rises = []
        for share in (1.0, 0.5, 0.25):
            off[i] = share * width
            rises.append((f(point + off) - f(point - off)) / 2)
        far, near = (rises[0] - rises[1]) / (0.5 * width), (rises[1] - rises[2]) / (0.25 * width)
        change = np.abs(jacobian[:, i] - near)
        is_other = change > _STEP_SHARE * np.abs(jacobian[:, i])
        is_step = is_other & (np.abs(far - near) <= _STEADY_SHARE * change)
        columns.append(np.where(is_step, _rounded(far), jacobian[:, i]))
    return np.array(columns).T


def _steadiest(slopes: Matrix, size: Vector) -> Vector:
    """Return of each column the slope that changes least from step to step; 0 if it is not larger than that.

    Args:
        slopes: for each of k steps, (k, n).
        size: of what f returns, (n,).
    """
    changes = np.abs(np.diff(slopes, axis=0))
    changes[~np.isfinite(changes)] = np.inf
    best, places = changes.argmin(axis=0), np.arange(len(size))
    column, change = slopes[best + 1, places], changes[best, places]
    noise = np.maximum(_NOISE * change, _ROUNDING * (size + np.abs(column).max()))
    return np.where(np.abs(column) <= noise, 0.0, _rounded(column))


def _rounded(values: Matrix) -> Matrix:
    """Return the values with ten significant digits: 1 instead of 0.99999999998."""
    return np.array([float(f"{value:.{_DIGITS}g}") for value in values.ravel()]).reshape(values.shape)


def _moved(system_at: SystemAt, x0: Vector, u: Vector, step_ns: int) -> Matrix:
    """Return x at the beginning and a step later, (2, n)."""
    system = system_at(x0)
    begin = system.x
    system.advance(u, 0, step_ns)
    return np.array([begin, system.x])


def _by_motion(system_at: SystemAt, x0: Vector, u0: Vector, step_ns: int) -> LinearMotion:
    """Return the linear model of a system that is only moved."""
    n, m = len(x0), len(u0)
    resting = _moved(system_at, x0, u0, step_ns)
    drift = (resting[1] - resting[0]) / (step_ns * 1e-9)

    def without(reason: str) -> LinearMotion:
        return LinearMotion(np.full((n, n), np.nan), np.full((n, m), np.nan), drift, "motion", reason)

    # Central differences: by how much an offset at the beginning moves the two points.
    start_offs, step_offs = np.eye(n + m), np.eye(n + m)
    for i, value in enumerate(np.concatenate([x0, u0])):
        off = np.zeros(n + m)
        off[i] = _OFF * max(1.0, abs(value))
        plus, minus = (
            _moved(system_at, x0 + sign * off[:n], u0 + sign * off[n:], step_ns) for sign in (1.0, -1.0)
        )
        start_offs[:n, i], step_offs[:n, i] = (plus - minus) / (2 * off[i])
    # The motion has no linear model unless it is finite and the same each time, and x determines it.
    if not (np.isfinite(start_offs).all() and np.isfinite(step_offs).all()):
        return without(NOT_FINITE)
    if not np.array_equal(resting, _moved(system_at, x0, u0, step_ns)):
        return without(NOT_REPEATED)
    if np.linalg.svd(start_offs, compute_uv=False)[-1] < _SINGULAR:
        return without(NO_STATE)
    # Â and B̂ are those of the real logarithm of a step.
    step = step_offs @ np.linalg.inv(start_offs)
    logarithm = real_logarithm(step)
    if logarithm is None:
        return without(NO_LOGARITHM)
    generator = logarithm / (step_ns * 1e-9)
    return LinearMotion(generator[:n, :n], generator[:n, n:], drift, "motion")


def largest_errors(
    system_at: SystemAt,
    motion: LinearMotion,
    halfwidths: Vector,
    *,
    x0: Vector,
    u0: Vector,
    step_ns: int = STEP_NS,
) -> Vector:
    """Return by how much the linear model misses the plant near the point, per state, (n,).

    The plant is sampled in the box of the half-widths around the point, half of the samples at its
    corners. For a plant with a derivative the value of state i is max |ẋᵢ − f₀ᵢ − (A δx + B δu)ᵢ| /
    max |(A δx + B δu)ᵢ|, for another plant the same of the change of x over a step. It is NaN if
    the plant is not finite at a sample, and infinite if the linear part of a state is 0 while its
    remainder is not.

    Args:
        system_at: makes the system.
        motion: its linear model.
        halfwidths: half-widths of the box, (n + m,).
        x0: the point x₀, (n,).
        u0: u₀, (m,).
        step_ns: step of a system that is moved.
    """
    n = len(x0)
    rates = getattr(system_at(x0), "rates", None) if motion.source == "derivative" else None

    def change(x: Vector, u: Vector) -> tuple[Vector, Vector]:
        if rates is not None:
            return x, np.asarray(rates(x, u))
        begin, end = _moved(system_at, x, u, step_ns)
        return begin, end - begin

    linear = np.hstack([motion.A, motion.B])
    if rates is None:
        Ad, Bd = discretise(motion.A, motion.B, step_ns)
        linear = np.hstack([Ad - np.eye(n), Bd])
    random = np.random.default_rng(0)
    offs = random.uniform(-1.0, 1.0, size=(_SAMPLES[motion.source], len(halfwidths)))
    offs[::2] = np.sign(offs[::2])
    # The largest error, and the largest change by the linear part, of each state.
    resting, resting_change = change(x0, u0)
    errors, largest = np.zeros(n), np.zeros(n)
    with np.errstate(all="ignore"):
        for off in offs * halfwidths:
            x, moved = change(x0 + off[:n], u0 + off[n:])
            expected = linear @ np.concatenate([x - resting, off[n:]])
            errors = np.maximum(errors, np.abs(moved - resting_change - expected))
            largest = np.maximum(largest, np.abs(expected))
        # A state that does not move has no error but rounding.
        rounding = _ROUNDING * (norm(largest) + norm(resting_change) + norm(resting))
        return np.where(errors <= rounding, 0.0, errors / largest)
