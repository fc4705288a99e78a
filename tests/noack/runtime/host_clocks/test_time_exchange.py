"""Exchanges of timestamps over real sockets on loopback, and the times at which datagrams arrive.

A time of arrival is never too early, whatever the real-time clock does. A process with another
clock follows the coordinator's; the true difference is in the bound.
"""

import select
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from random import Random
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from noack.core.clock import NS_PER_S, RunClock
from noack.core.errors import CallerError, PeerError
from noack.protocol.record_tables import LOST_NS
from noack.protocol.roles import Notice, Record
from noack.protocol.wire_format import Rejection
from noack.runtime.address import Address
from noack.runtime.host_clocks.clock_offset import ClockOffset
from noack.runtime.host_clocks.reference_clock import (
    FOUND,
    LOST,
    LOST_AFTER_NS,
    ClockRecord,
    ClockReport,
    ReferenceClock,
    reference_clock,
)
from noack.runtime.host_clocks.time_exchange import (
    MOST_AT_ONCE,
    ArrivalSocket,
    HostClocks,
    TimeClient,
    TimeKind,
    TimeReference,
    answering,
)
from noack.runtime.run_descriptor import new_descriptor
from noack.scenario.run_sections import ClocksSection
from noack.scenario.scenario_file import validate
from tests.helpers.two_hosts import DrivenClocks

KEY = bytes(range(32))


class Pair:
    """A reference, a client, and what the client knows; the test moves the datagrams."""

    def __init__(self, stack: ExitStack, clocks: HostClocks, via: Address | None = None) -> None:
        self.reference = stack.enter_context(closing(TimeReference(("127.0.0.1", 0), KEY)))
        self.offset = ClockOffset()
        to = via or self.reference.address
        self.client = stack.enter_context(
            closing(TimeClient(to, KEY, self.offset, period_ns=0, clocks=clocks))
        )


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as entered:
        yield entered


@pytest.fixture
def wire(stack: ExitStack) -> socket.socket:
    """A socket between client and reference."""
    endpoint = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    endpoint.bind(("127.0.0.1", 0))
    endpoint.settimeout(60)
    return endpoint


def received(wire: socket.socket, kind: TimeKind) -> tuple[bytes, tuple[str, int]]:
    """The next datagram of a kind, and its source; others are lost."""
    while True:
        data, source = wire.recvfrom(100)
        if data[3] == kind:
            return data, source


def test_a_reply_is_accepted_once_and_a_repeated_request_does_no_harm(
    stack: ExitStack, wire: socket.socket
) -> None:
    clocks = DrivenClocks(10**9)
    pair = Pair(stack, clocks, wire.getsockname())
    pair.client.poll()
    request, client = received(wire, TimeKind.REQUEST)
    for _ in range(3):
        wire.sendto(request, pair.reference.address)
        time.sleep(1e-3)
    while pair.reference.answers_sent < 3:
        select.select([pair.reference], (), (), 60)
        pair.reference.answer_all()
    replies = [received(wire, TimeKind.REPLY)[0] for _ in range(3)]
    for reply in (replies[2], *replies):  # the newest first: delayed, but right
        wire.sendto(reply, client)
    wire.sendto(replies[0][:-1] + bytes([replies[0][-1] ^ 1]), client)
    while pair.client.accepted + pair.client.rejected.total() < 5:
        pair.client.poll()
    assert pair.client.accepted == 1
    assert pair.client.rejected == {Rejection.STALE: 3, Rejection.TAG: 1}
    true_ns = time.monotonic_ns()
    own_ns = true_ns + clocks.added_ns(true_ns)
    interval = pair.offset.interval(own_ns)
    assert interval is not None
    assert interval.lower_ns <= true_ns - own_ns <= interval.upper_ns


