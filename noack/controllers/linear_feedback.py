"""The paper's control law: state feedback of the model."""

from dataclasses import dataclass
from typing import ClassVar, Literal

from noack.controllers.controller_settings import ControllerSettings, ControlModel
from noack.core.linear_systems import Matrix, Vector, product


class LinearFeedbackSettings(ControllerSettings):
    """u = K(x_c − x_r) + u_r, the paper's controller."""

    is_linear: ClassVar = True

    kind: Literal["linear"] = "linear"

    def law(self, model: ControlModel) -> "LinearFeedback":
        return LinearFeedback(model.K)


@dataclass(frozen=True)
class LinearFeedback:
    """u = K(x_c − x_r) + u_r with a gain of shape (m, n)."""

    K: Matrix

    def update(self, t_s: float, x: Vector) -> None:
        """The law depends on x_c alone."""

    def input(self, t_s: float, x_c: Vector, setpoint: tuple[Vector, Vector] | None) -> Vector:
        if setpoint is None:
            return product(self.K, x_c)
        x_r, u_r = setpoint
        return product(self.K, x_c - x_r) + u_r
