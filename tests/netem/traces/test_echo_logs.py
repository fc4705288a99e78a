"""Logs of ping and fping: what they say is what was written, and damaged ones are refused in one line."""

import gzip
import json
import re
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem.core.errors import CallerError
from netem.measurement.trace_sources import SourceOptions, read_files, read_flows
from netem.traces.packet_trace import PacketTrace, read_trace

PING = Path(__file__).with_name("ping.txt")
"""Of ``ping -D -c 40 -i 0.05`` (iputils) through ``noack netem shell loss 20% --both delay 5ms 3ms``."""
Rtts = Sequence[float | None]
"""Round-trip times in ms, None: lost."""
RTTS = st.lists(
    st.one_of(st.none(), st.integers(0, 5_000_000).map(lambda n: n / 1000)), min_size=1, max_size=30
)


def ping_log(
    rtts: Rtts, *, first: int = 1, stamps: bool = True, period_ms: int = 200, summary: bool = True
) -> str:
    """Write a log as iputils does, with answers in the order of their arrival."""
    lines = []
    for number, rtt in enumerate(rtts):
        if rtt is not None:
            arrival_ms = number * period_ms + rtt
            stamp = f"[{1_700_000_000 + arrival_ms / 1000:.6f}] " if stamps else ""
            sequence = (first + number) % 65536
            line = f"{stamp}64 bytes from host (192.0.2.1): icmp_seq={sequence} ttl=64 time={rtt:.3f} ms"
            lines.append((arrival_ms, line))
    text = "PING host (192.0.2.1) 56(84) bytes of data.\n" + "".join(f"{line}\n" for _, line in sorted(lines))
    if summary:
        received, count = len(lines), len(rtts)
        text += f"\n--- host ping statistics ---\n{count} packets transmitted, {received} received, "
        text += f"{100 * (1 - received / count):g}% packet loss, time {(count - 1) * period_ms}ms\n"
    return text


def fping_log(rtts: Rtts, target: str = "192.0.2.1", *, stamps: bool = True) -> str:
    lines = []
    for number, rtt in enumerate(rtts):
        stamp = f"[{1_700_000_000 + number + (0 if rtt is None else rtt / 1000):.6f}] " if stamps else ""
        what = "timed out" if rtt is None else f"64 bytes, {rtt:.3f} ms"
        lines.append(f"{stamp}{target} : [{number}], {what} (1.00 avg, 0% loss)\n")
    return "".join(lines)


def read(text: str, folder: Path, options: SourceOptions | None = None) -> PacketTrace:
    path = folder / "log.txt"
    path.write_text(text)
    return read_files([path], options)


def assert_is(trace: PacketTrace, rtts: Rtts, period_ms: float | None = None) -> None:
    assert len(trace) == len(rtts)
    for delay_ns, rtt in zip(trace.delay_ns.tolist(), rtts, strict=True):
        assert delay_ns == (-1 if rtt is None else pytest.approx(rtt * 1e6, abs=1))
    if period_ms is not None:
        expected = [number * period_ms * 1e6 for number in range(len(rtts))]
        assert trace.sent_ns.tolist() == pytest.approx(expected, abs=20_000)  # of stamps in µs


def test_a_log_of_iputils_is_measured_as_ping_counts_it() -> None:
    text = PING.read_text()
    trace = read_trace(PING)
    counts = re.search(r"(\d+) packets transmitted, (\d+) received", text)
    assert counts is not None
    assert [len(trace), int((~trace.lost).sum())] == [int(counts[1]), int(counts[2])]
    times = re.search(r"rtt min/avg/max/mdev = ([\d.]+)/([\d.]+)/([\d.]+)", text)
    assert times is not None
    delays_ms = trace.delay_ns[~trace.lost] / 1e6
    found = [delays_ms.min(), delays_ms.mean(), delays_ms.max()]
    assert found == pytest.approx([float(times[number]) for number in (1, 2, 3)], abs=0.06)
    assert trace.sent_ns[-1] / 1e9 == pytest.approx(39 * 0.05, rel=0.06)


@given(RTTS)
def test_a_log_of_ping_is_read_as_it_was_written(
    tmp_path_factory: pytest.TempPathFactory, rtts: Rtts
) -> None:
    folder = tmp_path_factory.mktemp("log")
    trace = read(ping_log(rtts), folder)
    assert_is(trace, rtts, 200 if sum(rtt is not None for rtt in rtts) > 1 else None)
    assert_is(read(ping_log(rtts, stamps=False), folder), rtts, 200 if len(rtts) > 1 else None)
    if any(rtt is not None for rtt in rtts):
        assert_is(read(fping_log(rtts), folder), rtts)
    columns = " ".join("-" if rtt is None else f"{rtt:.3f}" for rtt in rtts)
    assert_is(read(f"192.0.2.1 : {columns}\n", folder), rtts, 1000)