def test_the_number_of_datagrams_read_in_one_call_is_bounded(stack: ExitStack) -> None:
    pair = Pair(stack, HostClocks())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for _ in range(2 * MOST_AT_ONCE):
            sender.sendto(b"x", pair.reference.address)
        assert select.select([pair.reference], (), (), 60)[0]
        assert 0 < pair.reference.answer_all() <= MOST_AT_ONCE
        assert pair.reference.answer_all() > 0


def test_requests_without_replies_are_forgotten(stack: ExitStack) -> None:
    pair = Pair(stack, HostClocks())
    for _ in range(200):
        pair.client.poll()
    assert pair.client.sent == 400
    assert len(pair.client._outstanding) == 64
    assert pair.offset.interval(time.monotonic_ns()) is None


def test_an_address_in_use_is_a_callers_mistake(stack: ExitStack) -> None:
    pair = Pair(stack, HostClocks())
    with pytest.raises(CallerError, match=r"cannot listen on 127\.0\.0\.1"):
        TimeReference(pair.reference.address, KEY)


PS = 1000  # per ns


class FakeHost(HostClocks):
    """Its time is that of the monotonic clock, in whole picoseconds; readings are rounded down.

    ``settings`` are (time, change) of the real-time clock.
    """

    def __init__(self, random: Random, settings_ps: list[tuple[int, int]]) -> None:
        self.now_ps = random.randint(0, 10**6 * PS)
        self._random = random
        self._real_ps = random.randint(10**18, 10**18 + PS) * PS
        self._settings_ps = settings_ps

    def difference_ps(self, time_ps: int) -> int:
        """Real-time minus monotonic clock."""
        return self._real_ps + sum(change for at, change in self._settings_ps if at <= time_ps)

    def wait(self, most_ns: int) -> None:
        self.now_ps += self._random.randint(0, most_ns * PS)

    def monotonic_ns(self) -> int:
        self.wait(self._random.choice((0, 100, 100, 10**6)))
        return self.now_ps // PS

    def realtime_ns(self) -> int:
        self.wait(100)
        return (self.now_ps + self.difference_ps(self.now_ps)) // PS

    def kernel_stamp_ns(self) -> int:
        """The stamp of a datagram that arrives now."""
        return (self.now_ps + self.difference_ps(self.now_ps)) // PS


def stamp_of(time_ns: int) -> tuple[int, int, bytes]:
    """The ancillary data with a kernel stamp."""
    return socket.SOL_SOCKET, 35, struct.pack("@ll", *divmod(time_ns, 10**9))


CHANGES_PS = [sign * 10**k * PS for k in range(11) for sign in (1, -1)]
ARRIVALS = 300


class FakeEndpoint:
    """A UDP socket of a fake host: datagrams arrive while the host's time goes on."""

    def __init__(self, host: FakeHost, random: Random, *, stamps: bool = True) -> None:
        self.host, self._random, self._stamps = host, random, stamps
        self.arrived_ps: list[int] = []
        self._unread: list[tuple[int, int]] = []

    def setblocking(self, blocking: bool) -> None:
        assert not blocking

    def setsockopt(self, *_: int) -> None:
        pass

    def arrive(self) -> None:
        self.host.wait(self._random.choice((100, 10**6, 10**8)))
        self._unread.append((self.host.now_ps, self.host.kernel_stamp_ns()))

    def recvmsg(self, *_: int) -> tuple[bytes, list[Any], int, tuple[str, int]]:
        if self._random.random() < 0.1:
            self.arrive()
        if not self._unread:
            raise BlockingIOError
        arrived_ps, stamp_ns = self._unread.pop(0)
        self.arrived_ps.append(arrived_ps)
        return b"x", [stamp_of(stamp_ns)] if self._stamps else [], 0, ("::1", 5)


