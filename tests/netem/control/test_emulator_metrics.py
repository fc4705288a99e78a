"""What runs beside a relay: metrics, statistics, commands. prometheus_client reads the metrics."""

import io
import json
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, redirect_stderr
from pathlib import Path

import pytest

from netem import relay_watch
from netem.control.command_queue import CommandQueue
from netem.control.control_server import running_emulators
from netem.control.emulator_metrics import EmulatorMetrics, metrics
from netem.control.emulator_statistics import statistics
from netem.relay_watch import watch_relay
from noack.core.errors import CallerError
from noack.runtime.address import address_text
from noack.runtime.connections import metrics_server as servers
from tests.helpers.metrics_readers import exposed, read, slow_reader, values_of
from tests.helpers.waiting import wait_for
from tests.netem.control.fake_relay import FakeRelay, options, press_q, read_until, terminal


class Fixed:
    def __init__(self, collect: Callable[[], object]) -> None:
        self.collect = collect


def test_metrics_are_the_statistics(relay: FakeRelay) -> None:
    counters = relay.counters["up", "forward"]
    counters.received, counters.dropped, counters.delivered = 10, 3, 7
    commands = CommandQueue(relay)
    document = statistics(commands.snapshot_here())
    values = values_of(exposed(Fixed(lambda: metrics(document))))
    assert values["noack_netem_received_datagrams_total,forward,up"] == 10
    assert values["noack_netem_datagrams_total,dropped,forward,up"] == 3
    assert values["noack_netem_loss_ratio,forward,up"] == pytest.approx(0.3)
    limit = document["links"][0]["forward"]["mansd"]
    assert values.get("noack_netem_loss_burst_limit,forward,up") == limit
    assert values["noack_netem_elapsed_seconds"] == document["elapsed_s"]
    unintended = document["links"][0]["forward"]["unintended"]
    for cause, count in unintended.items():
        labels = ",".join(sorted([cause, "forward", "up"]))
        assert values[f"noack_netem_unintended_losses_total,{labels}"] == count
    commands.close()
    assert list(EmulatorMetrics(commands).collect()) == []  # of a relay that has ended


def test_an_emulator_serves_its_metrics_and_ends_beside_a_slow_reader(
    relay: FakeRelay, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    threads = threading.active_count()
    monkeypatch.setattr(servers, "_REQUEST_S", 3600.0)
    asked: list[tuple[str, int]] = []
    monkeypatch.setattr(relay_watch, "address_text", lambda at: asked.append(at) or address_text(at))
    with (
        ExitStack() as stack,
        watch_relay(relay, options("--metrics", ":0")) as side,
        ThreadPoolExecutor() as pool,
    ):
        stack.enter_context(slow_reader(asked[0]))
        relay.counters["up", "forward"].received = 4
        reading = pool.submit(read, asked[0])
        wait_for(lambda: side.commands.run_pending() or reading.done())
        values = values_of(reading.result())
    assert threading.active_count() == threads
    assert values["noack_netem_received_datagrams_total,forward,up"] == 4
    assert capfd.readouterr().err == f"noack netem: metrics: http://127.0.0.1:{asked[0][1]}/metrics\n"


def test_invalid_options_are_refused_before_the_relay_runs(relay: FakeRelay) -> None:
    for period in ("0", "-1", "nan", "inf", "0.001"):
        with pytest.raises(CallerError, match=r"must be 0\.01 s or more"):
            options("--stats", period)
    with pytest.raises(CallerError, match="both use standard output"):
        options("--stats", "1", "--view")
    nowhere = options("--stats-file", "/nowhere/x")
    with (
        pytest.raises(CallerError, match=r"--stats-file /nowhere/x: cannot be written \(No such"),
        watch_relay(relay, nowhere),
    ):
        pass


def test_attachments_end_with_the_relay(relay: FakeRelay, tmp_path: Path) -> None:
    """Even if the relay ends before the first command."""
    threads = threading.active_count()
    file = tmp_path / "lines"
    interval = sys.getswitchinterval()
    with watch_relay(
        relay, options("--control", "lab", "--stats", "0.01", "--stats-file", str(file))
    ) as side:
        assert running_emulators() == ["lab"]
        assert sys.getswitchinterval() < interval
        for _ in range(3):
            side.commands.run_pending()
        relay.counters["up", "forward"].received = 5
        assert side.commands.snapshot_here().links[0].forward.counters.received == 5
    assert running_emulators() == []
    assert threading.active_count() == threads
    assert sys.getswitchinterval() == interval
    last = file.read_text().splitlines()[-1]
    assert json.loads(last)["links"][0]["forward"]["received"] == 5


def test_a_full_disk_is_reported_and_the_relay_continues(relay: FakeRelay) -> None:
    error = io.StringIO()
    with (
        redirect_stderr(error),
        watch_relay(relay, options("--stats", "0.01", "--stats-file", "/dev/full")) as side,
    ):
        wait_for(lambda: side.commands.run_pending() or error.getvalue().endswith("\n"))
    assert "cannot be written to /dev/full (No space left" in error.getvalue()


def test_the_view_shows_the_relay_and_later_messages_until_q(
    relay: FakeRelay, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    relay.counters["up", "forward"].received = 7
    with terminal(monkeypatch) as user:
        with ThreadPoolExecutor() as threads:
            drawn = threads.submit(press_q, user, "q ends", "→ up", "a message")
            with watch_relay(relay, options("--view")) as side:
                print("a message", file=sys.stderr)
                wait_for(lambda: side.commands.run_pending() or side.quit_requested)
            assert drawn.exception() is None
        read_until(user, lambda text: "forward →" in text.partition("\x1b[?1049l")[2])
    assert capsys.readouterr().err == "a message\n"
