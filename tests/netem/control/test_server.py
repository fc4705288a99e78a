"""Control of running emulators by HTTP: routes, mistakes, and the commands that use them."""

import http.client
import json
import os
import signal
import socket
import stat
import subprocess
import sys
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from netem.control import emulator_commands
from netem.control.command_queue import CommandQueue
from netem.control.control_client import Client
from netem.control.control_routes import ControlRoutes
from netem.control.control_server import ControlAddresses, control_server
from netem.control.running_emulators import find_emulator, registered_emulator, running_emulators, starting
from netem.core.errors import CallerError, ExitStatus, PeerError
from netem.tc_words import settings_of
from tests.helpers.approved import compare_lines
from tests.netem.control.fake_relay import FakeRelay
from tests.netem.control.http_requests import request, unix


@pytest.fixture
def client(server: ControlAddresses) -> Client:
    return Client(find_emulator("lab"))


def test_an_emulator_is_found_while_it_runs() -> None:
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


def test_an_emulator_that_starts_is_not_asked_before_its_socket_is_there() -> None:
    with starting("lab"), registered_emulator("lab"), pytest.raises(PeerError, match="'lab' is starting"):
        find_emulator("lab")


def test_the_socket_is_its_users_and_is_removed(commands: CommandQueue, runtime_dir: Path) -> None:
    with control_server("lab", commands) as addresses:
        assert addresses.socket.parent.is_relative_to(runtime_dir)
        assert stat.S_IMODE(addresses.socket.stat().st_mode) == 0o600
        with (
            pytest.raises(CallerError, match="--control lab: an emulator of this name runs"),
            control_server("lab", commands),
        ):
            pass
        assert request(unix(addresses), "GET", "/stats").status == 200
    assert list(addresses.socket.parent.iterdir()) == []
    with pytest.raises(PeerError, match="emulator 'lab' has ended"):
        Client("lab").links()


