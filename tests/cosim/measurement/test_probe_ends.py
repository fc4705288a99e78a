"""Probes: sender and receiver in virtual time."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cosim.measurement.probe_ends import ProbePlan, ProbeReceiver, ProbeResult, ProbeSender
from noack.core.clock import NS_PER_S
from noack.protocol.probe_format import PROBE_BYTES, ProbeDatagram, ProbeKind, encode_probe

PERIOD_NS, DELAY_NS = 20_000_000, 3_000_000
SILENCE_NS = 30 * NS_PER_S
FAR_NS = 10**15
HOST = 5
Drops = Callable[[int], bool]
"""Whether the datagram of a number is lost; the numbers count what is sent on this way."""


class Exchange(NamedTuple):
    sender: ProbeSender
    receiver: ProbeReceiver
    rows: list[tuple[object, ...]]
    log: list[str]
    result: ProbeResult | None


def never(number: int) -> bool:
    return False


def exchange(
    count: int,
    forward: Drops = never,
    reverse: Drops = never,
    *,
    round_trip: bool = False,
    host: int = HOST,
    offset_ns: int = 0,
) -> Exchange:
    """Run a probe; the receiver's clock is ``offset_ns`` ahead."""
    rows: list[tuple[object, ...]] = []
    log: list[str] = []
    plan = ProbePlan(PERIOD_NS, count, is_round_trip=round_trip)
    sender = ProbeSender(plan, 77, HOST, 0)
    receiver = ProbeReceiver(host, offset_ns - 1, SILENCE_NS, log.append, lambda *row: rows.append(row))
    now_ns = sent = answered = 0
    while not sender.is_over(now_ns):
        now_ns = max(now_ns, sender.next_deadline_ns())
        data = sender.on_timer(now_ns)
        sent += 1
        if forward(sent - 1):
            continue
        answer = receiver.handle(data, "sender", now_ns + DELAY_NS + offset_ns)
        if answer is not None:
            answered += 1
            if not reverse(answered - 1):
                sender.handle(answer, now_ns + 2 * DELAY_NS)
    if not round_trip:  # this sender waits for answers
        assert not receiver.is_over(now_ns + DELAY_NS + offset_ns)
    assert receiver.is_over(now_ns + offset_ns + SILENCE_NS + NS_PER_S)
    return Exchange(sender, receiver, rows, log, receiver.finish(0))


@given(st.sets(st.integers(0, 59)), st.sampled_from([0, FAR_NS, -FAR_NS]))
def test_the_trace_has_exactly_the_losses(lost: set[int], offset_ns: int) -> None:
    host = HOST if offset_ns == 0 else 6
    probe = exchange(60, lost.__contains__, host=host, offset_ns=offset_ns)
    if len(lost) == 60:
        assert probe.result is None
        return
    assert probe.result is not None
    trace = probe.result.trace
    assert trace is not None
    assert np.flatnonzero(trace.lost).tolist() == sorted(lost)
    assert trace.sent_ns.tolist() == [k * PERIOD_NS for k in range(60)]
    assert set(trace.delay_ns[~trace.lost].tolist()) == {DELAY_NS if offset_ns == 0 else 0}
    # The saved rows are the same trace: what is missing between two rows is lost.
    header, *rows = probe.rows
    assert header[2] == ("received_ns" if offset_ns == 0 else "received_other_clock_ns")
    assert {row[0] for row in rows if row[2] != ""} == set(range(60)) - lost
    assert {row[0] for row in rows} >= {0, 59}


@given(st.sets(st.integers(0, 99)), st.sets(st.integers(0, 99)))
def test_a_round_trip_tells_on_which_way_each_datagram_was_lost(forward: set[int], reverse: set[int]) -> None:
    probe = exchange(100, forward.__contains__, reverse.__contains__, round_trip=True)
    result = probe.sender.finish(0)
    assert result.trace is not None
    arrived = [k for k in range(100) if k not in forward]
    lost_in_reverse = {k for number, k in enumerate(arrived) if number in reverse}
    truth = dict.fromkeys(forward, "forward") | dict.fromkeys(lost_in_reverse, "reverse")
    assert set(np.flatnonzero(result.trace.lost)) == truth.keys()
    # Fewer than 128 are lost in a row, so that each answer covers what was lost before it.
    answered = [k for k in arrived if k not in lost_in_reverse]
    known_directions = {k: direction for k, direction in truth.items() if answered and k < answered[-1]}
    assert {
        k: direction for k, direction in probe.sender.lost_directions().items() if k in known_directions
    } == known_directions
    later_directions = {
        direction for k, direction in probe.sender.lost_directions().items() if k not in known_directions
    }
    assert later_directions <= {"unknown"}


def test_a_probe_without_an_end_and_late_sends_are_named() -> None:
    sender, receiver = ProbeSender(ProbePlan(PERIOD_NS, 50), 1, HOST, 0), new_receiver()
    now_ns = 0
    while sender.sent < 30:
        # After a stall of 10 periods the lateness of the next ones is 200, 180, … 20 ms.
        now_ns = max(now_ns, sender.next_deadline_ns())
        now_ns += 10 * PERIOD_NS if sender.sent == 15 else 0
        receiver.handle(sender.on_timer(now_ns), "sender", now_ns + DELAY_NS)
    assert not receiver.is_over(now_ns + DELAY_NS)
    assert receiver.is_over(now_ns + SILENCE_NS + NS_PER_S)
    assert new_receiver().finish(0) is None
    (line,) = sender.finish(0).notes
    assert line == "datagrams sent: 30; late sends: 10, the longest by 200 ms"
    result = receiver.finish(0)
    assert result is not None
    assert "no end datagram" in result.notes[0]
    assert result.trace is not None
    assert len(result.trace) == 30


def new_receiver() -> ProbeReceiver:
    return ProbeReceiver(HOST, -1, SILENCE_NS)


def probe(sequence: int, session: int = 77, **fields: int) -> bytes:
    content = ProbeDatagram(
        ProbeKind.PROBE, session, HOST, sequence, sequence * PERIOD_NS, 0, PERIOD_NS, 10**6
    )
    return encode_probe(content._replace(**fields))


def test_what_is_ignored_is_counted() -> None:
    log: list[str] = []
    receiver = ProbeReceiver(HOST, 0, SILENCE_NS, log.append)
    corrupted = bytearray(probe(2))
    corrupted[-1] ^= 1
    for data in (
        probe(0), probe(1), probe(1), probe(2, session=8), probe(2, session=9), b"foreign",
        bytes(corrupted), b"NAMP\2" + bytes(PROBE_BYTES), probe(90_000), probe(5, sent_ns=0),
        probe(3, kind=ProbeKind.ANSWER), probe(2, period_ns=0), probe(4),
    ):  # fmt: skip
        receiver.handle(data, "10.0.0.1:5", 10**9)
    assert receiver.ignored == {
        "duplicate": 1, "other session": 2, "foreign": 1, "corrupted": 1, "version": 1,
        "ahead of schedule": 1, "impossible": 3,
    }  # fmt: skip
    assert [line for line in log if "another probe" in line] == [
        "10.0.0.1:5: ignored: another probe is being received; a listener receives one probe at a time"
    ]
    result = receiver.finish(3)
    assert result is not None
    assert result.kernel_drops == 3
    assert result.trace is not None
    assert result.trace.lost.tolist() == [False, False, True, True, False]
