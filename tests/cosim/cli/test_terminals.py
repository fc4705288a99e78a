"""Pipes, terminals, and readers that close the pipe early."""

import io
import os
import pty
import re
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cosim.cli import app
from cosim.cli.command import pipe_safe_stream

NOACK = (sys.executable, "-m", "cosim.cli")
ROOT = Path(__file__).parents[3]
PATIENCE_S = 300.0
SIMULATE = ("simulate", "double_integrator", "--set", "horizon_s=1", "--no-report")
COMMANDS = (("--help",), ("certify", "--help"), ("check", "lane_following"), SIMULATE)
COLOUR = re.compile(r"\x1b\[[0-9;]*\b(3[0-8]|4[0-8]|9[0-7]|10[0-7])[0-9;]*m")


def environment(**more: str) -> dict[str, str]:
    """The tests' environment without variables that concern terminals and colours."""
    concerned = ("NO_COLOR", "FORCE_COLOR", "PY_COLORS", "TTY_COMPATIBLE", "TTY_INTERACTIVE",
                 "GITHUB_ACTIONS", "COLUMNS", "TERM", "COLORTERM")  # fmt: skip
    others = {name: value for name, value in os.environ.items() if name not in concerned}
    return others | {"TERM": "xterm-256color", "PYTHONPATH": str(ROOT)} | more


def on_a_terminal(*arguments: str, cwd: Path, **more: str) -> str:
    """A command's output with both streams connected to a terminal."""
    reading, writing = pty.openpty()
    command = [*NOACK, *arguments]
    with subprocess.Popen(
        command, cwd=cwd, stdin=writing, stdout=writing, stderr=writing, env=environment(**more)
    ) as process:
        os.close(writing)
        output = b""
        with open(reading, "rb", buffering=0) as file, suppress(OSError):  # noqa: PTH123
            while block := file.read(4096):
                output += block
        assert process.wait(PATIENCE_S) == 0, output.decode()
    return output.decode()


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_pipes_receive_plain_text_only(
    command: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0
    for output in (done.stdout, done.stderr):
        assert all(one.isprintable() or one == "\n" for one in output)
    assert "simulated" not in done.stderr


def test_a_terminal_receives_colours_unless_they_are_disabled(tmp_path: Path) -> None:
    assert COLOUR.search(on_a_terminal("check", "lane_following", cwd=tmp_path))
    assert not COLOUR.search(on_a_terminal("check", "lane_following", cwd=tmp_path, NO_COLOR="1"))


def test_a_dumb_terminal_receives_no_control_characters(tmp_path: Path) -> None:
    output = on_a_terminal(*SIMULATE, cwd=tmp_path, TERM="dumb")
    assert all(one.isprintable() or one in "\r\n" for one in output), output


@pytest.mark.parametrize("command", [("schema",), SIMULATE], ids=" ".join)
def test_a_closed_pipe_is_not_an_error(command: tuple[str, ...], tmp_path: Path) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        [*NOACK, *command], cwd=tmp_path, env=environment(), stdout=writing,
        stderr=subprocess.PIPE, check=False,
    )  # fmt: skip
    os.close(writing)
    assert (done.returncode, done.stderr) == (0, b"")


def test_the_exit_status_does_not_depend_on_the_reader(tmp_path: Path) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    command = [*NOACK, "certify", "no_such_scenario", "--json"]
    done = subprocess.run(
        command, cwd=tmp_path, env=environment(), stdout=writing, stderr=writing, check=False
    )
    os.close(writing)
    assert done.returncode == 2


@pytest.mark.parametrize(("line_buffering", "write_through"), [(True, False), (False, True)])
def test_a_line_is_written_at_once(line_buffering: bool, write_through: bool) -> None:
    """``PYTHONUNBUFFERED`` requests ``write_through``."""
    reading, writing = os.pipe()
    os.set_blocking(reading, False)
    with (
        open(writing, "wb") as raw,  # noqa: PTH123
        io.TextIOWrapper(raw, line_buffering=line_buffering, write_through=write_through) as stream,
    ):
        patient = pipe_safe_stream(stream)
        patient.write("waiting\n")
        assert os.read(reading, 100) == b"waiting\n"
    os.close(reading)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
@pytest.mark.parametrize("words", [("scenarios",), ("--help",)])
def test_a_full_disk_gives_one_line(words: tuple[str, ...], tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*NOACK, *words], cwd=tmp_path, env=environment(),
            stdout=full, stderr=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.startswith("noack: cannot write: ")
    assert done.stderr.count("\n") == 1


def test_the_list_is_wrapped_on_a_terminal(tmp_path: Path) -> None:
    wrapped = on_a_terminal("scenarios", cwd=tmp_path, COLUMNS="60", NO_COLOR="1")
    assert max(map(len, wrapped.splitlines())) <= 60
    assert "unstable_pendulum" in wrapped