KILLED = """
import os, signal
from netem.control.control_server import TcpAccess, control_server
from tests.netem.control.fake_relay import FakeRelay, running
with running(FakeRelay("up")) as commands, control_server("lab", commands, TcpAccess(0)):
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_killed_emulator_left_is_removed(commands: CommandQueue, runtime_dir: Path) -> None:
    folder = runtime_dir / f"noack-{os.getuid()}" / "netem"
    for _ in range(2):
        assert subprocess.run([sys.executable, "-c", KILLED], check=False).returncode == -signal.SIGKILL
        assert {path.name for path in folder.iterdir()} == {"lab.json", "lab.sock", "lab.token"}
    assert running_emulators() == []
    assert list(folder.iterdir()) == []
    assert subprocess.run([sys.executable, "-c", KILLED], check=False).returncode == -signal.SIGKILL
    with control_server("lab", commands) as addresses:
        assert request(unix(addresses), "GET", "/links").status == 200


def test_a_socket_without_its_file_is_replaced(commands: CommandQueue, runtime_dir: Path) -> None:
    with control_server("lab", commands) as addresses:
        pass
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(addresses.socket))
    with control_server("lab", commands):
        assert request(unix(addresses), "GET", "/links").status == 200


def test_links_are_shown_and_changed(relay: FakeRelay, server: ControlAddresses) -> None:
    links = request(unix(server), "GET", "/links").document["links"]
    assert [link["name"] for link in links] == ["up", "down"]
    assert (links[0]["listen"], links[0]["to"]) == ("127.0.0.1:5000", "[::1]:6000")
    assert links[0]["forward"]["words"] == "loss 10% delay 10ms mansd 2"
    assert request(unix(server), "GET", "/links/up").document == links[0]
    answer = request(unix(server), "PATCH", "/links/up", '{"forward": "loss 5% mansd 4"}')
    assert answer.document["forward"]["words"] == "loss 5% mansd 4"
    assert answer.document["reverse"] == links[0]["reverse"]
    assert relay.settings["up", "forward"] == settings_of("loss 5% mansd 4")
    assert relay.changes == 1
    tables = {"forward": links[0]["forward"]["settings"], "reverse": {"mansd": 3}}
    answer = request(unix(server), "PATCH", "/links/%75p", json.dumps(tables))
    assert answer.document["reverse"]["words"] == "mansd 3"
    assert relay.settings["up", "forward"] == settings_of("loss 10% delay 10ms mansd 2")
    assert relay.changes == 3
    assert request(unix(server), "GET", "/links/down").document == links[1]


def test_statistics_have_recent_rates(relay: FakeRelay, server: ControlAddresses, client: Client) -> None:
    relay.counters["up", "forward"].received = 12
    document = request(unix(server), "GET", "/stats").document
    assert document["links"][0]["forward"]["received"] == 12
    statistics = (document["links"][0]["forward"] for document in client.follow(period_s=0.01))
    recent = next(side["recent"] for side in statistics if side["recent"] is not None)
    assert recent["seconds"] > 0


def test_a_mistake_gets_the_approved_line_and_changes_nothing(
    relay: FakeRelay, commands: CommandQueue, server: ControlAddresses, capsys: pytest.CaptureFixture[str]
) -> None:
    routes = ControlRoutes(commands, lambda: None)  # type: ignore[arg-type, return-value]

    def mistake(line: str) -> list[str]:
        if line.split()[0].islower():
            assert run(line) == ExitStatus.CALLER
            return capsys.readouterr().err.splitlines()
        method, path, body = (*line.split(" ", 2), "")[:3]
        answer = routes.answer(method, path, body.encode())
        assert answer.content.count("\n") == 1
        assert json.loads(answer.content).keys() == {"error"}
        return [f"{int(answer.status)} {line}" for line in json.loads(answer.content)["error"].splitlines()]

    compare_lines(Path(__file__).with_name("mistakes.txt"), mistake)
    answer = routes.answer("PATCH", "/links/up", b"\xff\xfe")
    assert answer.status == 400
    assert relay.changes == 0


def test_an_internal_error_is_reported_and_the_server_continues(
    server: ControlAddresses,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    with monkeypatch.context() as context:
        context.setattr("netem.control.control_routes._link_document", lambda *_: 1 / 0)
        answer = request(unix(server), "GET", "/links")
    assert answer.status == 500
    assert "ZeroDivisionError" in answer.document["error"]
    assert "Traceback" in capfd.readouterr().err
    assert request(unix(server), "GET", "/links").status == 200


def test_a_relay_that_has_ended_is_reported(commands: CommandQueue, server: ControlAddresses) -> None:
    commands.close()
    answer = request(unix(server), "GET", "/stats")
    assert (answer.status, answer.document) == (503, {"error": "the emulator has ended"})
    with pytest.raises(PeerError, match="the emulator has ended"):
        Client("lab").statistics()


def test_a_client_that_blocks_the_statistics_blocks_neither_the_relay_nor_other_clients(
    commands: CommandQueue, server: ControlAddresses, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocked, free = threading.Event(), threading.Event()

    def slow(*_: Any) -> dict[str, int]:
        blocked.set()
        assert free.wait(60)
        return {}

    monkeypatch.setattr("netem.control.emulator_statistics.statistics", slow)
    with ThreadPoolExecutor() as threads:
        asked = threads.submit(request, unix(server), "GET", "/stats")
        try:
            assert blocked.wait(60)
            for _ in range(10):
                commands.snapshot()  # runs in the relay's thread
                assert request(unix(server), "GET", "/links").status == 200
        finally:
            free.set()
        assert asked.result().status == 200


def test_the_client_says_that_an_emulator_does_not_answer(
    server: ControlAddresses, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(error: Exception) -> None:
        def connect(_: http.client.HTTPConnection) -> None:
            raise error

        monkeypatch.setattr("netem.control.control_client._UnixConnection.connect", connect)

    for error, message in (
        (TimeoutError(), "does not answer"),
        (ConnectionResetError(), "has ended"),
        (OSError("too many"), "cannot be reached: too many"),
    ):
        refuse(error)
        with pytest.raises(PeerError, match=f"emulator 'lab' {message}"):
            client.links()


def run(arguments: str) -> ExitStatus:
    return emulator_commands.main(arguments.split())


def test_show_prints_the_statistics(
    relay: FakeRelay, server: ControlAddresses, capsys: pytest.CaptureFixture[str]
) -> None:
    relay.counters["up", "forward"].received = relay.counters["up", "forward"].dropped = 12
    assert run("show") == run("show lab") == ExitStatus.OK
    out = capsys.readouterr().out
    assert "up forward  received 12" in out
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


@pytest.mark.usefixtures("server")
def test_set_sends_the_content_of_files(
    relay: FakeRelay,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "losses.txt").write_text("0\n1\n0\n0\n")
    monkeypatch.chdir(tmp_path)
    assert run("set lab --link up --json loss trace losses.txt") == ExitStatus.OK
    document = json.loads(capsys.readouterr().out)["links"][0]["forward"]
    assert document["settings"]["impairments"][0]["loss"]["model"] == "scripted"
    assert relay.settings["up", "forward"].impairments[0].loss.lost == (1,)  # type: ignore[union-attr]


def test_watch_prints_lines_to_a_pipe_until_its_reader_closes_it(
    relay: FakeRelay, server: ControlAddresses, monkeypatch: pytest.MonkeyPatch
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
