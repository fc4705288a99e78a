"""Named linear models: the nominal matrices that a scenario may refer to by name."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from noack.linear import Matrix


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
    A = np.array(
        [
            [p["a11"], p["a12"], 0.0, 0.0],
            [p["a21"], p["a22"], 0.0, 0.0],
            [0.0, 1.0, 0.0, 0.0],
            [1.0, 0.0, p["speed"], 0.0],
        ]
    )
    B = np.array([[p["b1"], 0.0], [0.0, p["b2"]], [0.0, 0.0], [0.0, 0.0]])
    row = [0.0, 0.0, -p["gain"], p["gain"] / p["look_ahead"]]
    return NamedModel(A, B, np.array([row, row]), ("V", "r", "psi", "Y_g"), ("u_1", "u_2"))


def double_integrator(parameters: Mapping[str, float]) -> NamedModel:
    """A unit mass pushed by a force: ``ẍ = u``, with ``u = −stiffness·x − damping·ẋ``."""
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
    "double_integrator": double_integrator,
}

MODEL_PARAMETERS: Mapping[str, tuple[str, ...]] = {
    "lane_following": tuple(LANE_FOLLOWING_DEFAULTS),
    "double_integrator": ("stiffness", "damping"),
}
