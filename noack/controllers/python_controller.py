"""A control law from a user's class.

The class's code runs in the controller's process. If it raises, the controller sends its safe input
from then on, and the run ends with status 1.
"""

from functools import partial
from typing import ClassVar, Literal

import numpy as np

from netem.core.errors import CallerError
from noack.controllers.controller_settings import ControlFailedError, ControllerSettings, ControlModel
from noack.core.linear_systems import Vector
from noack.settings.user_files import ClassSettings, new_instance, read_only, real_vector, user_code


class PythonControllerSettings(ClassSettings, ControllerSettings):
    """A user's class, from an installed package or a file.

    docs/plants.md lists the methods that it must have.
    """

    group: ClassVar = "noack.controllers"

    kind: Literal["python"]

    def law(self, model: ControlModel) -> "PythonLaw":
        return PythonLaw(self, model)


class PythonLaw:
    """An object of a user's class.

    It has ``on_tick(t_s, x_c)``, which returns u, and may have ``start(model)``, which receives a
    :class:`ControlModel` once, ``on_update(t_s, x)``, and ``on_reference(t_s, x_r, u_r)``.

    Raises:
        CallerError: the class does not exist, raises, or has no ``on_tick``.
    """

    def __init__(self, settings: PythonControllerSettings, model: ControlModel) -> None:
        self._inputs = model.B.shape[1]
        self._user_code = partial(user_code, settings, "controller", ControlFailedError)
        with user_code(settings, "controller", CallerError):
            self._user, self.about = new_instance(settings, "controller")
            if not hasattr(self._user, "on_tick"):
                raise TypeError("it has no on_tick(t_s, x_c)")
            if hasattr(self._user, "start"):
                self._user.start(model._replace(A=model.A.copy(), B=model.B.copy()))

    def update(self, t_s: float, x: Vector) -> None:
        """Forward a state to ``on_update``, if the class has it."""
        if hasattr(self._user, "on_update"):
            with self._user_code():
                self._user.on_update(t_s, read_only(x))

    def input(self, t_s: float, x_c: Vector, setpoint: tuple[Vector, Vector] | None) -> Vector:
        """Return the result of ``on_tick``, after ``on_reference`` if the class has it."""
        with self._user_code():
            if hasattr(self._user, "on_reference"):
                x_r, u_r = (np.zeros(len(x_c)), np.zeros(self._inputs)) if setpoint is None else setpoint
                self._user.on_reference(t_s, read_only(x_r), read_only(u_r))
            u = self._user.on_tick(t_s, read_only(x_c))
            checked = real_vector("the result of on_tick", u, self._inputs)
            if not np.isfinite(checked).all():
                raise ValueError(f"the result of on_tick is not finite: {checked.tolist()}")
        return checked
