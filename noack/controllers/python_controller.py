"""A control law from a user's class.

The class's code runs in the controller's process. If it raises, the controller sends its safe input
from then on, and the run ends with status 1.
"""

from typing import Any, ClassVar, Literal

import numpy as np

from noack.controllers.controller_settings import (
    ControlFailedError,
    ControllerSettings,
    ControlModel,
)
from noack.core.errors import CallerError
from noack.core.linear_systems import Vector
from noack.settings.user_class import (
    ClassSettings,
    failure_text,
    new_instance,
    read_only,
    real_vector,
)

_PLACE = "controller"


class PythonControllerSettings(ClassSettings, ControllerSettings):
    """A class of the user, from an installed package or from a file.

    docs/plants.md lists the methods that it must have.
    """

    group: ClassVar = "noack.controllers"

    kind: Literal["python"]
    """The kind of controller."""

    def law(self, model: ControlModel) -> "PythonLaw":
        """Return an object of the class."""
        return PythonLaw(self, model)


class PythonLaw:
    """An object of a user's class.

    It has ``on_tick(t_s, x_c)``, which returns u, and may have ``start(model)``, which receives a
    :class:`ControlModel` once, and ``on_update(t_s, x)``.

    Args:
        settings: of a loaded scenario.
        model: the data that the law receives about the loop.

    Raises:
        CallerError: the class does not exist, raises, or has no ``on_tick``.
    """

    def __init__(self, settings: PythonControllerSettings, model: ControlModel) -> None:
        self._settings = settings
        self._inputs = model.B.shape[1]
        try:
            self._user, self.about = new_instance(settings, _PLACE)
            if not hasattr(self._user, "on_tick"):
                raise TypeError("it has no on_tick(t_s, x_c)")
            if hasattr(self._user, "start"):
                self._user.start(model._replace(A=model.A.copy(), B=model.B.copy()))
        except CallerError:
            raise
        except (Exception, SystemExit) as error:
            raise CallerError(failure_text(settings, _PLACE, error)) from None

    def update(self, t_s: float, x: Vector) -> None:
        """Forward a state to ``on_update``, if the class has it."""
        if hasattr(self._user, "on_update"):
            self._call(self._user.on_update, t_s, x)

    def input(self, t_s: float, x_c: Vector, setpoint: tuple[Vector, Vector] | None) -> Vector:
        """Return the result of ``on_tick``; a set point is not supported."""
        u = self._call(self._user.on_tick, t_s, x_c)
        try:
            checked = real_vector("the result of on_tick", u, self._inputs)
            if not np.isfinite(checked).all():
                raise ValueError(f"the result of on_tick is not finite: {checked.tolist()}")
        except (TypeError, ValueError) as error:
            raise ControlFailedError(failure_text(self._settings, _PLACE, error)) from None
        return checked

    def _call(self, method: Any, t_s: float, x: Vector) -> Any:
        try:
            return method(t_s, read_only(x))
        except (Exception, SystemExit) as error:
            raise ControlFailedError(failure_text(self._settings, _PLACE, error)) from None
