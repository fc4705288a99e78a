"""A report of iperf3 as a document: what its intervals say, and what they cannot say."""

from collections.abc import Iterator
from pathlib import Path

from netem.core.number_format import duration, number, percent
from netem.measurement.interval_losses import StreamLosses
from netem.output.document import Document, Sentence, SentenceRole
from netem.output.result_tables import KEY_VALUE, ResultTable
from netem.traces.iperf3_report import read_iperf3

_REMARK = (
    "iperf3 counts losses per interval, not per packet: delays, longest burst, models and availability "
    "are not in its report. Measure a capture of the same test for these (tcpdump; --sequence-at 8:4)"
)
_HEADS = ("stream", "packets", "lost", "longest burst", "jitter, last / max")


def iperf3_document(path: Path) -> Document:
    """Return what a report of ``iperf3 -u --json`` says.

    Raises:
        CallerError: one line; it cannot be read, is damaged, or is not of a test by UDP.
    """
    report = read_iperf3(path)
    streams = sorted(
        (StreamLosses(stream) for stream in report.streams),
        key=lambda one: (one.stream.lost / max(one.stream.packets, 1), one.stream.lost),
        reverse=True,
    )
    worst = streams[0]
    rate = worst.stream.lost / max(worst.stream.packets, 1)
    least = worst.least_longest_burst
    of = f"stream {worst.stream.number}, the worst of {len(streams)}: " if len(streams) > 1 else ""
    direction = "server to client" if report.is_reverse else "client to server"
    blocks: list[Sentence | ResultTable] = [
        Sentence(
            text=f"{of}{percent(rate)} lost, at least {least} in a row",
            role=SentenceRole.VERDICT,
            lead=f"{path}:",
        ),
        ResultTable("numbers", f"{direction}, {duration(report.duration_s)}", KEY_VALUE, [*_numbers(worst)]),
    ]
    if len(streams) > 1:
        rows = [_row(stream) for stream in streams]
        blocks.append(ResultTable("streams", "streams, the worst first", _HEADS, rows))
    blocks.append(Sentence(text=_REMARK, role=SentenceRole.REMARK, is_prose=True))
    return Document(
        title=str(path),
        kind="iperf3 measured",
        data={
            "name": str(path),
            "duration_s": report.duration_s,
            "payload_bytes": report.payload_bytes,
            "is_reverse": report.is_reverse,
            "streams": [stream.to_json() for stream in streams],
        },
        blocks=blocks,
    )


def _numbers(losses: StreamLosses) -> Iterator[tuple[str, str]]:
    stream, rate, worst = losses.stream, losses.loss_rate, losses.worst
    yield "packets", str(stream.packets)
    yield "lost", f"{stream.lost} ({percent(stream.lost / max(stream.packets, 1))})"
    if rate is not None:
        kind = "" if losses.is_by_interval else ", for independent losses"
        yield f"loss rate, 95 % interval{kind}", f"{number(rate.low)} to {number(rate.high)}"
    if stream.out_of_order is not None:
        yield "out of order", str(stream.out_of_order)
    if worst is not None:
        times = f"from {worst.begin_s:.1f} s to {worst.end_s:.1f} s"
        yield "worst interval", f"{worst.lost} of {worst.packets} lost, {times}"
        yield "bursts", losses.bursts_text
    yield "longest loss burst", f"at least {losses.least_longest_burst}"
    yield "jitter by RFC 3550, last / max", _jitter(losses)


def _row(losses: StreamLosses) -> tuple[str, ...]:
    stream = losses.stream
    return (
        str(stream.number),
        str(stream.packets),
        f"{stream.lost} ({percent(stream.lost / max(stream.packets, 1))})",
        f"at least {losses.least_longest_burst}",
        _jitter(losses),
    )


def _jitter(losses: StreamLosses) -> str:
    largest_s = max((one.jitter_s for one in losses.stream.intervals), default=losses.stream.jitter_s)
    return f"{duration(losses.stream.jitter_s)} / {duration(largest_s)}"
