"""Packet traces from CSV and IRTT; wrong files; relative delays of other clocks."""

import gzip
import io
import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog

from netem.core.errors import CallerError
from netem.impairments.kinds.replay import Replay
from netem.traces.irtt_trace import read_irtt
from netem.traces.packet_trace import MAX_PACKETS, PacketTrace, packet_trace, read_trace, relative_delays
from netem.traces.smallest_delays import envelope_slope
from tests.helpers.approved import compare_lines, lines_of_error


def test_columns_of_any_unit_and_order_give_the_trace_with_its_lost_packets(tmp_path: Path) -> None:
    file = tmp_path / "trace.csv"
    file.write_text(
        "\ufeffsent_s, note,received_us,sequence\r\n"
        "1700000000.123456789,a,1700000000123457.9994,12\r\n\r\n"
        '1700000000.1,"b, c",,10\r\n'
        "17000000009e-1,x,1.7000000009e15,17\r\n"
        "1700000000.5,x,-1.0,16\r\n"
    )
    trace = read_trace(file)
    assert trace.sequence.tolist() == [10, 11, 12, 13, 14, 15, 16, 17]
    assert trace.sent_ns.tolist() == [
        0, 11_728_394, 23_456_789, 117_592_591, 211_728_394, 305_864_197, 400_000_000, 8 * 10**8,
    ]  # fmt: skip
    assert trace.received_ns.tolist() == [-1, -1, 23_457_999, -1, -1, -1, -1, 8 * 10**8]


@given(
    st.lists(st.tuples(st.integers(0, 10**15), st.integers(-1, 10**15)), min_size=1, max_size=20),
    st.data(),
)
def test_any_records_are_read_exactly(records: list[tuple[int, int]], data: st.DataObject) -> None:
    numbers = sorted(data.draw(st.sets(st.integers(0, 60), min_size=len(records), max_size=len(records))))
    sent = sorted(time_ns for time_ns, _ in records)
    received = [-1 if delay < 0 else at + delay for at, (_, delay) in zip(sent, records, strict=True)]
    order = data.draw(st.permutations(range(len(records))))
    columns = (np.array(column)[list(order)] for column in (sent, received, numbers))
    sent_ns, received_ns, sequence = columns
    trace = packet_trace(sent_ns, received_ns, received_ns < 0, sequence)
    known = dict(zip(numbers, zip(sent, received, strict=True), strict=True))
    assert trace.sequence.tolist() == list(range(numbers[0], numbers[-1] + 1))
    assert (np.diff(trace.sent_ns) >= 0).all()
    for number, at, until in zip(trace.sequence, trace.sent_ns, trace.received_ns, strict=True):
        if number in known:
            assert at == known[number][0] - sent[0]
            assert until == (-1 if known[number][1] < 0 else known[number][1] - sent[0])
        else:
            a = max(other for other in numbers if other < number)
            b = min(other for other in numbers if other > number)
            share = Fraction(int(number) - a, b - a)
            exact = known[a][0] + share * (known[b][0] - known[a][0]) - sent[0]
            assert until == -1
            assert 0 <= exact - int(at) < 1


def test_a_wrong_file_gives_the_approved_line(tmp_path: Path) -> None:
    file = tmp_path / "trace.csv"

    def refusal(content: str) -> list[str]:
        file.write_text(content)
        return lines_of_error(lambda: read_trace(file), FILE=file)

    compare_lines(Path(__file__).with_name("wrong_traces.txt"), lambda text: refusal(json.loads(text)))
    for begin, long in (('"', "1\n" * 100_000), ("", "1" * 100_000)):
        (line,) = refusal(f"sent_ms,received_ms\n{begin}{long}")
        assert len(line) < 160


PERIOD_NS = 20_000_000


def measured(count: int, drift_ppm: float, step_ns: int = 0) -> PacketTrace:
    """Return a trace of two clocks with this drift and a step at three fifths of it."""
    rng = np.random.default_rng(3)
    sent = np.arange(count) * PERIOD_NS
    delay = 5e6 + rng.exponential(2e6, count) + np.where(rng.random(count) < 0.01, 1e9, 0)
    shift = np.where(np.arange(count) >= 0.6 * count, step_ns, 0)
    received = sent + delay + drift_ppm * 1e-6 * sent + shift - 10**12
    lost = rng.random(count) < 0.1
    return packet_trace(sent, received.astype(np.int64), lost, clocks_differ=True)


@given(st.lists(st.integers(0, 10**6), min_size=3, max_size=40))
def test_the_envelope_is_the_optimum_of_a_linear_program(delays: list[int]) -> None:
    t, y = np.arange(len(delays)) * 10, np.array(delays)
    slope = envelope_slope(t, y)
    points = np.column_stack((t, np.ones(len(t))))
    best = linprog(-points.sum(axis=0), A_ub=points, b_ub=y, bounds=(None, None))
    offset = (y - slope * t).min()
    assert (y - slope * t - offset).sum() == pytest.approx(y.sum() + best.fun, rel=1e-6, abs=1e-3)


