"""A Gymnasium environment behind noack's network: observations and actions are delayed and lost.

The channel is that of a simulated run (:mod:`netem.channel`): the core decides for each packet, by
the rules, random streams and guarantee of the emulator, in virtual time.
"""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from copy import deepcopy
from os import PathLike
from typing import Generic, SupportsFloat, TypeVar

import gymnasium
import numpy as np
from gymnasium.core import ActType, ObsType
from gymnasium.spaces.utils import flatdim

from cosim.api.scenarios import Source, load
from cosim.shipped_files import find_shipped
from netem.channel import Channel, Departure, link_name, require_stand_alone
from netem.link_state import LinkState
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.plants.gymnasium import own_step_s
from noack.protocol.record_tables import NETEM_PACKET
from noack.protocol.wire_format import datagram_bytes
from noack.scenario import toml_file
from noack.scenario.scenario import Scenario
from noack.settings.section import ReadTable
from noack.settings.user_files import UserCode

Value = TypeVar("Value")


class _Receiver(Generic[Value]):
    """What one direction's receiver holds: the value of the newest packet that has arrived."""

    def __init__(self, held: Value, size_bytes: int) -> None:
        self.held, self.size_bytes = held, size_bytes
        self.sent, self.number, self.sent_step = 0, -1, 0
        self.arrived, self.losses = False, 0
        self.steps: dict[int, tuple[int, Value]] = {}  # step and value of packets not yet received

    def take(self, number: int) -> None:
        """Hold the value of a packet, unless a newer one has arrived."""
        if number > self.number:
            self.arrived, self.number = True, number
            self.sent_step, self.held = self.steps[number]
            self.steps = {later: entry for later, entry in self.steps.items() if later > number}

    def info(self, step: int) -> dict[str, object]:
        """Return what ``info`` says of this direction since the last call."""
        arrived, self.arrived = self.arrived, False
        age_steps = step - self.sent_step
        return {"arrived": arrived, "age_steps": age_steps, "consecutive_losses": self.losses}


