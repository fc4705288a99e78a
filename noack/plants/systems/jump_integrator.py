"""Integrates equations that jump where a switching value changes its sign; for compiled code.

The method is Dormand & Prince's pair of orders 5 and 4 with error control. An ordinary integrator
reduces its steps at a jump until they meet the tolerance, which takes hundreds of evaluations. Here
the signs are held within a step, so that the equations are smooth there. If a switching value has
another sign at a step's end, the step is repeated up to the change, and the sign is reversed (Hairer,
Nørsett and Wanner, "Solving Ordinary Differential Equations I", section II.6).

``rates(model, z, v, parameters, signs, values, slope)`` writes the k switching values and dz/dt
under the held signs; where a sign is 0, that of the value itself counts.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Vector

Rates = Callable[..., None]
"""Equations, as described above."""
Equations = tuple[Rates, object, Vector, object]
"""The equations with their arguments that are constant: rates, model, v, parameters."""
DONE = 0
TOO_MANY_STEPS = -2
TOO_SMALL_STEPS = -3
"""Status codes, those of scipy's "dopri5"."""
MAX_STEPS = 10_000
"""Most steps of a call."""
_MAX_JUMPS = 64
"""Number of changes that are located in a call. After them the error control alone handles the
jumps, since a value may change its sign infinitely often."""
_SMALLEST = 1e-14
"""Smallest step, relative to the duration of a call."""
_LOCATIONS = 20
"""Most iterations of the search for a change of sign."""
_BEYOND = 1e-9
"""Distance of a located value beyond 0, relative to its change in the step; afterwards its sign is
certain."""
_PAIR = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [1 / 5, 0.0, 0.0, 0.0, 0.0, 0.0],
        [3 / 40, 9 / 40, 0.0, 0.0, 0.0, 0.0],
        [44 / 45, -56 / 15, 32 / 9, 0.0, 0.0, 0.0],
        [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0.0, 0.0],
        [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0.0],
        [35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],
    ]
)
"""Coefficients of the stages; the last stage is the result of order 5."""
_ERROR = np.array([71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])
"""The result minus that of order 4."""


class StepBuffers(NamedTuple):
    """Buffers for N states and k switching values."""

    slopes: Matrix
    """(7, N) dz/dt at the stages; the first is that at the step's start, also after the end."""
    point: Vector
    """(N,) The state of the last stage: the step's result."""
    between: Vector
    """(N,) A state within the step."""
    signs: Vector
    """(k,) The signs that are held; 0: not held."""
    changing: Vector
    """(k,) The signs of the values that change theirs within the step, 0 for others."""
    start: Vector
    """(k,) The switching values at the step's start."""
    values: Vector
    """(k,) The switching values at the last evaluation."""


def buffers(states: int, values: int) -> StepBuffers:
    """Return new buffers."""
    sizes = states, states, values, values, values, values
    return StepBuffers(np.zeros((7, states)), *map(np.zeros, sizes))


def advance(
    rates: Rates,
    model: object,
    z: Vector,
    v: Vector,
    parameters: object,
    duration_s: float,
    tolerances: tuple[float, float],
    work: StepBuffers,
) -> int:
    """Advance z in place under a constant input v; return DONE, or why it ended early.

    Args:
        rates: the equations.
        model: handed to the equations.
        z: the state, (N,).
        v: the input, handed to the equations.
        parameters: handed to the equations.
        duration_s: the time to advance by; after 0, the first slope is that at z.
        tolerances: relative and absolute tolerance of a step.
        work: buffers, which carry nothing from one call to the next.
    """
    equations = (rates, model, v, parameters)
    # The signs are those at the beginning; with them the equations are smooth.
    work.signs[:] = 0.0
    rates(model, z, v, parameters, work.signs, work.values, work.slopes[0])
    for k in range(len(work.signs)):
        work.signs[k] = np.sign(work.values[k])
    left_s, step_s, smallest_s, jumps = duration_s, duration_s, _SMALLEST * duration_s, 0
    copy(work.values, work.start)
    for _ in range(MAX_STEPS):
        if left_s <= smallest_s:
            return DONE
        # Choose the step by its error; one that is too inexact is tried again, shorter.
        step_s = min(step_s, left_s)
        error = compute_step(equations, z, step_s, tolerances, work)
        factor = 5.0
        if error > 0.0:
            factor = min(max(0.9 * error**-0.2, 0.2), factor)
        if not error <= 1.0:
            step_s *= factor if error < math.inf else 0.2
            if step_s < smallest_s:
                return TOO_SMALL_STEPS
            continue
        # A step in which a sign changes ends there, and the next one has the new sign.
        part_s = step_s
        if least_signed_value(work.signs, work.values) >= 0.0:
            step_s *= factor
        else:
            part_s *= first_sign_change(equations, z, step_s, work)
            compute_step(equations, z, part_s, tolerances, work)
            if least_signed_value(work.signs, work.values) < 0.0:
                jumps += 1
                reverse_signs(work, jumps)
                rates(model, work.point, v, parameters, work.signs, work.values, work.slopes[6])
        copy(work.point, z)
        copy(work.values, work.start)
        copy(work.slopes[6], work.slopes[0])
        left_s -= part_s
    return TOO_MANY_STEPS


