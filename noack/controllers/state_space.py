"""A linear controller with a state ξ of its own, such as one with integral action.

dξ/dt = A_c ξ + B_c x and u = C_c ξ + D_c x, in continuous time. :mod:`noack.scenario.controller_states`
says what drives ξ, and how a scenario with one is resolved.
"""

from typing import ClassVar, Literal, Self

from pydantic import model_validator

from noack.controllers.controller_settings import ControllerSettings, ControlModel
from noack.controllers.linear_feedback import LinearFeedback
from noack.settings.values import MatrixRows, require_shape


class StateSpaceSettings(ControllerSettings):
    """A linear controller with states ξ: dξ/dt = A ξ + B x, u = C ξ + D x."""

    is_linear: ClassVar = True

    kind: Literal["state_space"]
    A: MatrixRows = ()
    """A_c by rows, k x k, per second."""
    B: MatrixRows = ()
    """B_c by rows, k x n."""
    C: MatrixRows = ()
    """C_c by rows, m x k."""
    D: MatrixRows | None = None
    """D_c by rows, m x n; by default the model's gain."""
    file: str | None = None
    """An .npz or .mat file with A, B, C and, if there is one, D. A relative name is relative to the
    scenario file. Loading the scenario replaces the name by the matrices."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.file is not None:
            raise ValueError("file: it is read where a scenario file is loaded; give matrices here")
        if missing := [key for key in ("A", "B", "C") if not getattr(self, key)]:
            raise ValueError(f"{missing[0]}: give the matrices A, B and C, or a file of them")
        k = len(self.A)
        require_shape(self.A, "A", (k, k), "the controller's matrix A is square")
        return self

    @property
    def states(self) -> int:
        return len(self.A)

    def law(self, model: ControlModel) -> LinearFeedback:
        """Return u = K x_c: the gain of a resolved scenario is that of (x, ξ)."""
        return LinearFeedback(model.K)