class LossyChannel(
    gymnasium.Wrapper[ObsType, ActType, ObsType, ActType],
    gymnasium.utils.RecordConstructorArgs,
):
    """An environment whose observations, and actions, cross a network that delays and drops them.

    Step k has the time k times the environment's step. The action is sent then, and the environment
    steps with the newest action that has arrived; the next observation is sent at the end of the
    step, and ``step`` returns the newest observation that has arrived. So a packet that is lost or
    late leaves the one before in force (hold), and a delay takes the next whole number of steps.
    Rewards and ends of episodes do not cross the network. ``reset`` returns the first observation
    itself, which is also the first packet.

    Each direction has the guarantee of the network, e.g. at most M − 1 consecutive losses. Losses
    are those of a run of noack with the same ``seeds.loss``, packet by packet; each further episode
    has others. ``reset(seed=...)`` sets this seed and begins again.

    ``info["network"]`` has ``"observation"`` and, if actions cross the network, ``"action"``, each
    with ``arrived`` (a new one arrived in this step), ``age_steps`` (of the one in force) and
    ``consecutive_losses`` (up to the packet of this step).

    >>> import gymnasium, noack
    >>> loss = {"model": "bernoulli", "probability": 0.5}
    >>> lossy = {"mansd": 3, "loss": loss}
    >>> env = noack.LossyChannel(gymnasium.make("CartPole-v1"), {**lossy, "actuation": lossy})
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
        network: Source | ReadTable,
        *,
        step_s: float | None = None,
        first_action: ActType | None = None,
        seed: int | None = None,
    ) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(
            self, network=network, step_s=step_s, first_action=first_action, seed=seed
        )
        super().__init__(env)
        scenario = require_stand_alone(_load_network(network))
        self._network, self._step_ns = scenario.network, _step_ns(env, step_s)
        if seed is not None and (not isinstance(seed, int | np.integer) or seed < 0):
            raise CallerError(f"LossyChannel: seed = {seed!r}: must be a whole number, 0 or more")
        self._seed = scenario.seeds.loss if seed is None else int(seed)
        self._episode, self._step, self._now_ns = -1, 0, 0
        self._sizes = [_size_bytes(env.observation_space), 0]
        self._first_action: UserCode = first_action
        if len(self._network.flows) > 1:
            self._sizes[1] = _size_bytes(env.action_space)
            if first_action is None:
                self._first_action = _first(env.action_space)
            elif not env.action_space.contains(first_action):
                raise CallerError(f"LossyChannel: first_action is not in {env.action_space}")

    def reset(
        self, *, seed: int | None = None, options: dict[str, UserCode] | None = None
    ) -> tuple[ObsType, dict[str, UserCode]]:
        """Begin an episode; return the first observation itself."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._episode, self._step, self._now_ns = self._episode + 1, 0, 0
        if seed is not None:
            self._seed, self._episode = seed, 0
        flows = self._network.flows
        links = [LinkState(self._network.link_of(flow), self._seed, link_name(flow)) for flow in flows]
        self._channel = Channel(links)
        for direction, link in enumerate(links):
            link.start_flow(0, len(links) * self._episode + direction)
        self._observations: _Receiver[ObsType] = _Receiver(deepcopy(observation), self._sizes[0])
        self._actions: _Receiver[ActType] = _Receiver(self._first_action, self._sizes[1])
        self._receivers = (self._observations, self._actions)[: len(links)]
        self._send(0, self._observations, observation)
        network = {"observation": self._observations.info(0)}
        if len(links) > 1:
            network["action"] = self._actions.info(0)
        return deepcopy(observation), {**info, "network": network}

    def step(self, action: ActType) -> tuple[ObsType, SupportsFloat, bool, bool, dict[str, UserCode]]:
        """Make a step with the newest action that has arrived; return the newest observation."""
        if self._episode < 0:
            raise gymnasium.error.ResetNeeded("LossyChannel: call reset before step")
        network, applied = dict[str, object](), action
        if len(self._receivers) > 1:
            self._send(1, self._actions, action)
            applied, network["action"] = self._actions.held, self._actions.info(self._step)
        observation, reward, terminated, truncated, info = self.env.step(deepcopy(applied))
        self._step += 1
        self._now_ns += self._step_ns
        self._send(0, self._observations, observation)
        network["observation"] = self._observations.info(self._step)
        newest = deepcopy(self._observations.held)
        return newest, reward, terminated, truncated, {**info, "network": network}

    def _send(self, direction: int, receiver: _Receiver[Value], value: Value) -> None:
        """Send a packet now, after what is due has arrived."""
        receiver.steps[receiver.sent] = self._step, deepcopy(value)
        self._take(self._channel.release(self._now_ns))
        leaving, copies = self._channel.send(direction, receiver.sent, receiver.size_bytes, self._now_ns)
        if not copies:
            del receiver.steps[receiver.sent]
        receiver.sent += 1
        self._take(leaving)
        self._take(self._channel.release(self._now_ns))
        for table, rows in self._channel.take_rows():
            for row in rows if table == NETEM_PACKET else ():
                receiver.losses = int(row["consecutive_losses"])

    def _take(self, leaving: Iterable[Departure]) -> None:
        """Let what leaves the channel arrive."""
        for packet in leaving:
            if packet.bit < 0:  # a receiver rejects a damaged datagram
                self._receivers[packet.flow].take(packet.number)


def _load_network(network: Source | ReadTable) -> Scenario:
    if isinstance(network, Mapping):
        base = toml_file.read(find_shipped("double_integrator", "scenarios"), Scenario)
        try:
            return load({**base, "network": dict(network), "seeds": {}})
        except CallerError as error:
            lines = str(error).replace("scenario: ", "").splitlines()
            raise CallerError(f"LossyChannel: {'; '.join(lines)}") from None
    if not isinstance(network, Scenario | str | PathLike):
        raise CallerError(f"network: {network!r}; give a table as {{'mansd': 3, 'loss': ...}}, or a scenario")
    return load(network)


def _step_ns(env: gymnasium.Env[ObsType, ActType], step_s: float | None) -> int:
    own_s = own_step_s(env.unwrapped) if step_s is None else step_s
    if own_s is None:
        raise CallerError(f"LossyChannel: {env} has no time of a step; give step_s, in seconds")
    with suppress(TypeError, ValueError):
        if 1 <= float(own_s) * NS_PER_S < 2**62:
            return round(float(own_s) * NS_PER_S)
    raise CallerError(f"LossyChannel: step_s = {own_s!r}: must be a time in seconds, above 0")


def _size_bytes(space: gymnasium.Space[Value]) -> int:
    """Return the size of noack's datagram with a value of a space."""
    try:
        return datagram_bytes(flatdim(space))
    except (NotImplementedError, ValueError):
        raise CallerError(f"LossyChannel: values of {space} have no fixed size") from None


def _first(space: gymnasium.Space[ActType]) -> UserCode:
    """Return the action nearest to 0, or the first one."""
    if isinstance(space, gymnasium.spaces.Box):
        return np.clip(np.zeros(space.shape, space.dtype), space.low, space.high)
    if isinstance(space, gymnasium.spaces.Discrete):
        return space.start
    raise CallerError(f"LossyChannel: no action of {space} is the first one; give first_action")
