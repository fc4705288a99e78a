"""A Gymnasium environment behind noack's network: observations and actions are delayed and lost."""

from collections.abc import Mapping
from contextlib import suppress
from copy import deepcopy
from fractions import Fraction
from os import PathLike
from typing import Any, Generic, SupportsFloat, TypeVar

import gymnasium
import numpy as np
from gymnasium.core import ActType, ObsType
from gymnasium.spaces.utils import flatdim

from noack import Scenario, VirtualNetwork
from noack.extend import CallerError, exact_ns, nearest_ns
from noack_gymnasium.gymnasium_plant import own_step_s

Value = TypeVar("Value")


class _Receiver(Generic[Value]):
    """What one direction's receiver holds: the value of the newest packet that has arrived."""

    def __init__(self, held: Value, entries: int) -> None:
        self.held, self.entries = held, entries
        self.arrived, self.sent_step = False, 0

    def take(self, content: tuple[int, Value]) -> None:
        """Hold the value of a packet, which was sent in a step."""
        self.arrived, (self.sent_step, self.held) = True, content

    def info(self, step: int, losses: int) -> dict[str, object]:
        """Return what ``info`` says of this direction since the last call."""
        arrived, self.arrived = self.arrived, False
        return {"arrived": arrived, "age_steps": step - self.sent_step, "consecutive_losses": losses}


