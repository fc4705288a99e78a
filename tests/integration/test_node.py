"""A controller that is a program of its own: native/examples/controller_node.c, and bad ones."""

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing, suppress
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import psutil
import pytest

from controller_node.controller import controllers_of
from cosim.record.run_record import load_record
from native.build import NO_COMPILER
from noack.controllers.program_controller import ProgramControllerSettings
from noack.core.clock import RunClock
from noack.core.errors import PeerError
from noack.protocol.roles import SENDS
from noack.protocol.wire_format import Wire
from noack.runtime.drivers.live_driver import LoopSockets
from noack.runtime.drivers.node_driver import NodeDriver
from noack.runtime.udp_sockets import bind
from noack.settings.user_files import with_absolute_path
from tests.helpers import live_runs as live
from tests.helpers.approved import lines_of_error
from tests.helpers.command_line import invoke
from tests.noack.runtime.drivers.live_loops import KEY, RUN_ID, Rows, scenario

Start = Callable[..., live.Running]
BUILD = Path(__file__).parents[2] / "native" / "build.py"
GREETING = "noack node 1 528"
EMULATED, TARGET = "arm", "arm-linux-musleabihf"
"""A processor of 32 bits that qemu-user emulates; ziglang builds a C library for it, for a minute."""


def built(folder: Path, **environment: str) -> Path:
    """Build the example for this machine, or by the compiler in CC; skip without a compiler."""
    program = folder / "controller_node"
    result = subprocess.run(
        [sys.executable, BUILD, "--node", program], check=False, env=os.environ | environment
    )
    if result.returncode == NO_COMPILER:
        pytest.skip("there is no C compiler")
    assert result.returncode == 0
    return program


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example, built for this machine."""
    return built(tmp_path_factory.mktemp("node"))


def script(folder: Path, commands: str) -> Path:
    program = folder / "node"
    program.write_text(f"#!/bin/sh\n{commands}\n")
    program.chmod(0o700)
    return program


def options_for(program: Path, *runner: str, **more: object) -> list[str]:
    """Options with which a program is the controller."""
    return [
        *live.AT_RATE,
        *live.settings(
            controller__kind="program", controller__file=str(program), controller__runner=runner,
            **more,
        ),
    ]  # fmt: skip


def program_of(running: live.Running) -> psutil.Process:
    (program,) = running.child("controller").children()
    return program


@pytest.mark.parametrize("processor", ["own", pytest.param(EMULATED, marks=pytest.mark.system)])
def test_a_program_takes_part_in_a_live_run_and_is_replayed(
    processor: str, node: Path, tmp_path: Path
) -> None:
    """The same steps, whatever the processor: the replay has the bits of the library's core.

    What a program has started ends with the run, also while it keeps the program's stream open.
    """
    pid_file = tmp_path / "pid"
    if processor == "own":
        program = script(tmp_path, f"sleep 600 & echo $! >{pid_file}; exec {node}")
        options = options_for(program, horizon_s=3.0)
    else:
        if shutil.which(f"qemu-{processor}") is None:
            pytest.skip("qemu-user is not installed")
        if find_spec("ziglang") is None:
            pytest.skip("ziglang is not installed")
        compiler = f"{sys.executable} -m ziglang cc -target {TARGET} -static"
        options = options_for(built(tmp_path, CC=compiler), f"qemu-{processor}", horizon_s=3.0)
    finished = live.run_scenario(tmp_path / "runs", *options)
    assert finished.status == 0, finished.stderr
    live.assert_complete(finished.loop)
    record = load_record(finished.run_dir)
    channel = json.loads((finished.run_dir / "reports.json").read_text())["controller"]["channel"]
    assert channel["sent"] == len(record["controller_step"]) == 3 * live.RATE_HZ
    assert channel["accepted"] == len(record["controller_delivery"]) > 0
    assert channel["rejected"] == channel["send_errors"] == {}
    assert (finished.run_dir / "logs" / "controller.log").read_text() == ""
    if pid_file.exists():
        with suppress(psutil.NoSuchProcess):
            live.wait_for(lambda: live.is_over(psutil.Process(int(pid_file.read_text()))))


def test_a_killed_program_ends_the_run_and_its_rows_are_kept(start: Start, node: Path) -> None:
    running = start(*options_for(node, speed=4.0, horizon_s=400.0))
    running.wait_recording()
    program_of(running).kill()
    finished = running.finish()
    assert finished.status == 1
    reason = finished.summary["exit"]["reason"]
    assert reason.startswith("controller: controller.file (controller_node): ")
    assert reason.endswith("the program has ended: killed by SIGKILL")
    rows = load_record(finished.run_dir)["controller_step"]
    assert len(rows) > 10
    assert np.array_equal(rows["sequence"], np.arange(len(rows)))
    assert finished.loop["replay"]["bit_exact"]
    assert running.left_behind() == []


def driver_of(program: Path, content: dict[str, Any]) -> NodeDriver:
    """The driver of a program, without a run."""
    settings = with_absolute_path(
        ProgramControllerSettings(kind="program", file=str(program)), Path(), "here"
    )
    assert isinstance(settings, ProgramControllerSettings)
    descriptor = SimpleNamespace(key=KEY)
    process: Any = SimpleNamespace(wire=Wire(RUN_ID, KEY), descriptor=descriptor)
    return NodeDriver(process, controllers_of([scenario(content)]), settings)


@pytest.mark.parametrize(
    ("commands", "line"),
    [
        ("exit 3", "the program has ended: exit status 3; a node of this version says"),
        ("kill -SEGV $$", "the program has ended: killed by SIGSEGV; a node of this version says"),
        ("echo noack node 7 8", "says 'noack node 7 8'; a node of this version says"),
    ],
)
def test_a_program_that_is_no_node_is_refused(
    commands: str, line: str, tmp_path: Path, content: dict[str, Any]
) -> None:
    (error,) = lines_of_error(lambda: driver_of(script(tmp_path, commands), content).__enter__())
    assert error.startswith(f"controller.file (node): {line}")


def test_a_run_with_a_program_that_cannot_be_started_is_refused_in_one_line(tmp_path: Path) -> None:
    (program := tmp_path / "node").touch(0o600)
    for file, line in (
        (tmp_path / "none", "cannot be read: No such file or directory"),
        (program, "cannot be started: Permission denied; it must be executable"),
    ):
        runs = ("--json", "--runs", tmp_path / "runs", *live.BARE)
        result = invoke("run", "lane_following", *runs, *options_for(file))
        assert result.exit_code == 2, result.stderr
        error = json.loads(result.stdout)["error"]
        assert line in error
        assert "\n" not in error


def test_a_frame_that_no_node_sends_is_named(tmp_path: Path, content: dict[str, Any]) -> None:
    program = script(tmp_path, f"echo {GREETING}; head -c 64 /dev/zero; exec cat >/dev/null")
    clock = RunClock(time.monotonic_ns())
    with bind(0, "test") as endpoint, driver_of(program, content) as driver:
        driver.set_clock(clock)
        own = endpoint.getsockname()
        sockets = LoopSockets(endpoint, driver, SENDS["controller"], source=own, destination=own)

        def drive() -> None:
            while True:
                driver.drive(clock.now_ns() + 10_000_000, Rows())

        with closing(sockets), pytest.raises(PeerError, match=r"\(node\): has sent a frame of kind 0 and 0"):
            drive()


def test_a_program_that_sends_no_ticks_is_named(tmp_path: Path) -> None:
    program = script(tmp_path, f"echo {GREETING}; exec cat >/dev/null")
    finished = live.run_scenario(tmp_path / "runs", *options_for(program, horizon_s=3.0))
    assert finished.status == 1
    assert "controller.file (node): has sent 0 ticks, and is" in finished.summary["exit"]["reason"]
