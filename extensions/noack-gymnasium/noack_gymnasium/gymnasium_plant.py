"""A Gymnasium environment: its state is set, actions are applied, its state is read.

The environment is used without its wrappers. Rewards and the ends of episodes have no effect.
MuJoCo's environments are among them: their state is qpos, then qvel.
"""

import math
from importlib import import_module
from importlib.util import find_spec
from operator import attrgetter
from typing import Annotated, Any, ClassVar, Literal, NoReturn

import numpy as np
from pydantic import Field, FiniteFloat

from noack.extend import (
    MAX_DIMENSION,
    CallerError,
    FileSettings,
    MatrixRows,
    Names,
    PlantOutline,
    PlantSettings,
    PlantStart,
    Positive,
    Row,
    SystemFailedError,
    Table,
    Vector,
    checked_path,
    one_line,
    real_vector,
    require_length,
    require_shape,
)

Indices = Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1, max_length=MAX_DIMENSION)]
_LABEL = "gymnasium:"
"""What the name of an environment begins with, as `noack linearise` takes it."""
_OBSERVATION = "observation"
_MUJOCO = ("data.qpos", "data.qvel")
_TOLERANCE = 1e-6
"""Largest relative difference between x(0) of the scenario and of the observation, and between the
quotient of two steps and a whole number."""


class GymnasiumSettings(FileSettings, PlantSettings):
    """A Gymnasium environment, also one of MuJoCo, with continuous actions.

    With its state s: x = s[entries] − operating_state; its action is operating_action +
    actuation u.
    """

    has_own_step: ClassVar = True

    kind: Literal["gymnasium"]
    id: str
    """The environment's id, e.g. "Pendulum-v1", or "module:Id-v0" of a module to import."""
    file: str | None = None
    """A model in MJCF for an environment that takes ``xml_file``, as MuJoCo's do; a relative name
    is relative to the scenario file."""
    parameters: dict[str, bool | int | FiniteFloat | str] = Field({})
    """Passed to the environment as keyword arguments."""
    step_s: Positive | None = None
    """Time of a step; by default the environment's attribute dt or tau. plant.rate_hz must be its
    inverse."""
    state: Annotated[Names, Field(min_length=1)] | None = None
    """Attributes with numbers or vectors that make up s, e.g. ["pos", "body.speed"]; by default
    ``state``, for MuJoCo data.qpos and data.qvel. With ["observation"], s is the last observation,
    which cannot be set: the first one, after reset(seed=0), must be that of x(0)."""
    entries: Indices | None = None
    """Entries of s, counted from 0, that make up x, in x's order; by default all."""
    operating_state: Row | None = None
    """Values of these entries at x = 0; by default 0."""
    actuation: MatrixRows | None = None
    """Matrix from u to the action, a row per entry of the action; by default the identity."""
    operating_action: Row | None = None
    """The action at u = 0; by default 0."""

    def check(self, n: int, m: int) -> None:
        """Require maps for n states and m inputs.

        Raises:
            ValueError: the numbers differ.
        """
        reason = f"the model has {n} states and {m} inputs"
        require_length(self.entries, "plant.system.entries", n, reason)
        require_length(self.operating_state, "plant.system.operating_state", n, reason)
        if self.entries is not None and len({*self.entries}) < n:
            raise ValueError("plant.system.entries: an entry is there twice")
        if self.actuation is not None:
            rows, key = len(self.actuation), "plant.system.actuation"
            require_shape(self.actuation, key, (rows, m), reason)
            reason = f"{key} has {rows} rows"
            require_length(self.operating_action, "plant.system.operating_action", rows, reason)

    @classmethod
    def named_by(cls, label: str) -> Table | None:
        if not label.startswith(_LABEL):
            return None
        return {"kind": "gymnasium", "id": label.removeprefix(_LABEL)}

    def outline(self) -> PlantOutline:
        environment = self.environment()
        return PlantOutline(environment.n, environment.m, rate_hz=1 / environment.step_s)

    def environment(self) -> "Environment":
        """Return the environment, after reset(seed=0); MuJoCo's is at its initial state.

        Raises:
            CallerError: there is no such environment, or it cannot be a plant.
        """
        entry = import_module("gymnasium").registry.get(self.id)
        is_mujoco = entry is not None and "gymnasium.envs.mujoco" in str(entry.entry_point)
        if is_mujoco and find_spec("mujoco") is None:
            raise CallerError(
                f'plant.system.id: "{self.id}" needs a package that is not installed; '
                "pip install 'noack-gymnasium[mujoco]'"
            )
        return Environment(self)

    def system(self, start: PlantStart) -> "GymnasiumSystem":
        return GymnasiumSystem(self, start)