def copy(source: Vector, target: Vector) -> None:
    """Copy numbers. With ``target[:] = source`` numba compiles the message of unlike sizes, too."""
    for n in range(len(target)):
        target[n] = source[n]


def compute_step(
    equations: Equations,
    z: Vector,
    step_s: float,
    tolerances: tuple[float, float],
    work: StepBuffers,
) -> float:
    """Compute all stages of a step; return its error relative to the tolerance, NaN included."""
    rates, model, v, parameters = equations
    relative, absolute = tolerances
    for stage in range(1, 7):
        for n in range(len(z)):
            slope = 0.0
            for k in range(stage):
                slope += _PAIR[stage, k] * work.slopes[k, n]
            work.point[n] = z[n] + step_s * slope
        rates(model, work.point, v, parameters, work.signs, work.values, work.slopes[stage])
    total = 0.0
    for n in range(len(z)):
        slope = 0.0
        for k in range(7):
            slope += _ERROR[k] * work.slopes[k, n]
        scale = absolute + relative * max(abs(z[n]), abs(work.point[n]))
        total += (step_s * slope / scale) ** 2
    return math.sqrt(total / len(z))


def least_signed_value(signs: Vector, values: Vector) -> float:
    """Return the smallest of the values times their signs: negative if a value has another sign."""
    least = math.inf
    for k in range(len(signs)):
        if signs[k] != 0.0:
            least = min(least, signs[k] * values[k])
    return least


def first_sign_change(
    equations: Equations,
    z: Vector,
    step_s: float,
    work: StepBuffers,
) -> float:
    """Return the part of the step until just after the first change of a sign, at most 1.

    The state within the step is the cubic polynomial through both ends with their slopes. The
    root of its least signed value is found by the Illinois method (regula falsi, with halved values).
    """
    rates, model, v, parameters = equations
    # Only the values whose signs change count; the root sought is that of a level beyond 0.
    for k in range(len(work.signs)):
        work.changing[k] = work.signs[k] if work.signs[k] * work.values[k] < 0.0 else 0.0
    at_low = least_signed_value(work.changing, work.start)
    at_high = least_signed_value(work.changing, work.values)
    beyond, close = _BEYOND * (at_low - at_high), 0.1 * _BEYOND * (at_low - at_high)
    at_low, at_high = at_low + beyond, at_high + beyond
    low, high, last, part = 0.0, 1.0, 0, 1.0
    for _ in range(_LOCATIONS):
        if at_high >= 0.0:
            break
        # The secant through the bracket, and the state there.
        part = (low * at_high - high * at_low) / (at_high - at_low)
        remaining = 1.0 - part
        for n in range(len(z)):
            work.between[n] = (
                z[n] * (1.0 + 2.0 * part) * remaining * remaining
                + work.point[n] * (1.0 + 2.0 * remaining) * part * part
                + step_s * part * remaining * (remaining * work.slopes[0, n] - part * work.slopes[6, n])
            )
        rates(model, work.between, v, parameters, work.signs, work.values, work.slopes[1])
        now = least_signed_value(work.changing, work.values) + beyond
        if abs(now) <= close:
            break
        # Keep the bracket; an end that stays a second time has its value halved.
        if now < 0.0:
            high, at_high = part, now
            at_low *= 0.5 if last < 0 else 1.0
            last = -1
        else:
            low, at_low = part, now
            at_high *= 0.5 if last > 0 else 1.0
            last = 1
    return part


def reverse_signs(work: StepBuffers, jumps: int) -> None:
    """Reverse the signs that differ from their values'; after too many jumps, hold none any longer."""
    for k in range(len(work.signs)):
        if work.signs[k] * work.values[k] < 0.0:
            work.signs[k] = -work.signs[k]
        if jumps >= _MAX_JUMPS:
            work.signs[k] = 0.0
