import threading

import pytest

from netem.control.emulator_statistics import CommandQueue
from netem.tc_words import settings_of
from noack.core.errors import CallerError, PeerError
from tests.netem.control.relays import FakeRelay


def test_the_relay_is_accessed_from_its_own_thread_only(
    relay: FakeRelay, commands: CommandQueue
) -> None:
    commands.snapshot()
    commands.change("up", ["forward"], settings_of("loss 50%"))
    (thread,) = relay.threads
    assert thread != threading.get_ident()


def test_an_error_of_a_command_is_raised_at_its_caller(commands: CommandQueue) -> None:
    def refuse() -> None:
        raise CallerError("no")

    def expire() -> None:
        raise TimeoutError("its own")

    with pytest.raises(CallerError, match="no"):
        commands.submit(refuse)
    with pytest.raises(TimeoutError, match="its own"):
        commands.submit(expire)
    assert commands.submit(lambda: 7) == 7


def test_a_command_fails_at_once_if_the_relay_has_ended(relay: FakeRelay) -> None:
    commands = CommandQueue(relay)
    found: list[BaseException] = []

    def ask() -> None:
        try:
            commands.snapshot()
        except PeerError as error:
            found.append(error)

    asker = threading.Thread(target=ask)
    asker.start()
    while asker.is_alive():
        commands.close()  # before or after the thread submits its command
    assert [str(error) for error in found] == ["the emulator has ended"]
    assert commands.look().links[0].name == "up"


def test_a_command_to_a_stuck_relay_times_out(
    relay: FakeRelay, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("netem.control.emulator_statistics._PATIENCE_S", 0.01)
    commands = CommandQueue(relay)
    with pytest.raises(PeerError, match="has not answered for"):
        commands.snapshot()
    commands.run_pending()  # commands that have timed out do not run
    assert relay.threads == set()
