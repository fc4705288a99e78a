"""The view as text, from the statistics of constructed reports."""

import io
from collections.abc import Sequence

import pytest
from rich.console import Console

from netem.control.emulator_statistics import CommandQueue, Statistics, statistics
from netem.control.statistics_view import History, plain_lines, render
from netem.relay_links import LinkSpec
from netem.tc_words import settings_of
from noack.core.clock import NS_PER_S
from noack.impairments.link_settings import Counters
from tests.netem.control.relays import SETTINGS, FakeRelay, times


def documents(relay: FakeRelay, seconds: int = 3) -> Sequence[Statistics]:
    """In second k, from 0 on, 1000 k datagrams of 100 bytes arrive on each link."""
    commands, found, before = CommandQueue(relay), [], None
    for second in range(seconds):
        for name, side in relay.counters:
            if side == "forward":
                counters = relay.counters[name, side]
                received = 1000 * second
                counters.received += received
                counters.received_bytes += 100 * received
                counters.dropped += received // 5
                counters.forced += received // 10
                counters.delivered += received - received // 5 - received // 10
                counters.forwarded += received - received // 5
                counters.forwarded_bytes += 100 * (received - received // 5)
                counters.longest_loss_burst = 2
        relay.delays = times(*[10_000_000] * 98, 20_000_000, 20_000_000)
        snapshot = commands.look()._replace(elapsed_ns=(second + 1) * NS_PER_S)
        found.append(statistics(snapshot, before))
        before = snapshot
    return found


def text_of(
    relay: FakeRelay, width: int = 80, height: int | None = 24, seconds: int = 3
) -> list[str]:
    history = History()
    for document in documents(relay, seconds):
        history.add(document)
    file = io.StringIO()
    console = Console(file=file, width=width, height=height or 24, color_system=None)
    console.print(render(history, "lab", width, height))
    return file.getvalue().splitlines()


def line_of(lines: Sequence[str], label: str) -> str:
    (line,) = [line for line in lines if line.startswith(f"│ {label} ")]
    return " ".join(line.strip("│ ").split())


def test_a_link_is_shown_with_both_directions() -> None:
    lines = text_of(FakeRelay("up"))
    assert len(lines) <= 24
    assert all(len(line) <= 80 for line in lines)
    assert lines[0].split() == ["lab", "0:03"]
    assert "up  127.0.0.1:5000 → [::1]:6000  1 client" in lines[1]
    assert "loss 10% delay 10ms mansd 2" in lines[3]
    assert "no impairment" in lines[3]
    assert line_of(lines, "received") == "received 2,000/s 1.60 Mbit/s 0/s 0 bit/s"
    assert line_of(lines, "forwarded") == "forwarded 1,600/s 1.28 Mbit/s 0/s 0 bit/s"
    assert line_of(lines, "loss") == "loss 20.0 % –"
    assert line_of(lines, "drawn") == "drawn 20.0 %, predicted 9.91 % –, predicted 0 %"
    assert line_of(lines, "lost") == "lost 600 dropped 0"
    burst = line_of(lines, "burst")
    assert burst.startswith("burst 2, cap 2 ━")
    assert burst.endswith("━ 300 forced 0, no cap")
    assert line_of(lines, "in flight") == "in flight 5, max 0 5, max 0"
    p50, p99 = line_of(lines, "delay").removeprefix("delay p50 ").split(" ms p99 ")[:2]
    assert float(p50) == pytest.approx(10, rel=0.03)
    assert float(p99.split(" ms")[0]) == pytest.approx(20, rel=0.03)


def test_unintended_losses_stand_out() -> None:
    relay = FakeRelay("up")
    relay.unintended["lost_in_kernel"] = 1234
    lines = text_of(relay)
    assert "unintended losses: 1,234 lost in kernel (forward)" in lines[-2]
    file = io.StringIO()
    history = History()
    history.add(documents(relay)[-1])
    Console(file=file, width=80, force_terminal=True, color_system="standard").print(
        render(history, "lab", 80, 30)
    )
    assert "\x1b[1;37;41munintended losses" in file.getvalue()


@pytest.mark.parametrize("width", [40, 60, 80, 120])
def test_the_view_fits_into_any_width(width: int) -> None:
    for height in (24, None):
        lines = text_of(FakeRelay("up", "down"), width, height)
        assert all(len(line) <= width for line in lines)
    # With many links, numbers are not cut.
    names = [f"a-link-with-a-long-name-{number}" for number in range(30)]
    lines = text_of(FakeRelay(*names), width, 24)
    assert len(lines) <= 24
    assert all(len(line) <= width for line in lines)
    for line in lines[2:-1]:
        assert all(number in line for number in ("2,000/s", "20.0 %", "2/2"))
    assert ("last minute" in lines[1]) == (width >= 120)


def test_long_words_and_names_with_brackets_are_shown_correctly() -> None:
    relay = FakeRelay("up")
    words = settings_of("loss 10% delay 1ms samples " + ",".join(["1ms"] * 500))
    relay.specs = [
        LinkSpec("[bold]up", ("::1", 5000), ("::1", 6000), words, SETTINGS)
    ]  # fmt: skip
    relay.counters = {("[bold]up", side): Counters() for side in ("forward", "reverse")}  # type: ignore[misc]
    relay.settings = {("[bold]up", side): words for side in ("forward", "reverse")}  # type: ignore[misc]
    lines = text_of(relay)
    assert "[bold]up  [::1]:5000 → [::1]:6000" in lines[1]
    assert len(lines) <= 24
    assert " → [bold]up" in "\n".join(text_of(relay, height=5))


def test_a_pipe_gets_one_line_per_direction_in_use() -> None:
    relay = FakeRelay("up", "down")
    relay.unintended["send_errors"] = 3
    first, *_, last = documents(relay)
    assert plain_lines(first) == []
    up, down = plain_lines(last)
    assert up.startswith(
        "3.0 s  up forward  received 2,000/s  1.60 Mbit/s  forwarded 1,600/s  1.28 Mbit/s  "
        "loss 20.0 %  drawn 20.0 %, predicted 9.91 %  longest loss burst 2, cap 2  forced 300  "
    )
    assert up.endswith("in flight 5  UNINTENDED 3 send_errors")
    assert "down forward" in down
