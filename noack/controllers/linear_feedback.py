"""The paper's control law: state feedback of the model."""

from typing import ClassVar, Literal

from noack.controllers.controller_settings import ControllerSettings, ControlModel
from noack.core.linear_systems import Matrix, Vector


class LinearFeedbackSettings(ControllerSettings):
    """u = K(x_c − x_r) + u_r, the paper's controller."""

    is_linear: ClassVar = True

    kind: Literal["linear"] = "linear"

    def law(self, model: ControlModel) -> "LinearFeedback":
        return LinearFeedback(model.K)


class LinearFeedback:
    """u = K(x_c − x_r) + u_r.

    Args:
        K: gain, shape (m, n).
    """

    def __init__(self, K: Matrix) -> None:
        self._K = K

    def update(self, t_s: float, x: Vector) -> None:
        """The law depends on x_c alone."""

    def input(self, t_s: float, x_c: Vector, setpoint: tuple[Vector, Vector] | None) -> Vector:
        if setpoint is None:
            u: Vector = self._K @ x_c
            return u
        x_r, u_r = setpoint
        shifted: Vector = self._K @ (x_c - x_r) + u_r
        return shifted
