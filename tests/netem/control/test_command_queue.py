import threading

import pytest

from netem.control.command_queue import CommandQueue
from netem.words.words_to_settings import settings_of
from noack.core.errors import CallerError, PeerError
from noack.impairments.link_settings import Counters
from tests.netem.control.relays import FakeRelay


def test_the_relay_is_accessed_from_its_own_thread_only(
    relay: FakeRelay, commands: CommandQueue
) -> None:
    commands.snapshot()
    commands.change("up", ["forward"], settings_of("loss 50%"))
    (thread,) = relay.threads
    assert thread != threading.get_ident()


def test_a_change_returns_the_time_from_which_it_applies(
    relay: FakeRelay, commands: CommandQueue
) -> None:
    relay.counters["up", "reverse"] = Counters(received=17)
    commands.change("up", ["reverse"], settings_of("loss 50% mansd 1"))
    relay.counters["up", "reverse"].received = 20
    in_force = commands.snapshot().in_force
    assert in_force["up", "reverse"].since.received == 17
    assert in_force["up", "reverse"].words == "loss 50% mansd 1"
    assert in_force["up", "forward"].since == Counters()
    assert in_force["up", "forward"].words == "loss 10% delay 10ms mansd 2"


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
    monkeypatch.setattr("netem.control.command_queue._PATIENCE_S", 0.01)
    commands = CommandQueue(relay)
    with pytest.raises(PeerError, match="has not answered for"):
        commands.snapshot()
    commands.run_pending()  # commands that have timed out do not run
    assert relay.threads == set()