def own_step_s(environment: Any) -> float | None:
    """Return the time of a step that an environment itself has, s; None if it has none."""
    steps = (getattr(environment, name, None) for name in ("dt", "tau"))
    return next((float(step) for step in steps if step), None)


class Environment:
    """An environment and the maps between its state and x, its action and u.

    ``n`` and ``m`` are the numbers of states and inputs.

    Raises:
        CallerError: there is no such environment, or it does not fit its settings.
    """

    def __init__(self, settings: GymnasiumSettings) -> None:
        self._settings = settings
        self.place = f'plant.system.id = "{settings.id}"'
        """The prefix of messages."""
        arguments = dict(settings.parameters)
        if settings.file is not None:
            arguments["xml_file"] = str(checked_path(settings, "plant.system"))
        gymnasium = import_module("gymnasium")
        try:
            self._environment: Any = gymnasium.make(settings.id, **arguments).unwrapped
            self._observation, _ = self._environment.reset(seed=0)
        except Exception as error:  # an environment can raise any error
            self.wrong(f"{type(error).__name__}: {one_line(error)}")
        space = self._environment.action_space
        if not isinstance(space, gymnasium.spaces.Box):
            self.wrong(
                f"its actions are {space}, not continuous (Box), which u needs; take an "
                "environment with continuous actions"
            )
        is_mujoco = not hasattr(self._environment, "state") and hasattr(self._environment, "init_qpos")
        self._names = settings.state or (_MUJOCO if is_mujoco else ("state",))
        if self._names == _MUJOCO:
            self._prepare_mujoco()
        # The maps between its state and x, and between its action and u.
        size, actions = len(self._state()), int(np.prod(space.shape))
        self._entries = np.arange(size) if settings.entries is None else np.array(settings.entries)
        if (last := int(self._entries.max())) >= size:
            self.wrong(f"plant.system.entries has {last}; its state has entries 0 to {size - 1}")
        self._actuation = np.eye(actions)
        if settings.actuation is not None:
            self._actuation = np.array(settings.actuation)
        self._rest = np.array(settings.operating_action or np.zeros(actions))
        if not len(self._actuation) == len(self._rest) == actions:
            self.wrong(
                f"it has {actions} actions; plant.system.actuation needs as many rows, and "
                "operating_action as many entries"
            )
        self.n, self.m = len(self._entries), self._actuation.shape[1]
        self._offset = np.array(settings.operating_state or np.zeros(self.n))

    def _prepare_mujoco(self) -> None:
        """Set MuJoCo's initial state; let a motion that diverges go on without a warning."""
        mujoco = import_module("mujoco")
        # Otherwise MuJoCo starts again from its initial state when a motion diverges.
        disabled = int(getattr(mujoco.mjtDisableBit, "mjDSBL_AUTORESET", 0))
        self._environment.model.opt.disableflags |= disabled
        # It would print a line for each such step, and write MUJOCO_LOG.TXT into the current
        # folder. That a motion has diverged is reported anyway.
        mujoco.set_mju_user_warning(lambda text: None)
        self._environment.set_state(self._environment.init_qpos, self._environment.init_qvel)

    def wrong(self, message: str) -> NoReturn:
        """Refuse the environment by a CallerError."""
        raise CallerError(f"{self.place}: {message}")

    @property
    def step_s(self) -> float:
        """The time of a step, s; CallerError if the environment has none."""
        step_s = self._settings.step_s or own_step_s(self._environment)
        if step_s is None:
            self.wrong("it has no time of a step; give plant.system.step_s")
        if not 0 < step_s < math.inf:
            self.wrong(f"its step is {step_s:g} s; it must be more than 0")
        return step_s

    def require_step(self, step_ns: int) -> None:
        """Require that the plant steps at the environment's rate; say what would be right."""
        own_s = self.step_s
        if abs(own_s * 1e9 - step_ns) <= 1:
            return
        remedy = f"its step is {own_s:g} s; set plant.rate_hz = {1 / own_s:.9g}"
        longer, shorter = step_ns * 1e-9 / own_s, own_s / (step_ns * 1e-9)
        if longer > 1 and abs(longer - round(longer)) < _TOLERANCE:
            remedy += f" and plant.measure_every = {round(longer)} to measure as often as now"
        elif shorter > 1 and abs(shorter - round(shorter)) < _TOLERANCE:
            remedy += f"; it cannot make {round(shorter)} steps of the plant out of its one"
        self.wrong(remedy)

    def x(self) -> Vector:
        """Return x, (n,)."""
        state: Vector = self._state()[self._entries] - self._offset
        return state

    def start(self, x0: Vector) -> None:
        """Set x to x(0), (n,).

        Raises:
            CallerError: an attribute cannot be set, or the observation is another.
        """
        state = self._state()
        if _OBSERVATION in self._names:
            if not np.all(np.abs(self.x() - x0) <= _TOLERANCE * (np.abs(x0) + 1.0)):
                observation = self.x().tolist()
                self.wrong(f"an observation cannot be set; set plant.initial_state = {observation}")
            return
        state[self._entries] = x0 + self._offset
        name = ""
        try:
            if self._names == _MUJOCO:
                self._environment.set_state(*np.split(state, [self._environment.model.nq]))
                return
            for name in self._names:
                path, _, last = name.rpartition(".")
                owner = attrgetter(path)(self._environment) if path else self._environment
                shape = np.shape(getattr(owner, last))
                part, state = np.split(state, [int(np.prod(shape))])
                setattr(owner, last, part.reshape(shape) if shape else float(part[0]))
        except Exception as error:  # as above
            self.wrong(f"`{name}` cannot be set: {type(error).__name__}: {one_line(error)}")

    def step(self, u: Vector) -> None:
        """Apply an action for a step."""
        action = self._rest + self._actuation @ u
        self._observation = self._environment.step(action.reshape(self._environment.action_space.shape))[0]

    def _state(self) -> Vector:
        """Return the environment's state."""
        parts = []
        for name in self._names:
            try:
                is_seen = name == _OBSERVATION
                part = np.ravel(self._observation if is_seen else attrgetter(name)(self._environment))
                parts.append(real_vector(name, part, part.size))
            except (AttributeError, TypeError, ValueError):
                self.wrong(
                    f"it has no `{name}` of numbers; plant.system.state names the attributes that "
                    'hold its state, or is ["observation"]'
                )
        return np.concatenate(parts)


class GymnasiumSystem:
    """An environment at x(0); z is empty.

    Raises:
        CallerError: it does not exist, or its states, actions or step do not fit.
    """

    def __init__(self, settings: GymnasiumSettings, start: PlantStart) -> None:
        self._environment = environment = settings.environment()
        n, m = len(start.x0), start.B.shape[1]
        if (environment.n, environment.m) != (n, m):
            environment.wrong(
                f"it has {environment.n} states and {environment.m} actions; the model has {n} "
                f"and {m}; plant.system.entries and actuation choose among them"
            )
        environment.require_step(start.step_ns)
        environment.start(start.x0)
        self.x, self.z, self._step_ns = environment.x(), np.zeros(0), start.step_ns

    def advance(self, u: Vector, t_ns: int, dt_ns: int) -> None:
        """Apply an action for a step."""
        assert abs(dt_ns - self._step_ns) <= 1  # 1/30 s is rounded up or down
        try:
            self._environment.step(u)
            self.x = self._environment.x()
        except Exception as error:  # as above
            raise SystemFailedError(
                f"{self._environment.place}: {type(error).__name__}: {one_line(error)}"
            ) from None
