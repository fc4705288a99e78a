"""Control of running emulators over real zenoh on loopback: the server, and the commands."""

import json
import os
import stat
import sys
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from zenoh.handlers import FifoChannel

from netem.control import control_server, emulator_commands
from netem.control.command_queue import CommandQueue
from netem.control.control_server import ControlServer
from netem.control.emulator_commands import Client
from netem.control.running_emulators import EMULATORS, find_emulator, registered_emulator, running_emulators
from netem.control.zenoh_session import open_session
from netem.core.errors import CallerError, ExitStatus
from netem.tc_words import settings_of
from tests.helpers.approved import compare_lines, lines_of_error
from tests.netem.control.fake_relay import FakeRelay


@pytest.fixture
def client(server: ControlServer) -> Any:
    with Client(find_emulator("lab")) as client:
        yield client


def test_a_session_is_found_while_it_lasts() -> None:
    """Its file is private, and is not removed if another emulator has replaced it."""
    with pytest.raises(CallerError, match="no emulator accepts commands; start one"):
        find_emulator(None)
    with registered_emulator("lab") as path:
        assert running_emulators() == ["lab"]
        assert find_emulator("lab") == find_emulator(None) == "lab"
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
        with registered_emulator("b"):
            with pytest.raises(CallerError, match=r"which emulator\? Running: b, lab"):
                find_emulator(None)
            with pytest.raises(CallerError, match="no emulator 'lba'; running: b, lab"):
                find_emulator("lba")
        other = path.with_name("other")
        other.write_text("mine")
        other.replace(path)
    assert path.read_text() == "mine"
    with pytest.raises(FileExistsError, match="capture"), registered_emulator("d"):
        raise FileExistsError("capture.pcapng")  # an error of the emulator itself
    assert running_emulators() == []


def test_statistics_are_published(
    relay: FakeRelay, commands: CommandQueue, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control_server, "_PUBLISH_S", 0.2)
    relay.counters["up", "forward"].received = 1
    with ControlServer("lab", commands), Client(find_emulator("lab")) as client:
        statistics = (document["links"][0]["forward"] for document in client.follow(lambda: False))
        first = next(statistics)["received"]
        relay.counters["up", "forward"].received = 1001
        # The server may have sampled the counters just before the change.
        assert next(statistics)["received"] - first in (0, 1000)
        recent = next(statistics)["recent"]
        assert recent is not None
        assert recent["seconds"] > 0


def test_a_mistake_gets_the_approved_line_and_changes_nothing(
    relay: FakeRelay, client: Client, capsys: pytest.CaptureFixture[str]
) -> None:
    def mistake(line: str) -> list[str]:
        if not line.startswith("{"):
            assert run(line) == ExitStatus.CALLER
            return capsys.readouterr().err.splitlines()
        return lines_of_error(lambda: client.ask("change", **json.loads(line)))

    compare_lines(Path(__file__).with_name("mistakes.txt"), mistake)
    with open_session(EMULATORS, "lab", listen=False) as connection:
        for payload in ("{", "[]", "null", b"\xff\xfe"):
            replies = connection.get("netem/lab/change", FifoChannel(4), payload=payload, timeout=60)
            (error,) = [reply.err for reply in replies if reply.err is not None]
            assert error.payload.to_string() == "a query is a JSON object"
    assert relay.changes == 0


def test_a_client_that_blocks_the_server_does_not_block_the_relay(
    commands: CommandQueue, server: ControlServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocked, free = threading.Event(), threading.Event()

    def slow(*_: Any) -> None:
        blocked.set()
        assert free.wait(60)

    monkeypatch.setattr("netem.control.emulator_statistics.statistics", slow)
    assert blocked.wait(60)
    try:
        for _ in range(10):
            commands.snapshot()  # runs in the relay's thread
    finally:
        free.set()


def run(arguments: str) -> ExitStatus:
    return emulator_commands.main(arguments.split())


def test_show_prints_the_statistics(
    relay: FakeRelay, server: ControlServer, capsys: pytest.CaptureFixture[str]
) -> None:
    relay.counters["up", "forward"].received = relay.counters["up", "forward"].dropped = 12
    assert run("show") == run("show lab") == ExitStatus.OK
    out = capsys.readouterr().out
    assert "up forward  received 12 (" in out
    assert "12 dropped" in out
    assert "down  no datagrams received" in out
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


def test_watch_prints_lines_to_a_pipe_until_its_reader_closes_it(
    relay: FakeRelay, server: ControlServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    relay.counters["up", "forward"].received = 7
    end, pipe = os.pipe()
    lines: list[str] = []

    def read_two() -> None:
        with os.fdopen(end) as reader:
            lines.extend(reader.readline() for _ in range(4))

    with os.fdopen(pipe, "w") as stdout, ThreadPoolExecutor() as threads:
        monkeypatch.setattr(sys, "stdout", stdout)
        reading = threads.submit(read_two)
        assert run("watch lab") == ExitStatus.OK
        reading.result()
    assert [line.split("  ")[1] for line in lines] == ["up forward", "down", "up forward", "down"]