class LossyChannel(
    gymnasium.Wrapper[ObsType, ActType, ObsType, ActType],
    gymnasium.utils.RecordConstructorArgs,
):
    """An environment whose observations, and actions, cross a network that delays and drops them.

    Step k has the time k times the environment's step. The action is sent then, and the environment
    steps with the newest action that has arrived; the next observation is sent at the end of the
    step, and ``step`` returns the newest observation that has arrived. So a packet that is lost or
    late leaves the one before in force (hold), and a delay takes the next whole number of steps: at
    30 steps per second, 0.1 s takes 3.
    Rewards and ends of episodes do not cross the network. ``reset`` returns the first observation
    itself, which is also the first packet.

    Each direction has the guarantee of the network, e.g. at most ``mansd`` losses in a row. Losses
    are those of a run of noack with the same ``seeds.loss``, packet by packet; each further episode
    has others. ``reset(seed=...)`` sets this seed and begins again.

    ``info["network"]`` has ``"observation"`` and, if actions cross the network, ``"action"``, each
    with ``arrived`` (a new one arrived in this step), ``age_steps`` (of the one in force) and
    ``consecutive_losses`` (up to the packet of this step).

    >>> import gymnasium
    >>> from noack_gymnasium import LossyChannel
    >>> loss = {"model": "bernoulli", "probability": 0.5}
    >>> lossy = {"mansd": 3, "loss": loss}
    >>> env = LossyChannel(gymnasium.make("CartPole-v1"), {**lossy, "actuation": lossy})
    >>> observation, info = env.reset(seed=1)

    Args:
        env: the environment.
        network: the table ``network`` of a scenario, ``{"mansd": ..., "loss": ...}``; or a
            scenario, its name or its file. Actions cross the network if it has ``actuation``.
        step_s: time of a step; by default the environment's dt or tau.
        first_action: in force until the first action arrives; by default the one nearest to 0 of a
            Box, the first one of Discrete.
        seed: the seed of the losses; by default the scenario's ``seeds.loss``, else 0.

    Raises:
        NoackError: the network is wrong, or the environment has no time of a step.
    """

    def __init__(
        self,
        env: gymnasium.Env[ObsType, ActType],
        network: Scenario | str | PathLike[str] | Mapping[str, object],
        *,
        step_s: float | None = None,
        first_action: ActType | None = None,
        seed: int | None = None,
    ) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(
            self, network=network, step_s=step_s, first_action=first_action, seed=seed
        )
        super().__init__(env)
        lossy = VirtualNetwork[Any](network, seed=seed)
        self._network, self._seed, self._crossed = network, lossy.seed, len(lossy.directions) > 1
        self._step_ns = _step_ns(env, step_s)
        self._episode, self._step, self._now_ns = -1, 0, 0
        self._entries = [_entries(env.observation_space), 0]
        self._first_action: Any = first_action
        if self._crossed:
            self._entries[1] = _entries(env.action_space)
            if first_action is None:
                self._first_action = _first(env.action_space)
            elif not env.action_space.contains(first_action):
                raise CallerError(f"LossyChannel: first_action is not in {env.action_space}")

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ObsType, dict[str, Any]]:
        """Begin an episode; return the first observation itself."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._episode, self._step, self._now_ns = self._episode + 1, 0, 0
        if seed is not None:
            self._seed, self._episode = seed, 0
        self._lossy = VirtualNetwork[Any](self._network, seed=self._seed, episode=self._episode)
        self._observations: _Receiver[ObsType] = _Receiver(deepcopy(observation), self._entries[0])
        self._actions: _Receiver[ActType] = _Receiver(self._first_action, self._entries[1])
        self._receivers: dict[str, _Receiver[Any]] = {
            "update": self._observations,
            "actuation": self._actions,
        }
        self._send("update", observation)
        network = {"observation": self._info("update")}
        if self._crossed:
            network["action"] = self._info("actuation")
        return deepcopy(observation), {**info, "network": network}

    def step(self, action: ActType) -> tuple[ObsType, SupportsFloat, bool, bool, dict[str, Any]]:
        """Make a step with the newest action that has arrived; return the newest observation."""
        if self._episode < 0:
            raise gymnasium.error.ResetNeeded("LossyChannel: call reset before step")
        network, applied = dict[str, object](), action
        if self._crossed:
            self._send("actuation", action)
            applied, network["action"] = self._actions.held, self._info("actuation")
        observation, reward, terminated, truncated, info = self.env.step(deepcopy(applied))
        self._step += 1
        self._now_ns = nearest_ns(self._step * self._step_ns)
        self._send("update", observation)
        network["observation"] = self._info("update")
        newest = deepcopy(self._observations.held)
        return newest, reward, terminated, truncated, {**info, "network": network}

    def _send(self, direction: str, value: object) -> None:
        """Send a packet now; take what has arrived."""
        content = self._step, deepcopy(value)
        entries = self._receivers[direction].entries
        for packet in self._lossy.send(direction, content, entries, self._now_ns):
            self._receivers[packet.direction].take(packet.content)

    def _info(self, direction: str) -> dict[str, object]:
        losses = self._lossy.consecutive_losses(direction)
        return self._receivers[direction].info(self._step, losses)


def _step_ns(env: gymnasium.Env[ObsType, ActType], step_s: float | None) -> Fraction:
    """Return the exact time of a step: 10⁹/30 ns, which is no whole number."""
    own_s = own_step_s(env.unwrapped) if step_s is None else step_s
    if own_s is None:
        raise CallerError(f"LossyChannel: {env} has no time of a step; give step_s, in seconds")
    with suppress(TypeError, ValueError):
        if 1e-9 <= float(own_s) < 2**62 * 1e-9:
            return exact_ns(float(own_s))
    raise CallerError(f"LossyChannel: step_s = {own_s!r}: must be a time in seconds, above 0")


def _entries(space: gymnasium.Space[Value]) -> int:
    """Return how many numbers a value of a space has."""
    try:
        return flatdim(space)
    except (NotImplementedError, ValueError):
        raise CallerError(f"LossyChannel: values of {space} have no fixed size") from None


def _first(space: gymnasium.Space[ActType]) -> Any:
    """Return the action nearest to 0, or the first one."""
    if isinstance(space, gymnasium.spaces.Box):
        return np.clip(np.zeros(space.shape, space.dtype), space.low, space.high)
    if isinstance(space, gymnasium.spaces.Discrete):
        return space.start
    raise CallerError(f"LossyChannel: no action of {space} is the first one; give first_action")
