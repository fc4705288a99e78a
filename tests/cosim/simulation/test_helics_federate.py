"""noack helics: the shipped loop of two federates that do not know noack, and a simulated run."""

import json
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import numpy as np
import pytest

import noack

pytest.importorskip("helics", reason="the extra `helics` is not installed")
ROOT = Path(__file__).parents[3]
BROKER = """
import sys, helics
broker = helics.helicsCreateBroker("zmq", "", sys.argv[1])
helics.helicsBrokerWaitForDisconnect(broker, -1)
"""
DELAY = "network.impairments=[{kind='delay', delay_s=0.0045}]"
TIMEOUT_S = 120
Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts Python with arguments; what still runs is ended afterwards."""
    started: list[subprocess.Popen[str]] = []

    def begin(*arguments: str, stdout: IO[str] | int = subprocess.PIPE) -> "subprocess.Popen[str]":
        command = [sys.executable, *arguments]
        one = subprocess.Popen(command, stdout=stdout, stderr=subprocess.PIPE, text=True, cwd=ROOT)
        started.append(one)
        return one

    yield begin
    for one in started:
        one.kill()
        one.communicate()


def federation(start: Start, *options: str) -> list["subprocess.Popen[str]"]:
    """The network, the plant and the controller of a federation, with a broker at a free port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    start("-c", BROKER, f"-f 3 --port={port} --loglevel=error", stdout=subprocess.DEVNULL)
    network = start("-m", "cosim.cli", "helics", "double_integrator", "--broker", address, *options)
    roles = ("plant", "controller")
    return [network, *(start("scenarios/helics_loop.py", role, address) for role in roles)]


def test_two_federates_have_the_run_of_a_simulation(start: Start) -> None:
    """Same events, same losses; states to rounding errors, as scipy's exponential is another."""
    network, plant, _ = federation(
        start, "--endpoint", "controller/update", "--set", DELAY, "--json"
    )
    states, _ = plant.communicate(timeout=TIMEOUT_S)
    counts, errors = network.communicate(timeout=TIMEOUT_S)
    assert network.returncode == 0, errors
    scenario = noack.load(
        "double_integrator",
        {
            "horizon_s": 2.0,
            "plant.draw": "given",
            "plant.A": [[0.0, 1.0], [0.0, 0.0]],
            "plant.B": [[0.0], [1.2]],
            "network.impairments": [{"kind": "delay", "delay_s": 0.0045}],
        },
    )
    run = noack.simulate(scenario)
    expected = run.samples().to_pydict()
    t_s, x_1, x_2, event = np.loadtxt(states.splitlines(), delimiter=",", unpack=True)
    np.testing.assert_allclose([t_s, x_1, x_2], [expected[k] for k in ("t_s", "x_1", "x_2")],
                               rtol=0, atol=1e-12)  # fmt: skip
    packets = run.table("netem_packet").to_pydict()
    np.testing.assert_array_equal(np.rint(t_s[event == 1] * 1e9), packets["t_ns"])
    (route,) = json.loads(counts)["endpoints"]
    assert route == {
        "endpoint": "controller/update",
        "sent": len(packets["t_ns"]),
        "lost": packets["fate"].count(1),
        "longest_burst": max(packets["consecutive_losses"]),
    }
    assert route["lost"] > 0


def test_an_endpoint_that_the_federation_does_not_have_is_one_line(start: Start) -> None:
    network, *_ = federation(start, "--endpoint", "controller/updates")
    _, errors = network.communicate(timeout=TIMEOUT_S)
    assert network.returncode == 2
    (line,) = errors.splitlines()
    assert "controller/updates: the federation has no such endpoint" in line
    assert line.endswith("it has controller/update, plant/input")
