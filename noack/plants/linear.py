"""Linear plants, advanced exactly under a constant input, and linear models by name.

A scenario may refer to a named model for the nominal matrices. The keyword arguments of a model's
function are its parameters, with their default values.
"""

from collections.abc import Callable, Mapping
from inspect import signature
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Vector, discretise, product
from noack.plants.plant_settings import PlantSettings, PlantStart

_EMPTY = np.zeros(0)


class LinearSettings(PlantSettings):
    """ẋ = A x + B u; the plant's other keys define A and B."""

    scenario: ClassVar = "lane_following"

    kind: Literal["linear"] = "linear"

    def system(self, start: PlantStart) -> "LinearSystem":
        return LinearSystem(start.A, start.B, start.x0)


class LinearSystem:
    """``dx/dt = A x + B u``; z is empty. A plant's steps of it are the core's."""

    def __init__(self, A: Matrix, B: Matrix, x0: Vector) -> None:
        self.A, self.B = A, B
        self.x = np.array(x0, dtype=np.float64)
        self.z = _EMPTY

    def advance(self, u: Vector, t_ns: int, dt_ns: int) -> None:
        """x(t + dt) = Ad x(t) + Bd u."""
        Ad, Bd = discretise(self.A, self.B, dt_ns)
        self.x = product(Ad, self.x) + product(Bd, u)


class NamedModel(NamedTuple):
    """A nominal model ``dx/dt = A x + B u`` with a stabilising gain ``u = K x``."""

    A: Matrix
    B: Matrix
    K: Matrix
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    state_units: tuple[str, ...] | None = None


def lane_following(
    *, a11: float = -1.6579, a12: float = 10.45, a21: float = 0.4886, a22: float = -2.718,
    b1: float = -12.1053, b2: float = 13.1429,
    speed: float = -12.0, look_ahead: float = 40.0, gain: float = 1.0,
) -> NamedModel:  # fmt: skip
    """Vehicle lane following, Section V of Garcia & Antsaklis (after Unyelioglu et al., 1997).

    States: lateral velocity V, yaw rate r, yaw ψ, lateral position Y_g of the centre of gravity.
    ``speed`` is U (negative: "considered in the opposite direction"), ``look_ahead`` is d; the two
    inputs are steered alike by ``u = gain · (Y_g/d − ψ)``. Units follow the paper (SI, radian).

    Raises:
        ValueError: the look-ahead distance is 0.
    """
    if look_ahead == 0:
        raise ValueError("parameters.look_ahead: the look-ahead distance cannot be 0")
    A = np.array(
        [
            [a11, a12, 0.0, 0.0],
            [a21, a22, 0.0, 0.0],
            [0.0, 1.0, 0.0, 0.0],
            [1.0, 0.0, speed, 0.0],
        ]
    )
    B = np.array([[b1, 0.0], [0.0, b2], [0.0, 0.0], [0.0, 0.0]])
    row = [0.0, 0.0, -gain, gain / look_ahead]
    names, units = ("V", "r", "psi", "Y_g"), ("m/s", "rad/s", "rad", "m")
    return NamedModel(A, B, np.array([row, row]), names, ("u_1", "u_2"), units)


def double_integrator(*, stiffness: float = 1.0, damping: float = 1.5) -> NamedModel:
    """A unit mass driven by a force: ``ẍ = u``, with ``u = −stiffness·x − damping·ẋ``."""
    A, B, K = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]]), [-stiffness, -damping]
    return NamedModel(A, B, np.array([K]), ("position", "velocity"), ("force",))


NAMED_MODELS: Mapping[str, Callable[..., NamedModel]] = {
    "lane_following": lane_following,
    "double_integrator": double_integrator,
}


def parameters_of(name: str) -> tuple[str, ...]:
    """Return the parameters of a named model."""
    return tuple(signature(NAMED_MODELS[name]).parameters)