def test_numbers_of_16_bits_wrap_around(tmp_path: Path) -> None:
    rtts: Rtts = [1.0] * 66_000
    assert_is(read(ping_log(rtts, period_ms=10), tmp_path), rtts)
    assert_is(
        read(ping_log(rtts[:100], first=65_500, summary=False).partition("\n")[2], tmp_path), rtts[:100]
    )


def test_lines_about_losses_are_losses(tmp_path: Path) -> None:
    answer = "64 bytes from 192.0.2.1: icmp_seq={} ttl=64 time=1.00 ms\n"
    text = (
        "PING 192.0.2.1 (192.0.2.1) 56(84) bytes of data.\n"
        + "no answer yet for icmp_seq=1\n"
        + answer.format(2)
        + answer.format("2").rstrip()
        + " (DUP!)\nFrom 192.0.2.9 icmp_seq=3 Destination Host Unreachable\n"
        + answer.format(5)
        + "no answer yet for icmp_seq=6\n"
    )
    trace = read(text, tmp_path)
    assert trace.lost.tolist() == [True, False, True, True, False, True]
    notes = " ".join(trace.notes)
    assert "answers that came twice: 1" in notes
    assert "a router reports an error, which count as lost: 1" in notes
    assert "no summary at its end" in notes
    assert "requests are taken as sent every 1 s, as ping does without an option" in notes
    bsd = "PING 1.1.1.1 (1.1.1.1): 56 data bytes\n64 bytes from 1.1.1.1: icmp_seq=0 ttl=57 time=12.3 ms\n"
    assert len(read(bsd + "Request timeout for icmp_seq 1\n", tmp_path)) == 2


def test_targets_of_fping_are_flows(tmp_path: Path) -> None:
    path = tmp_path / "log.txt.gz"
    both = fping_log([1.0, 2.0, None], "192.0.2.1") + fping_log([None, 5.0], "2001:db8::1")
    both += "2001:db8::1 : xmt/rcv/%loss = 4/1/75%, min/avg/max = 5.00/5.00/5.00\n"
    path.write_bytes(gzip.compress(both.encode()))
    assert_is(read_files([path]), [1.0, 2.0, None])
    assert_is(read_files([path], SourceOptions(flow=2)), [None, 5.0, None, None])
    flows, left_out = read_flows([path])
    assert [(flow.number, flow.name, flow.problem) for flow in flows] == [
        (1, "192.0.2.1", ""),
        (2, "2001:db8::1", ""),
    ]
    assert left_out == 0
    with pytest.raises(CallerError, match="has no flow 3; its targets are flows 1 to 2"):
        read_files([path], SourceOptions(flow=3))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("PING host (192.0.2.1) 56(84) bytes of data.\n", "has no answers and no summary; not a log of ping"),
        ("64 bytes from a: icmp_seq=1 ttl=64\n", "line 1: has no time=; ping shows one from -s 16 on"),
        ("64 bytes from a: icmp_seq=1 ttl=64 time=1e ms\n", "line 1: '1e' is no round-trip time in ms"),
        (
            "[9999999999.0] 64 bytes from a: icmp_seq=1 ttl=64 time=1 ms\n",
            "line 1: [9999999999.0] is too late a time, in seconds since 1970",
        ),
        (ping_log([1.0]) * 2, "line 10: a second summary; give the log of one ping at a time"),
        (
            "".join(f"64 bytes from a: icmp_seq={n} ttl=64 time=1 ms\n" for n in (1, 9999999999)),
            "has 9999999999 requests, of which 2 are answered; at most 1002000 can be",
        ),
        ("a : [0], 64 bytes, 1.0.0 ms (1 avg, 0% loss)\n", "line 1: '1.0.0' is no round-trip time in ms"),
        ("a : [0], timed out\na : [1], nothing\n", "line 2: neither a time in ms nor timed out"),
        ("a : xmt/rcv/%loss = 3/3/0%\n", "has no line per request; fping prints them with -l, -c or -C"),
        ("a : [0], 64 bytes, 1 ms\n" + "x" * 70_000, "line 2: has more than 65536 bytes; not a log"),
    ],
)
def test_a_damaged_log_is_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(CallerError) as error:
        read(text, tmp_path)
    assert str(error.value).startswith(f"{tmp_path / 'log.txt'}: {message}")
    assert "\n" not in str(error.value)
    assert json.dumps(str(error.value))
