"""Commands of other threads reach a relay, or fail in time."""

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from netem.control.command_queue import CommandQueue
from netem.core.errors import CallerError, PeerError
from netem.tc_words import settings_of
from tests.netem.control.fake_relay import FakeRelay


def test_commands_run_in_the_thread_of_the_relay(relay: FakeRelay, commands: CommandQueue) -> None:
    """Their errors are raised at their callers."""
    commands.snapshot()
    commands.change("up", {"forward": settings_of("loss 50%")})
    (thread,) = relay.threads
    assert thread != threading.get_ident()
    for error in (CallerError("no"), TimeoutError("its own")):

        def refuse(error: Exception = error) -> None:
            raise error

        with pytest.raises(type(error), match=str(error)):
            commands.submit(refuse)
    assert commands.submit(lambda: 7) == 7


def test_a_command_fails_at_once_if_the_relay_has_ended(relay: FakeRelay) -> None:
    commands = CommandQueue(relay)
    with ThreadPoolExecutor() as threads:
        asked = threads.submit(commands.snapshot)
        while not asked.done():
            commands.close()  # before or after the thread submits its command
    assert str(asked.exception()) == "the emulator has ended"
    assert commands.snapshot_here().links[0].name == "up"


def test_a_command_to_a_stuck_relay_times_out(relay: FakeRelay, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("netem.control.command_queue._PATIENCE_S", 0.01)
    commands = CommandQueue(relay)
    with pytest.raises(PeerError, match="has not answered for"):
        commands.snapshot()
    commands.run_pending()  # commands that have timed out do not run
    assert relay.threads == set()
