"""Pipes, terminals, and readers that close the pipe early."""

import io
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from netem.core.standard_streams import guarded_stream

NOACK = (sys.executable, "-m", "cosim.cli")
ROOT = Path(__file__).parents[3]
SIMULATE = (
    "simulate",
    "double_integrator",
    "--set",
    "horizon_s=1",
    "--set",
    "certificate.prove=false",
    "--no-report",
)


def environment(**variables: str) -> dict[str, str]:
    """The tests' environment without variables that concern terminals and colours."""
    concerned = ("NO_COLOR", "FORCE_COLOR", "PY_COLORS", "TTY_COMPATIBLE", "TTY_INTERACTIVE",
                 "GITHUB_ACTIONS", "COLUMNS", "TERM", "COLORTERM")  # fmt: skip
    kept_variables = {name: value for name, value in os.environ.items() if name not in concerned}
    return kept_variables | {"TERM": "xterm-256color", "PYTHONPATH": str(ROOT)} | variables


@pytest.mark.parametrize(
    ("command", "status"),
    [(("schema",), 0), (SIMULATE, 0), (("certify", "no_such_scenario", "--json"), 2)],
)
def test_a_closed_pipe_does_not_change_the_exit_status(
    command: tuple[str, ...], status: int, tmp_path: Path
) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    process = subprocess.run(
        [*NOACK, *command], cwd=tmp_path, env=environment(), stdout=writing,
        stderr=subprocess.PIPE, check=False,
    )  # fmt: skip
    os.close(writing)
    assert process.returncode == status
    complaints = [line for line in process.stderr.splitlines() if not line.endswith(b" s")]  # no progress
    assert status or complaints == []


@pytest.mark.parametrize(("line_buffering", "write_through"), [(True, False), (False, True)])
def test_a_line_is_written_at_once(line_buffering: bool, write_through: bool) -> None:
    """``PYTHONUNBUFFERED`` requests ``write_through``."""
    reading, writing = os.pipe()
    os.set_blocking(reading, False)
    with (
        open(writing, "wb") as raw,  # noqa: PTH123
        io.TextIOWrapper(raw, line_buffering=line_buffering, write_through=write_through) as stream,
    ):
        patient = guarded_stream(stream)
        patient.write("waiting\n")
        assert os.read(reading, 100) == b"waiting\n"
    os.close(reading)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
@pytest.mark.parametrize(
    "words",
    [
        ["cosim.cli", "scenarios"],
        ["cosim.cli", "netem", "set", "--help"],
        ["netem", "--explain", "loss", "5%"],
        ["plant_server", "--help"],
    ],
    ids="-".join,
)
def test_a_full_disk_gives_one_line(tmp_path: Path, words: list[str]) -> None:
    with Path("/dev/full").open("w") as full:
        process = subprocess.run(
            [sys.executable, "-m", *words], cwd=tmp_path, env=environment(),
            stdout=full, stderr=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
    assert process.returncode == 1
    assert re.match("noack[ a-z-]*: cannot write: ", process.stderr)
    assert process.stderr.count("\n") == 1


def test_a_signal_in_the_last_moments_does_not_change_the_exit_status(tmp_path: Path) -> None:
    code = """
import atexit, os, signal, sys
for number in (signal.SIGINT, signal.SIGTERM):
    atexit.register(os.kill, os.getpid(), number)  # as from outside, when Python cleans up
sys.argv = ["noack", "scenarios"]
from cosim.cli import main
main()
"""
    process = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment(),
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (process.returncode, process.stderr) == (0, "")
    assert "lane_following" in process.stdout