def check_arrivals(random: Random, number: int, *, stamps: bool = True) -> int:
    """Fail if an arrival is too early; return how often the clock was seen to be set.

    The real-time clock is set now and then, by any amount, but not twice between two turns.
    """
    settings_ps: list[tuple[int, int]] = []
    host = FakeHost(random, settings_ps)
    endpoint = FakeEndpoint(host, random, stamps=stamps)
    arrivals = ArrivalSocket(endpoint, 10, host)  # type: ignore[arg-type]
    arrivals.receive(1)
    last_set_ps, turn_ps = -1, 0
    while len(endpoint.arrived_ps) < number:
        if last_set_ps < turn_ps and random.random() < 0.3:
            added_ps = host.difference_ps(host.now_ps) - host.difference_ps(-1)
            last_set_ps = host.now_ps + random.randint(0, 10 ** random.choice((3, 6, 8)) * PS)
            settings_ps[:] = [(0, added_ps), (last_set_ps, random.choice(CHANGES_PS))]
        turn_ps = host.now_ps
        for _ in range(random.randint(0, 3)):
            endpoint.arrive()
        known = len(endpoint.arrived_ps)
        received = arrivals.receive(random.choice((1, 2, 64)))
        for arrival, arrived_ps in zip(received, endpoint.arrived_ps[known:], strict=True):
            assert arrived_ps < (arrival.latest_ns + 1) * PS
            assert arrival.latest_ns <= host.now_ps // PS
    return arrivals.clock_sets


@given(st.integers(0, 2**32), st.booleans())
def test_no_arrival_is_too_early_though_the_real_time_clock_is_set(seed: int, stamps: bool) -> None:
    assert check_arrivals(Random(seed), ARRIVALS, stamps=stamps) > 0


ROOMY = ClocksSection(largest_error_us=1e6)  # a busy machine gives wide bounds


def reference_at(stack: ExitStack, port: int = 0) -> TimeReference:
    reference = stack.enter_context(closing(TimeReference(("127.0.0.1", port), KEY)))
    return stack.enter_context(answering(reference))


def following(stack: ExitStack, clocks: HostClocks, settings: ClocksSection = ROOMY) -> ReferenceClock:
    clock = ReferenceClock(reference_at(stack).address, KEY, settings, clocks)
    stack.enter_context(closing(clock))
    clock.wait_until_known()
    return clock


def polled(clock: ReferenceClock, count: int = 20) -> ClockReport:
    """Read the clock, then poll; fail if a reading was outside of the bound, or backward."""
    readings, newest_ns = [], clock.monotonic_ns()
    for _ in range(count):
        before_ns = time.monotonic_ns()
        own_ns = clock.monotonic_ns()
        readings.append((before_ns, own_ns, time.monotonic_ns()))
        assert own_ns >= newest_ns
        newest_ns = own_ns
        time.sleep(0.001)
    report = clock.poll()
    assert clock.monotonic_ns() >= newest_ns
    if report.error_ns is not None:
        for before_ns, own_ns, after_ns in readings:
            assert before_ns - report.error_ns <= own_ns <= after_ns + report.error_ns
    return report


@pytest.mark.parametrize(
    ("offset_ns", "drift_ppb"),
    [(NS_PER_S, 100_000), (-NS_PER_S, -100_000), (-NS_PER_S, 1_000_000)],
)
def test_the_difference_to_the_coordinators_clock_is_in_the_bound(
    stack: ExitStack, offset_ns: int, drift_ppb: int
) -> None:
    clocks = DrivenClocks(offset_ns, drift_ppb)
    clock, since_ns = following(stack, clocks), None
    for _ in range(15):
        report = polled(clock)
        assert report.lost is None or report.now_ns - report.since_ns > LOST_AFTER_NS
        assert since_ns in (None, report.since_ns)
        since_ns = report.now_ns


def test_a_bound_without_answers_is_lost_and_found_again(stack: ExitStack) -> None:
    with ExitStack() as first:
        port = reference_at(first).address[1]
        clock = ReferenceClock(("127.0.0.1", port), KEY, ROOMY, DrivenClocks())
        stack.enter_context(closing(clock))
        clock.wait_until_known()
        assert polled(clock).lost is None
    while (report := polled(clock)).error_ns is not None:
        pass
    assert report.lost == f"no answer from 127.0.0.1:{port} for 0.5 s"
    reference_at(stack, port)  # after a reboot: another clock
    causes = [polled(clock).lost]
    while causes[-1] is not None:
        causes.append(polled(clock).lost)
    assert "the reference has another clock than before" in causes


