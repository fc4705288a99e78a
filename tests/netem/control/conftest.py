from collections.abc import Iterator
from pathlib import Path

import pytest

from netem.control.command_queue import CommandQueue
from netem.control.control_server import ControlAddresses, control_server
from tests.netem.control.fake_relay import FakeRelay, running


@pytest.fixture(autouse=True)
def runtime_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A separate runtime directory for the test, without other emulators."""
    folder = tmp_path / "runtime"
    folder.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    return folder


@pytest.fixture
def relay() -> FakeRelay:
    return FakeRelay("up", "down")


@pytest.fixture
def commands(relay: FakeRelay) -> Iterator[CommandQueue]:
    """The command queue of a running relay."""
    with running(relay) as commands:
        yield commands


@pytest.fixture
def server(commands: CommandQueue) -> Iterator[ControlAddresses]:
    """The control server of an emulator named ``lab``."""
    with control_server("lab", commands) as addresses:
        yield addresses
