"""The graph of ROS 2, against zenoh-ros2-sdk, a client that is not noack's."""

import json
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import noack
from netem.core.errors import CallerError
from tests.helpers.command_line import invoke
from tests.helpers.live_runs import AT_RATE

pytest.importorskip("zenoh_ros2_sdk", reason="zenoh-ros2-sdk is not installed")
EXAMPLE = Path(__file__).parents[1] / "examples/ros2_plant.py"
LISTENER = Path(__file__).with_name("ros2_listener.py")
CONTROLLER = Path(__file__).with_name("ros2_controller_node.py")
LOOP = {
    "name": "in_ros2", "horizon_s": 2.0,
    "model": {"name": "double_integrator", "parameters": {"stiffness": 1.0, "damping": 1.4}},
    "plant": {
        "draw": "given", "A": [[0.0, 1.0], [0.0, 0.0]], "B": [[0.0], [0.9]],
        "initial_state": [1.0, 0.0], "rate_hz": 100.0,
    },
    "controller": {"rate_hz": 100.0},
    "trigger": {"beta": 0.05, "alpha_per_s": 0.3, "floor": 0.001},
    "network": {"mansd": 4, "loss": {"model": "bernoulli", "probability": 0.5}},
}  # fmt: skip


@pytest.fixture
def port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


@contextmanager
def node(*words: object) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, *map(str, words)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def peer(port: int, **more: object) -> dict[str, object]:
    ros2_settings = {"router": f"tcp/127.0.0.1:{port}", "listen": True}
    return {"kind": "ros2", "timeout_s": 20.0, "start_timeout_s": 60.0, **ros2_settings, **more}


def in_ros2(port: int) -> dict[str, object]:
    plant = {key: LOOP["plant"][key] for key in ("initial_state", "rate_hz")}  # type: ignore[index]
    return LOOP | {"plant": plant | {"system": peer(port)}}


def states(run: noack.Run) -> np.ndarray:
    table = run.table("plant_step")
    return np.column_stack([table["x_1"].to_numpy(), table["x_2"].to_numpy()])


def test_a_plant_in_ros2_moves_as_the_same_plant_in_noack(port: int) -> None:
    own = noack.simulate(noack.load(LOOP))
    with node(EXAMPLE, port):
        run = noack.simulate(noack.load(in_ros2(port)))
    assert run.summary.loops[0].events == own.summary.loops[0].events > 1
    assert np.abs(states(run) - states(own)).max() < 1e-9
    assert run.replay().bit_exact


@pytest.mark.live
def test_a_plant_in_ros2_takes_part_in_a_live_run(port: int) -> None:
    with node(EXAMPLE, port):
        run = noack.run(noack.load(in_ros2(port)))
    assert run.summary.exit.reason == "horizon"
    assert run.replay().bit_exact


def test_a_controller_in_ros2_controls(port: int) -> None:
    own = noack.simulate(noack.load(LOOP))
    given = LOOP | {"controller": {"rate_hz": 100.0} | peer(port)}
    with node(CONTROLLER, port):
        run = noack.simulate(noack.load(given))
    assert np.abs(states(run) - states(own)).max() < 1e-9
    assert run.replay().bit_exact


def test_a_ros2_node_that_does_not_answer_is_named(port: int) -> None:
    given = LOOP | {"controller": {"rate_hz": 100.0} | peer(port, start_timeout_s=0.3)}
    with pytest.raises(CallerError, match="no answer on /noack/controller/input"):
        noack.simulate(noack.load(given))
    nowhere = peer(port, listen=False)
    with pytest.raises(CallerError, match="cannot reach a router of ROS 2"):
        noack.simulate(noack.load(LOOP | {"controller": nowhere}))
    result = invoke("bridge", "lane_following", "--router", "nonsense")
    assert result.exit_code == 2
    assert "router nonsense: give it as tcp/127.0.0.1:7447" in result.output


@pytest.mark.live
def test_an_independent_client_receives_a_live_run(port: int, tmp_path: Path) -> None:
    with node(LISTENER, port) as listener:
        words = ("--listen", "--router", f"tcp/127.0.0.1:{port}", "--runs", tmp_path)
        result = invoke(
            "bridge",
            "lane_following",
            "--set",
            "horizon_s=3",
            "--set",
            "certificate.prove=false",
            *AT_RATE,
            *words,
        )
        assert result.exit_code == 0, result.output
        assert listener.stdout is not None
        received = json.loads(listener.stdout.readline())
    steps = noack.open_run(next(tmp_path.glob("*lane_following"))).table("plant_step")
    recorded = {t_ns: (a, b) for t_ns, a, b in zip(
        steps["t_ns"].to_pylist(), steps["x_1"].to_pylist(), steps["x_4"].to_pylist(), strict=True
    )}  # fmt: skip
    assert received["messages"][-1][0] == 3 * 10**9
    for t_ns, first, last in received["messages"]:
        assert recorded[t_ns] == (first, last)
    sent = [number for number, _ in received["attachments"]]
    assert sent == sorted(set(sent))
    assert {gid_bytes for _, gid_bytes in received["attachments"]} == {16}
    assert any("/MP/%/%/noack/%noack%state/" in token for token in received["tokens"])
