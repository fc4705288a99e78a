"""What runs beside a relay: statistics and commands."""

import io
import json
import sys
import threading
from contextlib import redirect_stderr
from pathlib import Path

from netem.control.running_emulators import running_emulators
from netem.relay_watch import watch_relay
from tests.helpers.waiting import wait_for
from tests.netem.control.fake_relay import FakeRelay, options


def test_attachments_end_with_the_relay(relay: FakeRelay, tmp_path: Path) -> None:
    """Even if the relay ends before the first command."""
    threads = threading.active_count()
    file = tmp_path / "lines"
    interval = sys.getswitchinterval()
    with watch_relay(relay, options("--control", "lab", "--stats", "0.01", "--stats-file", str(file))) as (
        commands,
        control,
    ):
        assert control is not None
        assert control.socket.is_socket()
        assert running_emulators() == ["lab"]
        assert sys.getswitchinterval() < interval
        for _ in range(3):
            commands.run_pending()
        relay.counters["up", "forward"].received = 5
        assert commands.snapshot_here().links[0].forward.counters.received == 5
    assert running_emulators() == []
    assert threading.active_count() == threads
    assert sys.getswitchinterval() == interval
    last = file.read_text().splitlines()[-1]
    assert json.loads(last)["links"][0]["forward"]["received"] == 5


def test_a_full_disk_is_reported_and_the_relay_continues(relay: FakeRelay) -> None:
    error = io.StringIO()
    with (
        redirect_stderr(error),
        watch_relay(relay, options("--stats", "0.01", "--stats-file", "/dev/full")) as (commands, _),
    ):
        wait_for(lambda: commands.run_pending() or error.getvalue().endswith("\n"))
    assert "cannot be written to /dev/full (No space left" in error.getvalue()