def test_a_reference_clock_does_not_begin_without_an_answer_or_with_a_wide_bound(stack: ExitStack) -> None:
    silent = stack.enter_context(closing(TimeReference(("127.0.0.1", 0), KEY)))
    clock = stack.enter_context(closing(ReferenceClock(silent.address, KEY, ROOMY)))
    with pytest.raises(PeerError, match=r"clock with the coordinator's: no answer from 127\.0"):
        clock.wait_until_known(wait_s=0.05)
    with pytest.raises(PeerError):
        clock.wait_until_known(lambda: True)
    narrow = ClocksSection(largest_error_us=1e-3)
    address = reference_at(stack).address
    clock = stack.enter_context(closing(ReferenceClock(address, KEY, narrow)))
    with pytest.raises(PeerError, match=r"known within \d+ µs, 0\.001 µs allowed$"):
        clock.wait_until_known(wait_s=0.2)


def test_a_process_with_another_clock_needs_a_reference(content: dict[str, Any]) -> None:
    scenario = validate(content | {"loops": [{"name": "one", "count": 2}]}, "small")
    descriptor = new_descriptor(scenario, Path("run"), launched=False)
    assert reference_clock(descriptor) is None
    with pytest.raises(PeerError, match="answers no requests for the time"):
        reference_clock(descriptor.model_copy(update={"clock": "another"}))


class Scripted(ReferenceClock):
    """A reference whose reports are given."""

    def __init__(self, reports: list[ClockReport]) -> None:
        self.reports = reports

    def poll(self) -> ClockReport:
        return self.reports.pop(0)


def test_each_clock_report_is_a_row_and_each_change_a_line_of_the_log() -> None:
    ms = 10**6
    reports = [
        ClockReport(0, 50 * ms, 7, 3000, 10),
        ClockReport(50 * ms, 100 * ms, 8, None, 10, "no answer"),
        ClockReport(100 * ms, 150 * ms, 8, None, 10, "no answer"),
        ClockReport(10 * ms, 200 * ms, 9, None, 12, "a contradiction"),
        ClockReport(200 * ms, 250 * ms, 9, 4000, 13),
    ]
    clock = RunClock(0, 2.0, lambda: 0)
    record = ClockRecord("sensor", clock, Scripted(reports), has_table=True)
    outputs = [record.compare(2 * output.now_ns) for output in list(reports)]
    rows = [output for each in outputs for output in each if isinstance(output, Record)]
    assert [output.table for output in rows] == ["sensor_clock"] * 5
    assert [output.row for output in rows] == [
        (0, 10, 0, 100 * ms, 50 * ms, 7, 3000),
        (1, 10, 100 * ms, 200 * ms, 100 * ms, 8, LOST_NS),
        (2, 10, 200 * ms, 300 * ms, 150 * ms, 8, LOST_NS),
        (3, 12, 20 * ms, 400 * ms, 200 * ms, 9, LOST_NS),
        (4, 13, 400 * ms, 500 * ms, 250 * ms, 9, 4000),
    ]
    lines = [output for each in outputs for output in each if isinstance(output, Notice)]
    assert [(output.t_ns, output.level) for output in lines] == [
        (200 * ms, LOST), (400 * ms, LOST), (500 * ms, FOUND)
    ]  # fmt: skip
    assert lines[1].text == "the bound of its clock's error is lost: a contradiction"


def test_the_coordinators_own_clock_has_no_error() -> None:
    record = ClockRecord("plant", RunClock(time.monotonic_ns()), None, has_table=True)
    for number in range(3):
        (output,) = record.compare(0)
        assert isinstance(output, Record)
        assert output.row[0] == number
        assert output.row[-2:] == (0, 0)
    assert record.summary() == {}
