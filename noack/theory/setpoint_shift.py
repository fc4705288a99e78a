"""A loop at a set-point x_r, in the coordinates x − x_r, x_s − x_r and x_c − x_r.

The models rest at x_r with u_r: Âx_r + B̂u_r = 0. The plant need not. What is left,
w = A x_r + B u_r, is a constant disturbance of the loop in these coordinates.
"""

from collections.abc import Mapping

import numpy as np

from noack.config.resolution import loop_of, setpoint_of
from noack.config.scenario import Scenario
from noack.core.linear_systems import Vector
from noack.disturbances.step import StepDisturbance
from noack.theory.certified_bounds import BOX, OWN_PLANT

_AT_REST = 1e-9
"""The plant rests if |A x_r + B u_r| is at most this share of its larger term."""


def about_setpoint(resolved: Scenario) -> Scenario:
    """Return the loop in the coordinates around its set-point, which is 0 there."""
    setpoint = setpoint_of(resolved)
    if setpoint is None:
        return resolved
    x_r, _ = setpoint
    w, plant = constant_disturbance(resolved), resolved.plant
    constant = StepDisturbance(kind="step", at="state", amplitude=tuple(w.tolist()))
    update = {
        "initial_state": tuple((np.array(plant.initial_state) - x_r).tolist()),
        "disturbances": (*plant.disturbances, *([constant] if w.any() else [])),
    }
    return resolved.model_copy(
        update={
            "plant": plant.model_copy(update=update),
            "controller": resolved.controller.model_copy(update={"setpoint": None}),
        }
    )


def constant_disturbance(resolved: Scenario) -> Vector:
    """Return A x_r + B u_r, (n,), of a linear plant; 0 if that is due to rounding."""
    loop, setpoint = loop_of(resolved), setpoint_of(resolved)
    if setpoint is None:
        return np.zeros(loop.n)
    x_r, u_r = setpoint
    drift, push = loop.A @ x_r, loop.B @ u_r
    largest = max(float(np.abs(drift).max()), float(np.abs(loop.A).max() * np.abs(x_r).max()))
    w = drift + push
    return w if float(np.abs(w).max()) > _AT_REST * largest else np.zeros(loop.n)


def void_at_setpoint(resolved: Scenario) -> Mapping[str, str]:
    """Return by scope why there is no certificate at the set-point of a linear plant."""
    setpoint = setpoint_of(resolved)
    if setpoint is None or not resolved.coverage.is_linear:
        return {}
    if resolved.observer is not None:
        why = "at a set-point the error of the observer's first estimate is not known"
        return {OWN_PLANT: why, BOX: why}
    x_r, u_r = setpoint
    half_A, half_B = resolved.plant.uncertainty_A, resolved.plant.uncertainty_B
    moved = np.zeros(len(x_r)) if half_A is None else np.array(half_A) @ np.abs(x_r)
    moved = moved + (0.0 if half_B is None else np.array(half_B) @ np.abs(u_r))
    if moved.any():
        return {BOX: "not every plant of the box rests at the set-point, A x_r + B u_r ≠ 0"}
    return {}
