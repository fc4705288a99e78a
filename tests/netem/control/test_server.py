"""Control of a running emulator over real zenoh on loopback, and how commands find it."""

import stat
import threading
from typing import Any

import pytest
from zenoh.handlers import FifoChannel

from netem.control import control_server
from netem.control.control_server import EMULATORS, ControlServer, find, published, running
from netem.control.emulator_commands import Client
from netem.control.emulator_statistics import CommandQueue
from netem.tc_words import settings_of
from noack.core.errors import CallerError
from noack.runtime.control_plane import open_session
from tests.netem.control.relays import FakeRelay


@pytest.fixture
def client(server: ControlServer) -> Any:
    with Client(find("lab")) as client:
        yield client


def test_a_session_is_found_while_it_lasts() -> None:
    """Its file is private, and is not removed if another emulator has replaced it."""
    with pytest.raises(CallerError, match="no emulator accepts commands; start one"):
        find(None)
    with published("lab") as path:
        assert running() == ["lab"]
        assert find("lab") == find(None) == "lab"
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
        with published("b"):
            with pytest.raises(CallerError, match=r"which emulator\? Running: b, lab"):
                find(None)
            with pytest.raises(CallerError, match="no emulator 'lba'; running: b, lab"):
                find("lba")
        other = path.with_name("other")
        other.write_text("mine")
        other.replace(path)
    assert path.read_text() == "mine"
    with pytest.raises(FileExistsError, match="capture"), published("d"):
        raise FileExistsError("capture.pcapng")  # an error of the emulator itself
    assert running() == []


@pytest.mark.parametrize("name", ["", "a/b", "../up", ".hidden", "x" * 65])
def test_unfit_names_are_refused(name: str) -> None:
    with pytest.raises(CallerError, match="use letters, digits"), published(name):
        pass


def test_statistics_are_published(
    relay: FakeRelay, commands: CommandQueue, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control_server, "_PUBLISH_S", 0.2)
    relay.counters["up", "forward"].received = 1
    with ControlServer("lab", commands), Client(find("lab")) as client:
        published = (document["links"][0]["forward"] for document in client.follow(lambda: False))
        first = next(published)["received"]
        relay.counters["up", "forward"].received = 1001
        # The server may have sampled the counters just before the change.
        assert next(published)["received"] - first in (0, 1000)
        recent = next(published)["recent"]
        assert recent is not None
        assert recent["seconds"] > 0


def test_words_may_be_a_list_and_settings_an_object(relay: FakeRelay, client: Client) -> None:
    client.ask("change", link="up", direction="reverse", words=["loss", "5%"])
    assert relay.settings["up", "reverse"] == settings_of("loss 5%")
    table = settings_of("delay 1ms mansd 3").model_dump(mode="json")
    client.ask("change", link="up", direction="reverse", settings=table)
    assert relay.settings["up", "reverse"] == settings_of("delay 1ms mansd 3")


MISTAKES = [
    ({"link": "up", "words": "lozz 5%"}, "lozz: .*loss"),
    ({"link": "up", "words": "loss 5% seed 3"}, "seed 3: belongs to the link"),
    ({"link": "up", "words": "loss trace /etc/passwd"}, "/etc/passwd: read the file first"),
    ({"words": "loss 5%"}, "which link. Links: up, down"),
    ({"link": "left", "words": "loss 5%"}, "no link 'left'; links: up, down"),
    ({"link": "up"}, "give words, or settings"),
    ({"link": "up", "words": "loss 5%", "settings": {}}, "give words, or settings"),
    ({"link": "up", "words": "loss 5%", "direction": "left"}, "direction: should be 'forward'"),
    ({"link": "up", "settings": {"mansd": -1}}, "settings.mansd: should be greater than"),
    ({"link": "up", "words": 5}, "words"),
    ({"link": "up", "words": "loss 5%", "wordz": 1}, "wordz"),
]


def test_a_mistake_gets_one_line_and_changes_nothing(relay: FakeRelay, client: Client) -> None:
    for content, message in MISTAKES:
        with pytest.raises(CallerError, match=message) as caught:
            client.ask("change", **content)
        assert "\n" not in str(caught.value)
    with open_session(EMULATORS, "lab", listen=False) as connection:
        for payload in ("{", "[]", "null", b"\xff\xfe"):
            replies = connection.get(
                "netem/lab/change", FifoChannel(4), payload=payload, timeout=60
            )
            (error,) = [reply.err for reply in replies if reply.err is not None]
            assert error.payload.to_string() == "a query is a JSON object"
    assert relay.changes == 0


def test_a_second_server_of_the_name_is_refused(server: ControlServer) -> None:
    with pytest.raises(CallerError, match=r"^--control lab: an emulator of this name runs"):
        ControlServer("lab", CommandQueue(FakeRelay("up"))).__enter__()
    assert running() == ["lab"]


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
