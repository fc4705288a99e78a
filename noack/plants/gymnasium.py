"""A Gymnasium environment: its state is set, actions are applied, its state is read.

The environment is used without its wrappers. Observations, rewards and the ends of episodes have no
effect.
"""

from importlib import import_module
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, FiniteFloat

from noack.core.errors import CallerError, one_line
from noack.core.linear_systems import Vector
from noack.plants.plant_settings import PlantSettings, PlantStart, SystemFailedError
from noack.settings.section import Positive
from noack.settings.user_files import UserCode, real_vector


class GymnasiumSettings(PlantSettings):
    """A Gymnasium environment with a state that can be set, and continuous actions.

    x is its attribute ``state``, u its action.
    """

    needs: ClassVar = ("gymnasium", "gymnasium")

    kind: Literal["gymnasium"]
    id: str
    """The environment's id, e.g. "Pendulum-v1"."""
    parameters: dict[str, bool | int | FiniteFloat | str] = Field({})
    """Passed to the environment as keyword arguments."""
    step_s: Positive | None = None
    """Time of a step; by default the environment's attribute dt or tau. plant.rate_hz must be its
    inverse."""

    def environment(self) -> UserCode:
        """Return the environment.

        Raises:
            CallerError: there is no such environment, or it cannot be a plant.
        """
        self.require_installed()
        gymnasium = import_module("gymnasium")
        place = f'plant.system.id = "{self.id}"'
        try:
            made = gymnasium.make(self.id, **self.parameters).unwrapped
            made.reset(seed=0)
        except Exception as error:  # an environment can raise any error
            raise CallerError(f"{place}: {type(error).__name__}: {one_line(error)}") from None
        if not isinstance(made.action_space, gymnasium.spaces.Box):
            raise CallerError(f"{place}: its actions are {made.action_space}, not continuous (Box)")
        if np.ndim(getattr(made, "state", 0.0)) != 1:
            raise CallerError(f"{place}: its state cannot be set: it has no vector `state`")
        return made

    def step_of(self, environment: UserCode) -> float:
        """Return the time of a step, s; raise CallerError if the environment has none."""
        own = (getattr(environment, name, None) for name in ("dt", "tau"))
        step_s = self.step_s or next((float(step) for step in own if step), None)
        if step_s is None:
            raise CallerError(
                f'plant.system.id = "{self.id}": it has no time of a step; give plant.system.step_s'
            )
        return step_s

    def system(self, start: PlantStart) -> "GymnasiumSystem":
        return GymnasiumSystem(self, start)


class GymnasiumSystem:
    """An environment at x(0); z is empty.

    Raises:
        CallerError: it does not exist, or its states, actions or step do not fit.
    """

    def __init__(self, settings: GymnasiumSettings, start: PlantStart) -> None:
        self._place = f'plant.system.id = "{settings.id}"'
        self._environment = settings.environment()
        n, m = len(start.x0), start.B.shape[1]
        space, own = self._environment.action_space, len(self._environment.state)
        if (own, int(np.prod(space.shape))) != (n, m):
            raise CallerError(
                f"{self._place}: it has {own} states and {int(np.prod(space.shape))} actions; "
                f"the model has {n} and {m}"
            )
        step_s = settings.step_of(self._environment)
        if abs(step_s * 1e9 - start.step_ns) > 1:
            raise CallerError(
                f"{self._place}: its step is {step_s:g} s; set plant.rate_hz = {1 / step_s:.9g}"
            )
        self._environment.state = start.x0.copy()
        self.x, self.z = start.x0.copy(), np.zeros(0)

    def advance(self, u: Vector, t_ns: int, dt_ns: int) -> None:
        """Apply an action for a step."""
        try:
            self._environment.step(u.reshape(self._environment.action_space.shape).copy())
            self.x = real_vector("state", self._environment.state, len(self.x))
        except Exception as error:  # an environment can raise any error
            raise SystemFailedError(
                f"{self._place}: {type(error).__name__}: {one_line(error)}"
            ) from None
