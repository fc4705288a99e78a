import io
import json
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stderr
from pathlib import Path

import pytest

from netem.control.control_server import running
from netem.control.emulator_statistics import CommandQueue
from netem.stand_alone import attached
from netem.tc_words import settings_of
from noack.core.errors import CallerError, PeerError
from tests.netem.control.processes import press_q, read_until, terminal
from tests.netem.control.relays import FakeRelay, options


def test_invalid_options_are_refused_before_the_relay_runs(relay: FakeRelay) -> None:
    for period in ("0", "-1", "nan", "inf", "0.001"):
        with pytest.raises(CallerError, match=r"must be 0\.01 s or more"):
            options("--stats", period)
    with pytest.raises(CallerError, match="both use standard output"):
        options("--stats", "1", "--view")
    nowhere = options("--stats-file", "/nowhere/x")
    with (
        pytest.raises(CallerError, match=r"--stats-file /nowhere/x: cannot be written \(No such"),
        attached(relay, nowhere),
    ):
        pass


def test_attachments_end_with_the_relay(relay: FakeRelay, tmp_path: Path) -> None:
    """Even if the relay ends before the first command."""
    threads = threading.active_count()
    file = tmp_path / "lines"
    interval = sys.getswitchinterval()
    with attached(
        relay, options("--control", "lab", "--stats", "0.01", "--stats-file", str(file))
    ) as side:
        assert running() == ["lab"]
        assert sys.getswitchinterval() < interval
        for _ in range(3):
            side.commands.run_pending()
        relay.counters["up", "forward"].received = 5
        assert side.commands.look().links[0].forward.counters.received == 5
    assert running() == []
    assert threading.active_count() == threads
    assert sys.getswitchinterval() == interval
    last = file.read_text().splitlines()[-1]
    assert json.loads(last)["links"][0]["forward"]["received"] == 5


def test_a_full_disk_is_reported_and_the_relay_continues(relay: FakeRelay) -> None:
    error = io.StringIO()
    with (
        redirect_stderr(error),
        attached(relay, options("--stats", "0.01", "--stats-file", "/dev/full")) as side,
    ):
        while not error.getvalue().endswith("\n"):
            side.commands.run_pending()
    assert "cannot be written to /dev/full (No space left" in error.getvalue()


def test_the_view_shows_the_relay_and_later_messages_until_q(
    relay: FakeRelay, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    relay.counters["up", "forward"].received = 7
    with terminal(monkeypatch) as user:
        with ThreadPoolExecutor() as threads:
            drawn = threads.submit(press_q, user, "q ends", "→ up", "a message")
            with attached(relay, options("--view")) as side:
                print("a message", file=sys.stderr)
                late_s = time.monotonic() + 20
                while not side.quit_requested and time.monotonic() < late_s:
                    side.commands.run_pending()
                    time.sleep(0.01)
                assert side.quit_requested
            assert drawn.exception() is None
        read_until(user, lambda text: "forward →" in text.partition("\x1b[?1049l")[2])
    assert capsys.readouterr().err == "a message\n"


def test_commands_run_in_the_thread_of_the_relay(relay: FakeRelay, commands: CommandQueue) -> None:
    """Their errors are raised at their callers."""
    commands.snapshot()
    commands.change("up", ["forward"], settings_of("loss 50%"))
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
