"""Named linear models: the nominal matrices that a scenario may refer to by name."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix


class NamedModel(NamedTuple):
    """A nominal model ``dx/dt = A x + B u`` with a stabilising gain ``u = K x``."""

    A: Matrix
    B: Matrix
    K: Matrix
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]


LANE_FOLLOWING_DEFAULTS: Mapping[str, float] = {
    "a11": -1.6579, "a12": 10.45, "a21": 0.4886, "a22": -2.718,
    "b1": -12.1053, "b2": 13.1429,
    "speed": -12.0, "look_ahead": 40.0, "gain": 1.0,
}  # fmt: skip


def lane_following(parameters: Mapping[str, float]) -> NamedModel:
    """Vehicle lane following, Section V of Garcia & Antsaklis (after Unyelioglu et al., 1997).

    States: lateral velocity V, yaw rate r, yaw ψ, lateral position Y_g of the centre of gravity.
    ``speed`` is U (negative: "considered in the opposite direction"), ``look_ahead`` is d; the two
    inputs are steered alike by ``u = gain · (Y_g/d − ψ)``. Units follow the paper (SI, radian).

    Raises:
        ValueError: the look-ahead distance is 0.
    """
    p = {**LANE_FOLLOWING_DEFAULTS, **parameters}
    if p["look_ahead"] == 0:
        raise ValueError("parameters.look_ahead: the look-ahead distance cannot be 0")
    A = np.array([
        [p["a11"], p["a12"], 0.0, 0.0],
        [p["a21"], p["a22"], 0.0, 0.0],
        [0.0, 1.0, 0.0, 0.0],
        [1.0, 0.0, p["speed"], 0.0],
    ])  # fmt: skip
    B = np.array([[p["b1"], 0.0], [0.0, p["b2"]], [0.0, 0.0], [0.0, 0.0]])
    row = [0.0, 0.0, -p["gain"], p["gain"] / p["look_ahead"]]
    return NamedModel(A, B, np.array([row, row]), ("V", "r", "psi", "Y_g"), ("u_1", "u_2"))


SINGLE_TRACK_LANE_DEFAULTS: Mapping[str, float] = {
    "mass_kg": 1093.3, "inertia_kg_m2": 1791.6, "front_m": 1.1562, "rear_m": 1.4227,
    "front_n_per_rad": 129_697.0, "rear_n_per_rad": 105_400.0,
    "speed_m_per_s": 15.0, "look_ahead_m": 20.0, "gain": 0.5,
}  # fmt: skip
"""The BMW 320i of CommonRoad's vehicle models, with its tyres under the static load."""


def single_track_lane(parameters: Mapping[str, float]) -> NamedModel:
    """A car on a lane, as the linear single-track model (Riekert and Schunck, 1940).

    The car has mass m and moment of inertia I about the vertical axis. Its axles are at distances a
    and b in front of and behind the centre of gravity, with cornering stiffnesses c_f and c_r. At
    speed v and steering angle δ:

        m (v̇_y + v r) = F_f + F_r,  I ṙ = a F_f − b F_r,
        F_f = c_f (δ − (v_y + a r)/v),  F_r = −c_r (v_y − b r)/v.

    The states are those of :func:`lane_following`, with its lateral axis, which has the opposite
    direction: V = −v_y, yaw rate r, yaw ψ, lateral position Y_g with Ẏ_g = V − v ψ. Input: δ = gain
    · (Y_g/look_ahead − ψ).

    Raises:
        ValueError: a parameter that is a divisor is 0.
    """
    p = {**SINGLE_TRACK_LANE_DEFAULTS, **parameters}
    for name in ("mass_kg", "inertia_kg_m2", "speed_m_per_s", "look_ahead_m"):
        if p[name] == 0:
            raise ValueError(f"parameters.{name}: cannot be 0")
    m, inertia, v = p["mass_kg"], p["inertia_kg_m2"], p["speed_m_per_s"]
    (a, b), (c_f, c_r) = (p["front_m"], p["rear_m"]), (p["front_n_per_rad"], p["rear_n_per_rad"])
    uneven = a * c_f - b * c_r
    A = np.array([
        [-(c_f + c_r) / (m * v), uneven / (m * v) + v, 0.0, 0.0],
        [uneven / (inertia * v), -(a * a * c_f + b * b * c_r) / (inertia * v), 0.0, 0.0],
        [0.0, 1.0, 0.0, 0.0],
        [1.0, 0.0, -v, 0.0],
    ])  # fmt: skip
    B = np.array([[-c_f / m], [a * c_f / inertia], [0.0], [0.0]])
    K = np.array([[0.0, 0.0, -p["gain"], p["gain"] / p["look_ahead_m"]]])
    return NamedModel(A, B, K, ("V", "r", "psi", "Y_g"), ("steering",))


def double_integrator(parameters: Mapping[str, float]) -> NamedModel:
    """A unit mass driven by a force: ``ẍ = u``, with ``u = −stiffness·x − damping·ẋ``."""
    p = {"stiffness": 1.0, "damping": 1.5, **parameters}
    return NamedModel(
        np.array([[0.0, 1.0], [0.0, 0.0]]),
        np.array([[0.0], [1.0]]),
        np.array([[-p["stiffness"], -p["damping"]]]),
        ("position", "velocity"),
        ("force",),
    )


NAMED_MODELS: Mapping[str, Callable[[Mapping[str, float]], NamedModel]] = {
    "lane_following": lane_following,
    "single_track_lane": single_track_lane,
    "double_integrator": double_integrator,
}

MODEL_PARAMETERS: Mapping[str, tuple[str, ...]] = {
    "lane_following": tuple(LANE_FOLLOWING_DEFAULTS),
    "single_track_lane": tuple(SINGLE_TRACK_LANE_DEFAULTS),
    "double_integrator": ("stiffness", "damping"),
}
