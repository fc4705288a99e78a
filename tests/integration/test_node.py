"""A controller that is a program of its own: native/examples/controller_node.c, and bad ones."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import psutil
import pytest

from cosim.record.run_record import load_record
from native.build import NO_COMPILER
from tests.command_line import invoke
from tests.integration import conftest as live
from tests.integration.test_restarts import goes_on, spooled

Start = Callable[..., live.Running]
BUILD = Path(__file__).parents[2] / "native" / "build.py"
GREETING = "noack node 1 512"
EMULATED, TARGET = "arm", "arm-linux-musleabihf"
"""A processor of 32 bits that qemu-user emulates; ziglang builds a C library for it, for a minute."""


def built(folder: Path, **environment: str) -> Path:
    """Build the example for this machine, or by the compiler in CC; skip without a compiler."""
    program = folder / "controller_node"
    done = subprocess.run(
        [sys.executable, BUILD, "--node", program], check=False, env=os.environ | environment
    )
    if done.returncode == NO_COMPILER:
        pytest.skip("there is no C compiler")
    assert done.returncode == 0
    return program


def by(program: Path, *runner: str, **more: object) -> list[str]:
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


@pytest.mark.parametrize("processor", ["own", EMULATED])
def test_a_program_takes_part_in_a_live_run_and_is_replayed(processor: str, tmp_path: Path) -> None:
    """The same steps, whatever the processor: the replay has the bits of the library's core."""
    if processor == "own":
        options = by(built(tmp_path), horizon_s=3.0)
    else:
        if shutil.which(f"qemu-{processor}") is None:
            pytest.skip("qemu-user is not installed")
        if find_spec("ziglang") is None:
            pytest.skip("ziglang is not installed")
        compiler = f"{sys.executable} -m ziglang cc -target {TARGET} -static"
        options = by(built(tmp_path, CC=compiler), f"qemu-{processor}", horizon_s=3.0)
    finished = live.run_scenario(tmp_path / "runs", *options)
    assert finished.status == 0, finished.stderr
    live.assert_complete(finished.loop)
    record = load_record(finished.run_dir)
    channel = json.loads((finished.run_dir / "reports.json").read_text())["controller"]["channel"]
    assert channel["sent"] == len(record["controller_step"]) == 3 * live.RATE_HZ
    assert channel["accepted"] == len(record["controller_delivery"]) > 0
    assert channel["rejected"] == channel["send_errors"] == {}
    assert (finished.run_dir / "logs" / "controller.log").read_text() == ""


def test_a_killed_program_ends_the_run_and_its_rows_are_kept(start: Start, tmp_path: Path) -> None:
    running = start(*by(built(tmp_path), speed=4.0, horizon_s=400.0))
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


def test_a_stopped_program_ends_with_its_process_and_another_goes_on(start: Start, tmp_path: Path) -> None:
    """A program that is stopped does not see the end of its input."""
    options = by(built(tmp_path), speed=2.0, horizon_s=60.0, recovery__rejoin_within_s=60.0)
    running = start(*options)
    running.wait_recording()
    live.wait_for(lambda: len(spooled(running, "controller_delivery")) > 0)
    program = program_of(running)
    program.send_signal(signal.SIGSTOP)
    running.child("controller").kill()
    live.wait_for(lambda: live.is_over(program))
    live.wait_for(lambda: goes_on(running, "controller"))
    running.process.send_signal(signal.SIGINT)
    finished = running.finish()
    assert finished.loop["replay"]["bit_exact"], finished.loop["replay"]
    assert running.left_behind() == []


@pytest.mark.parametrize(
    ("script", "line"),
    [
        (None, "cannot be read: No such file or directory"),
        ("not executable", "cannot be started: Permission denied; it must be executable"),
        ("exit 3", "the program has ended: exit status 3; a node of this version says"),
        ("kill -SEGV $$", "the program has ended: killed by SIGSEGV; a node of this version says"),
        ("echo noack node 7 8", "says 'noack node 7 8'; a node of this version says"),
    ],
)  # fmt: skip
def test_what_is_no_node_is_refused_in_one_line(script: str | None, line: str, tmp_path: Path) -> None:
    program = tmp_path / "node"
    if script is not None:
        program.write_text(f"#!/bin/sh\n{script}\n")
        program.chmod(0o600 if script == "not executable" else 0o700)
    runs = ("--json", "--runs", tmp_path / "runs", *live.BARE)
    done = invoke("run", "lane_following", *runs, *by(program))
    assert done.exit_code == 2, done.stderr
    error = json.loads(done.stdout)["error"]
    assert line in error
    assert "\n" not in error


@pytest.mark.parametrize(
    ("sends", "line"),
    [
        ("head -c 64 /dev/zero", "has sent a frame of kind 0 and 0 bytes"),
        ("true", "has sent 0 ticks, and is"),
    ],
)
def test_a_program_that_breaks_the_protocol_is_named(sends: str, line: str, tmp_path: Path) -> None:
    program = tmp_path / "node"
    program.write_text(f"#!/bin/sh\necho {GREETING}; {sends}; exec cat >/dev/null\n")
    program.chmod(0o700)
    finished = live.run_scenario(tmp_path / "runs", *by(program, horizon_s=3.0))
    assert finished.status == 1
    assert f"controller.file (node): {line}" in finished.summary["exit"]["reason"]


def test_what_a_program_has_started_ends_with_the_run(tmp_path: Path) -> None:
    """Also while it keeps the program's stream open."""
    node, program, number = built(tmp_path), tmp_path / "node", tmp_path / "number"
    program.write_text(f"#!/bin/sh\nsleep 600 & echo $! >{number}; exec {node}\n")
    program.chmod(0o700)
    finished = live.run_scenario(tmp_path / "runs", *by(program, horizon_s=1.0))
    assert finished.status == 0, finished.stderr
    with suppress(psutil.NoSuchProcess):
        live.wait_for(lambda: live.is_over(psutil.Process(int(number.read_text()))))
