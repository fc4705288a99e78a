"""Reports of iperf3: their numbers, what their intervals say, and damaged ones."""

import json
from itertools import combinations, groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from netem.core.errors import CallerError
from netem.measurement.interval_losses import StreamLosses
from netem.measurement.trace_sources import is_iperf3_file, read_files
from netem.traces.iperf3_report import LossInterval, Stream, read_iperf3

FOLDER = Path(__file__).parents[1] / "traces"
RECEIVER = FOLDER / "iperf3_receiver.json"
"""Of ``iperf3 -u -b 1M -l 500 -t 4 -R --json`` (3.12) through ``--reverse loss burst 4% 2 delay 5ms 1ms``."""
SENDER = FOLDER / "iperf3_sender.json"
"""Of ``iperf3 -u -b 1M -l 500 -t 3 -P 2 --json`` through ``loss burst 4% 2``."""


def stream_of(counts: list[tuple[int, int]]) -> StreamLosses:
    """A stream with intervals of so many packets, of which so many are lost."""
    intervals = tuple(LossInterval(k, k + 1, packets, lost, 0.0) for k, (packets, lost) in enumerate(counts))
    packets, lost = (sum(column) for column in zip(*counts, strict=True))
    return StreamLosses(Stream(1, packets, lost, 0, 0.0, intervals))


def test_a_report_has_the_numbers_that_iperf3_prints() -> None:
    own = json.loads(RECEIVER.read_text())
    report = read_iperf3(RECEIVER)
    (stream,) = report.streams
    total = own["end"]["streams"][0]["udp"]
    assert (stream.packets, stream.lost, stream.out_of_order) == (
        total["packets"],
        total["lost_packets"],
        total["out_of_order"],
    )
    assert report.is_reverse
    assert report.payload_bytes == 500
    assert len(stream.intervals) == len(own["intervals"])
    assert sum(interval.lost for interval in stream.intervals) == stream.lost
    assert stream.jitter_s == pytest.approx(total["jitter_ms"] / 1000)
    assert is_iperf3_file(RECEIVER)
    sender = read_iperf3(SENDER)
    assert [(one.lost, one.intervals) for one in sender.streams] == [(26, ()), (36, ())]


def longest_run(is_lost: list[bool]) -> int:
    return max((len([*run]) for lost, run in groupby(is_lost) if lost), default=0)


def test_the_lower_limit_of_the_longest_burst_is_that_of_all_placements() -> None:
    for packets in range(1, 9):
        for lost in range(packets + 1):
            shortest = min(
                max(
                    (len([*run]) for is_lost, run in groupby(k in places for k in range(packets)) if is_lost),
                    default=0,
                )
                for places in combinations(range(packets), lost)
            )
            assert stream_of([(packets, lost)]).least_longest_burst == shortest
    assert stream_of([(5, 1), (5, 5), (4, 4), (5, 0)]).least_longest_burst == 9


def test_the_interval_of_the_loss_rate_contains_the_truth_for_bursty_losses() -> None:
    """Losses that depend on each other within an interval: of 400 tests at least 90 %."""
    rng, hits = np.random.default_rng(1), 0
    for _ in range(400):
        rates = rng.beta(0.5, 9.5, 30)  # mean 5 %
        losses = stream_of([(100, int(rng.binomial(100, rate))) for rate in rates])
        estimate = losses.loss_rate
        assert estimate is not None
        hits += estimate.low <= 0.05 <= estimate.high
    assert hits >= 0.9 * 400


def test_bursty_losses_are_told_from_independent_ones() -> None:
    rng = np.random.default_rng(2)
    independent = stream_of([(250, int(rng.binomial(250, 0.03))) for _ in range(40)])
    assert "as independent ones do" in independent.bursts_text
    bursty = stream_of([(250, 60 if k % 8 == 0 else 0) for k in range(40)])
    assert "more between intervals than independent ones" in bursty.bursts_text
    assert bursty.worst is not None
    assert bursty.worst.lost == 60
    assert "not known" in stream_of([(250, 3)]).bursts_text


def changed(change: Any) -> str:
    document = json.loads(RECEIVER.read_text())
    change(document)
    return json.dumps(document)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (RECEIVER.read_text()[:3000], "line 131: not JSON, or cut off"),
        (RECEIVER.read_text() + "-----\nServer listening\n", "line 214: something follows the report"),
        (
            changed(lambda one: one.update(error="unable to read from stream socket: ")),
            "iperf3 reports an error: unable to read from stream socket:",
        ),
        (
            changed(lambda one: one["start"]["test_start"].update(protocol="TCP")),
            "is a test by TCP; give one by UDP (iperf3 -u)",
        ),
        (
            changed(lambda one: one.update(end={})),
            "not a whole report of iperf3 -u --json: lacks a value 'streams'",
        ),
        (
            changed(lambda one: one["intervals"][0]["streams"][0].update(lost_packets=900)),
            "interval 1: has 900 lost packets of 251",
        ),
        (
            changed(lambda one: one["intervals"][0]["streams"][0].update(lost_packets=-1)),
            "lost_packets is -1, not a number of packets or bytes",
        ),
        ('{"event":"start","data":{"connected":[]}}\n{"event":"interval"}', "is of iperf3 --json-stream"),
    ],
)
def test_a_damaged_report_is_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "iperf3.json"
    path.write_text(text)
    assert is_iperf3_file(path)
    with pytest.raises(CallerError) as error:
        read_iperf3(path)
    assert str(error.value).startswith(f"{path}: {message}")
    assert "\n" not in str(error.value)


def test_a_report_is_no_packet_trace() -> None:
    with pytest.raises(CallerError, match="a report of iperf3 has losses per interval, and no packets"):
        read_files([RECEIVER])
