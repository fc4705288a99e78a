import io
import json
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from netem.control.control_server import running
from netem.stand_alone import attached
from noack.core.errors import CallerError
from tests.netem.control.processes import press_q, read_until, terminal
from tests.netem.control.relays import FakeRelay, options


@pytest.mark.parametrize("period", ["0", "-1", "nan", "inf", "0.001"])
def test_an_invalid_period_is_refused(period: str) -> None:
    with pytest.raises(CallerError, match=r"must be 0\.01 s or more"):
        options("--stats", period)


def test_json_lines_and_view_on_one_terminal_are_refused() -> None:
    with pytest.raises(CallerError, match="both use standard output"):
        options("--stats", "1", "--view")


def test_an_unwritable_file_is_reported_before_the_relay_runs(relay: FakeRelay) -> None:
    with (
        pytest.raises(CallerError, match=r"--stats-file /nowhere/x: cannot be written \(No such"),
        attached(relay, options("--stats-file", "/nowhere/x")),
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


def test_a_full_disk_is_reported_and_the_relay_continues(
    relay: FakeRelay, monkeypatch: pytest.MonkeyPatch
) -> None:
    error = io.StringIO()
    monkeypatch.setattr(sys, "stderr", error)
    with attached(relay, options("--stats", "0.01", "--stats-file", "/dev/full")) as side:
        while not error.getvalue().endswith("\n"):
            side.commands.run_pending()
    assert error.getvalue() == (
        "noack netem: statistics cannot be written to /dev/full "
        "(No space left on device); the relay continues\n"
    )


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
