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
from netem.channel import UPDATE_LINK
from netem.link_state import LinkState

pytest.importorskip("helics", reason="the extra `helics` is not installed")
ROOT = Path(__file__).parents[3]
BROKER = """
import sys, helics
broker = helics.helicsCreateBroker("zmq", "", sys.argv[1])
helics.helicsBrokerWaitForDisconnect(broker, -1)
"""
DELAY = "network.impairments=[{kind='delay', delay_s=0.0045}]"
TIMEOUT_S = 120
IMPAIRMENTS = [
    {"kind": "delay", "delay_s": 0.0145, "jitter_s": 0.012},
    {"kind": "duplicate", "probability": 0.3},
    {"kind": "corrupt", "probability": 0.2},
]
MESSAGES = 300
SENDER = f"""
import sys, helics
info = helics.helicsCreateFederateInfo()
helics.helicsFederateInfoSetCoreTypeFromString(info, "zmq")
helics.helicsFederateInfoSetBroker(info, sys.argv[1])
helics.helicsFederateInfoSetFlagOption(info, helics.HELICS_FLAG_UNINTERRUPTIBLE, True)
own = helics.helicsCreateMessageFederate("both", info)
sender, *ends = (helics.helicsFederateRegisterGlobalEndpoint(own, name, "") for name in "sab")
helics.helicsFederateEnterExecutingMode(own)
for k in range({MESSAGES} + 10):
    if k:
        helics.helicsFederateRequestTime(own, k * 0.01)
    for name, end in zip("ab", ends):
        while helics.helicsEndpointHasMessage(end):
            message = helics.helicsEndpointGetMessage(end)
            data = helics.helicsMessageGetBytes(message).hex()
            print(name, round(message.time * 1e9), data, message.original_source)
        if k < {MESSAGES}:
            helics.helicsEndpointSendBytesTo(sender, b"%08d" % k, "noack/" + name)
helics.helicsFederateDisconnect(own)
helics.helicsCloseLibrary()
"""
Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts Python with arguments; what still runs is ended afterwards."""
    started: list[subprocess.Popen[str]] = []

    def begin(*arguments: str, stdout: IO[str] | int = subprocess.PIPE) -> "subprocess.Popen[str]":
        command = [sys.executable, *arguments]
        process = subprocess.Popen(command, stdout=stdout, stderr=subprocess.PIPE, text=True, cwd=ROOT)
        started.append(process)
        return process

    yield begin
    for process in started:
        process.kill()
        process.communicate()


def federation(start: Start, federates: int, *options: str) -> tuple[str, "subprocess.Popen[str]"]:
    """Start a broker at a free port, and the network; return the broker's address, too."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    start("-c", BROKER, f"-f {federates} --port={port} --loglevel=error", stdout=subprocess.DEVNULL)
    address = f"tcp://127.0.0.1:{port}"
    command = ("-m", "cosim.cli", "helics", "double_integrator", "--broker", address)
    return address, start(*command, *options)


def test_two_federates_have_the_run_of_a_simulation(start: Start) -> None:
    """Same events, same losses; states to rounding errors, as scipy's exponential is another."""
    options = ("--endpoint", "controller/update", "--set", DELAY, "--json")
    address, network = federation(start, 3, *options)
    start("scenarios/helics_loop.py", "controller", address)
    plant = start("scenarios/helics_loop.py", "plant", address)
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


def test_copies_damage_and_overtaking_are_those_of_the_link(start: Start) -> None:
    settings = json.dumps(IMPAIRMENTS).replace('": ', '" = ')
    options = ("--endpoint", "a", "--endpoint", "b", "--set", f"network.impairments={settings}")
    address, _ = federation(start, 2, *options)
    received_lines, errors = start("-c", SENDER, address).communicate(timeout=TIMEOUT_S)
    scenario = noack.load("double_integrator", {"network.impairments": IMPAIRMENTS})
    link = LinkState(scenario.network.link, scenario.seeds.loss, UPDATE_LINK, rows=2)
    for row in range(2):
        link.start_flow(row, row)
    expected = []
    for k in range(MESSAGES):
        for row, name in enumerate("ab"):
            decision = link.decide(row, 8, 10_000_000 * k)
            for time_ns, bit in ((decision.release_ns, decision.bit), (decision.copy_ns, decision.copy_bit)):
                data = int.from_bytes(b"%08d" % k, "little") ^ (1 << bit if bit >= 0 else 0)
                if time_ns >= 0:
                    expected.append(f"{name} {time_ns} {data.to_bytes(8, 'little').hex()} s")
    assert sorted(received_lines.splitlines()) == sorted(expected), errors
    assert len(expected) > MESSAGES / 4


def test_an_endpoint_that_the_federation_does_not_have_is_one_line(start: Start) -> None:
    address, network = federation(start, 2, "--endpoint", "c")
    start("-c", SENDER, address)
    _, errors = network.communicate(timeout=TIMEOUT_S)
    assert network.returncode == 2
    (line,) = errors.splitlines()
    assert "--endpoint c: the federation has no such endpoint" in line
    assert line.endswith("it has a, b, s")