@pytest.mark.parametrize("drift_ppm", [-80.0, 0.0, 35.0])
def test_a_drift_is_found_and_removed(drift_ppm: float) -> None:
    trace = relative_delays(measured(3000, drift_ppm))
    (line,) = [line for line in trace.notes if "ppm" in line]
    # 60 s; the envelope's ends lie within 0.1 ms above the smallest delay.
    assert float(line.split()[4]) == pytest.approx(drift_ppm, abs=3)
    delay_ns = trace.delay_ns[~trace.lost]
    assert delay_ns.min() == 0
    reference = measured(3000, 0).delay_ns[~trace.lost]
    assert np.abs(delay_ns - reference).max() < 0.2e6


@pytest.mark.parametrize("step_ns", [-200_000_000, 100_000_000])
def test_a_step_of_a_clock_is_found(step_ns: int) -> None:
    trace = relative_delays(measured(3000, 20, step_ns))
    (line,) = [line for line in trace.notes if "a clock was set" in line]
    assert float(line.split(" changes by ")[1].split()[0]) == pytest.approx(step_ns / 1e6, abs=2)
    assert 35 < float(line.split(" s: ")[0].split()[-1]) < 37
    assert "a clock was set" in trace.delays_unknown
    assert not any("ppm" in line for line in trace.notes)


def test_a_replay_needs_known_delays(tmp_path: Path) -> None:
    rows = "".join(f"{20 * k},{20 * k + 5 + 200 * (k > 150)}\n" for k in range(300))
    (tmp_path / "trace.csv").write_text(f"sent_ms,received_other_clock_ms\n{rows}")
    with pytest.raises(CallerError, match="cannot be replayed: delays are not known"):
        Replay(file="trace.csv").without_files(tmp_path, "")


def test_an_unknown_name_of_a_trace_gets_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(CallerError, match="rural: no such file, nor a shipped trace; there are"):
        Replay(file="rural").without_files(tmp_path, "")


def test_a_trace_of_which_nothing_was_received_has_only_losses() -> None:
    trace = packet_trace(np.arange(3), np.zeros(3, np.int64), np.ones(3, bool))
    assert relative_delays(trace).lost.all()


COUNT = 700


def document(count: int = COUNT) -> dict[str, Any]:
    lost = {3: True, 5: "true_up", 6: "true_down", 7: "true_down"}
    trips = []
    for k in range(count):
        send = {"wall": 1508180723502727340 + k, "monotonic": 1000 + k * 20_000_000}
        receive = {} if k in lost else {"wall": 1, "monotonic": send["monotonic"] + 30_000_000 + k}
        trips.append({
            "seqno": k, "lost": lost.get(k, "false" if k % 2 else False),
            "timestamps": {
                "client": {"receive": receive, "send": send},
                "server": {"receive": {}, "send": {}}, "late": False,
            },
            "delay": {}, "ipdv": {},
        })  # fmt: skip
    return {
        "version": {"irtt": "0.9.0"}, "system_info": {"hostname": 'a "round_trips\\" host é'},
        "stats": {"rtt": {"n": 1}}, "round_trips": trips,
    }  # fmt: skip


@pytest.mark.parametrize("indent", [None, 4])
@pytest.mark.parametrize("compress", [False, True])
def test_irtt_gives_losses_and_delays_of_round_trips(
    indent: int | None, compress: bool, tmp_path: Path
) -> None:
    data = json.dumps(document(), indent=indent, ensure_ascii=False).encode()
    path = tmp_path / "irtt.json"
    path.write_bytes(gzip.compress(data) if compress else data)
    trace = read_trace(path)
    assert np.flatnonzero(trace.lost).tolist() == [3, 5, 6, 7]
    assert trace.sent_ns.tolist() == [k * 20_000_000 for k in range(COUNT)]
    kept = [k for k in range(COUNT) if k not in (3, 5, 6, 7)]
    assert trace.delay_ns[kept].tolist() == [30_000_000 + k for k in kept]
    assert trace.notes[1:] == ("lost forward: 1", "lost in reverse: 2", "lost in an unknown direction: 1")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("round_trips"), 'has no list "round_trips"'),
        (lambda d: d["round_trips"][4].pop("seqno"), "round trip 5: expected seqno, lost"),
        (lambda d: d["round_trips"][8].update(seqno=2**62), "round trip 9: has a number"),
        (lambda d: d["round_trips"][8].update(seqno=7), "round trip 9: has a sequence number that"),
        (lambda d: d["round_trips"][0].update(ipdv="x" * 200_000), "more than 65536 characters"),
    ],
)
def test_a_wrong_irtt_document_is_refused_with_the_reason(change: Any, message: str) -> None:
    content = document(20)
    content["system_info"] = {}
    change(content)
    with pytest.raises(ValueError, match=message):
        read_irtt(io.BytesIO(json.dumps(content).encode()), MAX_PACKETS)


def test_a_cut_or_damaged_irtt_file_is_refused(tmp_path: Path) -> None:
    data = json.dumps(document()).encode()
    path = tmp_path / "irtt.json"
    for wrong in (data[:-2000], gzip.compress(data)[:-2000], gzip.compress(data)[:40] + b"x" * 99):
        path.write_bytes(wrong)
        with pytest.raises(CallerError, match=r"ends within|cannot be decompressed"):
            read_trace(path)
