"""Control commands to an emulator in this process."""

import json
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import pytest

from netem.control import emulator_commands
from netem.control.control_server import ControlServer
from netem.control.emulator_statistics import CommandQueue
from netem.control.statistics_view import Screen
from netem.tc_words import settings_of
from noack.core.errors import ExitStatus
from tests.netem.control.processes import press_q, read_until, terminal
from tests.netem.control.relays import FakeRelay, running

LEAVE = "\x1b[?1049l"
"""The escape sequence that leaves a terminal's alternate screen."""


def run(arguments: str) -> ExitStatus:
    return emulator_commands.main(arguments.split())


def test_show_prints_the_statistics(
    relay: FakeRelay, server: ControlServer, capsys: pytest.CaptureFixture[str]
) -> None:
    relay.counters["up", "forward"].dropped = 12
    assert run("show") == run("show lab") == ExitStatus.OK
    out = capsys.readouterr().out
    assert "noack netem lab" in out
    assert "12 dropped" in out
    assert run("show lab --json") == ExitStatus.OK
    document = json.loads(capsys.readouterr().out)
    assert document["links"][0]["forward"]["fates"]["dropped"] == 12


@pytest.mark.parametrize(
    ("arguments", "changed"),
    [
        ("loss 5% --link up mansd 4", ["forward"]),
        ("lab loss 5% mansd 4 --direction reverse --link up", ["reverse"]),
        ("--control lab --link up --direction both loss 5% mansd 4", ["forward", "reverse"]),
    ],
)
@pytest.mark.usefixtures("server")
def test_a_link_is_set_in_words(
    relay: FakeRelay, capsys: pytest.CaptureFixture[str], arguments: str, changed: Sequence[str]
) -> None:
    assert run(f"set {arguments}") == ExitStatus.OK
    assert relay.changes == len(changed)
    wanted = settings_of("loss 5% mansd 4")
    assert {name for (_, name), now in relay.settings.items() if now == wanted} == {*changed}
    out = capsys.readouterr().out.splitlines()
    assert {f"up {name}: loss 5% mansd 4" for name in changed} <= {*out[:2]}
    assert out[2:] == ["down forward: loss 10% delay 10ms mansd 2", "down reverse: no impairment"]


MISTAKES = [
    ("set", "words are missing, for example: loss 5% mansd 4; or: loss none"),
    ("set --link up lozz 5%", "lozz: "),
    ("set --link up loss trace gone", "gone"),
    ("set lba --link up loss 5%", "no emulator 'lba'; running: lab"),
    ("set lab loss 5%", "which link? Links: up, down"),
    ("show lab --control lba", "--control lba: NAME is lab already"),
    ("watch lba", "no emulator 'lba'; running: lab"),
]


@pytest.mark.usefixtures("server")
def test_a_mistake_gets_one_line(relay: FakeRelay, capsys: pytest.CaptureFixture[str]) -> None:
    """And of several emulators, one must be named."""
    for arguments, message in MISTAKES:
        assert run(arguments) == ExitStatus.CALLER
        error = capsys.readouterr().err
        assert error.startswith(f"noack netem {arguments.split()[0]}: ")
        assert error.count("\n") == 1
        assert message in error
    assert relay.changes == 0
    other = FakeRelay("x")
    with running(other) as commands, ControlServer("loss", commands):
        assert run("show") == ExitStatus.CALLER
        assert "which emulator? Running: lab, loss" in capsys.readouterr().err
        assert run("set loss loss 5%") == ExitStatus.OK  # the name is also a netem word
    assert other.settings["x", "forward"] == settings_of("loss 5%")


def test_watch_prints_lines_to_a_pipe_until_its_reader_closes_it(
    relay: FakeRelay, server: ControlServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    relay.counters["up", "forward"].received = 7
    end, pipe = os.pipe()
    lines: list[str] = []

    def read_two() -> None:
        with os.fdopen(end) as reader:
            lines.extend(reader.readline() for _ in range(2))

    with os.fdopen(pipe, "w") as stdout, ThreadPoolExecutor() as threads:
        monkeypatch.setattr(sys, "stdout", stdout)
        reading = threads.submit(read_two)
        assert run("watch lab") == ExitStatus.OK
        reading.result()
    assert all("  up forward  " in line for line in lines)


def test_watch_fails_when_the_emulator_ends(
    relay: FakeRelay,
    commands: CommandQueue,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(emulator_commands, "_SILENCE_S", 0.1)
    relay.counters["up", "forward"].received = 7
    emulator = ControlServer("lab", commands).__enter__()
    monkeypatch.setattr(Screen, "show", lambda *_: emulator.__exit__())
    assert run("watch lab") == ExitStatus.FAILED
    assert capsys.readouterr().err == "noack netem watch: emulator 'lab' has ended\n"


@pytest.mark.usefixtures("server")
def test_watch_redraws_on_a_terminal_until_q(
    relay: FakeRelay, monkeypatch: pytest.MonkeyPatch
) -> None:
    relay.counters["up", "forward"].received = 7
    with terminal(monkeypatch) as user:
        with ThreadPoolExecutor() as threads:
            drawn = threads.submit(press_q, user, "q ends", "→ up")
            assert run("watch") == ExitStatus.OK
        assert LEAVE not in drawn.result()
        # The last screen stays visible.
        read_until(user, lambda text: "╯" in text.partition(LEAVE)[2])
