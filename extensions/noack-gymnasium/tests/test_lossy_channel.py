"""LossyChannel: the emulator's losses around an environment, the guarantee, the hold."""

import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import noack
from noack.extend import CallerError
from noack_gymnasium import LossyChannel
from tests.helpers.pages import blocks

STEP_S = 0.02
LOSSLESS: dict[str, Any] = {"mansd": 3, "loss": {"model": "lossless"}}
HALF: dict[str, Any] = {"mansd": 3, "loss": {"model": "bernoulli", "probability": 0.5}}
MOST: dict[str, Any] = {"mansd": 3, "loss": {"model": "bernoulli", "probability": 0.9}}


class Clock(gymnasium.Env):  # type: ignore[type-arg]
    """Observes how many steps it has made, and the action that it got; in an array of its own."""

    action_space = gymnasium.spaces.Box(-1e6, 1e6, (1,), np.float64)
    observation_space = gymnasium.spaces.Box(-1e6, 1e6, (2,), np.float64)
    dt = STEP_S

    def __init__(self) -> None:
        self.seen = np.zeros(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.seen[:] = 0.0
        return self.seen, {"own": 1}

    def step(self, action: Any) -> Any:
        self.seen[:] = self.seen[0] + 1, action[0]
        return self.seen, 0.0, False, False, {"own": 1}


def episode(env: Any, steps: int, seed: int | None = 1) -> tuple[np.ndarray, list[Any]]:
    """Observations and infos; the action of step k is k + 1."""
    first, info = env.reset(seed=seed)
    seen, infos = [first], [info]
    for k in range(steps):
        observation, *_, info = env.step(np.array([k + 1.0]))
        seen.append(observation)
        infos.append(info)
    return np.array(seen), infos


def losses(infos: list[Any], direction: str) -> list[int]:
    return [info["network"][direction]["consecutive_losses"] for info in infos]


def test_the_losses_are_those_of_a_run_packet_by_packet() -> None:
    """A sensor that sends at each step; the first packet of a flow passes."""
    settings = {"network": MOST, "horizon_s": 40.0}
    run = noack.simulate(noack.load("lane_periodic", settings))
    packets = run.table("netem_packet")
    expected = np.array(packets["consecutive_losses"])
    assert len(expected) > 50
    env = LossyChannel(Clock(), noack.load("lane_periodic", settings))
    _, infos = episode(env, len(expected) - 1, seed=run.scenario.seeds.loss)
    np.testing.assert_array_equal(losses(infos, "observation"), expected)


def test_without_loss_and_delay_nothing_changes() -> None:
    env = LossyChannel(Clock(), {**LOSSLESS, "actuation": LOSSLESS})
    observations, infos = episode(env, 5)
    np.testing.assert_array_equal(observations, [[k, k] for k in range(6)])
    assert all(info["network"]["observation"]["arrived"] and info["own"] for info in infos)


@pytest.mark.parametrize(("delay_s", "late"), [
    (0.001, 1), (0.0199, 1), (0.02, 1), (0.0201, 2), (0.05, 3), (0.06, 3),
])  # fmt: skip
def test_a_delay_takes_the_next_whole_number_of_steps(delay_s: float, late: int) -> None:
    delayed = {**LOSSLESS, "impairments": [{"kind": "delay", "delay_s": delay_s}]}
    env = LossyChannel(Clock(), {**delayed, "actuation": delayed})
    observations, infos = episode(env, 10)
    k = np.arange(11)
    np.testing.assert_array_equal(observations[:, 0], np.maximum(k - late, 0))
    # Step j, counted from 1, gets action j − late, which was sent as j − late.
    applied = np.maximum(np.maximum(k - late, 0) - late, 0)
    np.testing.assert_array_equal(observations[:, 1], applied)
    last = infos[-1]["network"]
    assert last["observation"]["age_steps"] == last["action"]["age_steps"] == late
    assert last["action"]["arrived"]


@pytest.mark.parametrize("rate_hz", [30, 60, 90, 120, 144, 3, 30000 / 1001, 64000])
@pytest.mark.parametrize("late", [1, 2, 3, 7])
def test_a_delay_of_whole_steps_takes_as_many_at_each_rate(rate_hz: float, late: int) -> None:
    """Also if the step is no whole number of nanoseconds: in the first steps, and in all others."""
    delayed = {**LOSSLESS, "impairments": [{"kind": "delay", "delay_s": late / rate_hz}]}
    env = LossyChannel(Clock(), {**delayed, "actuation": delayed}, step_s=1 / rate_hz)
    observations, infos = episode(env, 200)
    k = np.arange(201)
    np.testing.assert_array_equal(observations[:, 0], np.maximum(k - late, 0))
    np.testing.assert_array_equal(observations[:, 1], np.maximum(k - 2 * late, 0))
    for info in infos[2 * late :]:
        assert {info["network"][key]["age_steps"] for key in ("observation", "action")} == {late}


@pytest.mark.parametrize(("rate_hz", "late"), [(30, 3), (60, 6), (90, 9), (120, 12), (144, 15)])
def test_a_tenth_of_a_second_takes_the_steps_of_exact_arithmetic(rate_hz: int, late: int) -> None:
    delayed = {**LOSSLESS, "impairments": [{"kind": "delay", "delay_s": 0.1}]}
    observations, _ = episode(LossyChannel(Clock(), delayed, step_s=1 / rate_hz), 100)
    np.testing.assert_array_equal(observations[:, 0], np.maximum(np.arange(101) - late, 0))


@pytest.mark.parametrize("settings", [
    {},
    {"impairments": [{"kind": "delay", "delay_s": 0.03, "jitter_s": 0.03}]},
    {"impairments": [{"kind": "corrupt", "probability": 0.3},
                     {"kind": "duplicate", "probability": 0.3}]},
])  # fmt: skip
def test_a_packet_of_m_successive_ones_arrives_in_each_direction(settings: dict[str, Any]) -> None:
    """Over long runs; the newest packet that has arrived is in force, an older one never again."""
    lossy = {**MOST, **settings}
    late = 3 if settings.get("impairments", [{}])[0].get("kind") == "delay" else 0
    env = LossyChannel(Clock(), {**lossy, "actuation": lossy})
    longest = {"observation": 0, "action": 0}
    for seed in range(5):
        observations, infos = episode(env, 1000, seed=seed)
        for direction in longest:
            longest[direction] = max(longest[direction], *losses(infos, direction))
            ages = [info["network"][direction]["age_steps"] for info in infos[1:]]
            assert max(ages[late + 4 :]) <= 3 + late
        steps = observations[:, 0]
        assert all(after >= before for before, after in pairwise(steps))
        assert all(after >= before for before, after in pairwise(observations[:, 1]))
    assert longest == {"observation": 3, "action": 3}


def test_a_seed_gives_the_same_bits_and_each_episode_has_other_losses() -> None:
    lossy = {**HALF, "impairments": [{"kind": "delay", "delay_s": 0.03, "jitter_s": 0.03}]}
    env, second_env = (LossyChannel(Clock(), {**lossy, "actuation": HALF}) for _ in range(2))
    first, infos = episode(env, 300, seed=4)
    second, more_infos = episode(env, 300, seed=None)
    second_observations, second_infos = episode(second_env, 300, seed=4)
    assert first.tobytes() == second_observations.tobytes()
    assert infos == second_infos
    assert first.tobytes() != second.tobytes()
    assert episode(second_env, 300, seed=None)[0].tobytes() == second.tobytes()
    assert losses(infos, "observation") != losses(more_infos, "observation")
    assert losses(infos, "observation") != losses(infos, "action")


@pytest.mark.parametrize("name", ["CartPole-v1", "Pendulum-v1"])
@pytest.mark.filterwarnings("ignore:.*WARN:UserWarning")  # of the environments' own spaces
def test_the_environment_passes_the_check_of_gymnasium(name: str) -> None:
    env = LossyChannel(gymnasium.make(name), {**HALF, "actuation": HALF}, step_s=STEP_S)
    check_env(env, skip_render_check=True)
    made_again = gymnasium.make(env.spec)  # it records how it was made
    assert isinstance(made_again, LossyChannel)


def test_actions_cross_the_network_only_if_it_says_so() -> None:
    observations, infos = episode(LossyChannel(Clock(), MOST), 50)
    arrived = observations[np.array([info["network"]["observation"]["arrived"] for info in infos])]
    np.testing.assert_array_equal(arrived[:, 0], arrived[:, 1])
    assert "action" not in infos[-1]["network"]


class NoStep(Clock):
    dt = None  # type: ignore[assignment]


@pytest.mark.parametrize(("env", "network", "given", "reason"), [
    (Clock, {"mansd": 3}, {}, r"^network.loss: missing"),
    (Clock, {**HALF, "mansd": -1}, {}, r"^network.mansd"),
    (Clock, {}, {}, r"^network.loss: missing .*; network.mansd: missing"),
    (Clock, "no_such_scenario", {}, "no such file, nor a shipped scenario"),
    (Clock, "shared_channel", {}, "the scenario has loops; outside a run of noack"),
    (Clock, {**HALF, "protocol": "ack"}, {}, 'set protocol = "none"'),
    (Clock, 0.5, {}, "give a table as"),
    (NoStep, HALF, {}, "has no time of a step; give step_s, in seconds"),
    (Clock, HALF, {"step_s": 0.0}, "step_s = 0.0: must be a time in seconds, above 0"),
    (Clock, HALF, {"step_s": "x"}, "step_s = 'x': must be a time in seconds"),
    (Clock, HALF, {"step_s": float("nan")}, "step_s = nan: must be a time in seconds"),
    (Clock, HALF, {"seed": 1.5}, "seed 1.5: expected a whole number"),
    (Clock, HALF, {"seed": np.int64(-1)}, "seed -1: expected at least 0"),
])  # fmt: skip
def test_a_mistake_is_one_line(env: Any, network: Any, given: Any, reason: str) -> None:
    with pytest.raises(CallerError, match=reason) as error:
        LossyChannel(env(), network, **given)
    assert "\n" not in str(error.value)


def test_noack_does_not_import_gymnasium() -> None:
    program = "import sys, noack; noack.simulate; noack.load('double_integrator'); " \
        "sys.exit('gymnasium' in sys.modules)"  # fmt: skip
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


def test_the_readmes_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (example,) = blocks(Path(__file__).parents[1] / "README.md", "python")
    exec(compile(example, "README.md", "exec"), {"__name__": "__main__"})
    assert capsys.readouterr().out.strip().endswith("3")  # the longest burst of losses
