"""Exchanges of timestamps over real sockets on loopback, and the times at which datagrams arrive.

A time of arrival is never too early, whatever the real-time clock does.
"""

import select
import socket
import struct
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from random import Random
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.hosts import DrivenClocks
from noack.core.clock import ClockOffset
from noack.core.errors import CallerError
from noack.protocol.wire_format import Rejection
from noack.runtime.address import Address
from noack.runtime.host_clocks import time_exchange
from noack.runtime.host_clocks.time_exchange import (
    MOST_AT_ONCE,
    ArrivalSocket,
    HostClocks,
    TimeClient,
    TimeKind,
    TimeReference,
)

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
    one = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    one.bind(("127.0.0.1", 0))
    one.settimeout(60)
    return one


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
    while pair.reference.answered < 3:
        select.select([pair.reference], (), (), 60)
        pair.reference.answer_all()
    replies = [received(wire, TimeKind.REPLY)[0] for _ in range(3)]
    for reply in (replies[2], *replies):  # the newest first: delayed, but right
        wire.sendto(reply, client)
    while pair.client.accepted + pair.client.rejected.total() < 4:
        pair.client.poll()
    assert pair.client.accepted == 1
    assert pair.client.rejected == {Rejection.STALE: 3}
    true_ns = time.monotonic_ns()
    own_ns = true_ns + clocks.added_ns(true_ns)
    interval = pair.offset.interval(own_ns)
    assert interval is not None
    assert interval.lower_ns <= true_ns - own_ns <= interval.upper_ns


def test_what_is_read_in_one_call_is_bounded(stack: ExitStack) -> None:
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
        found = arrivals.receive(random.choice((1, 2, 64)))
        for arrival, arrived_ps in zip(found, endpoint.arrived_ps[known:], strict=True):
            assert arrived_ps < (arrival.latest_ns + 1) * PS
            assert arrival.latest_ns <= host.now_ps // PS
    return arrivals.clock_sets


@given(st.integers(0, 2**32), st.booleans())
def test_no_arrival_is_too_early_though_the_real_time_clock_is_set(seed: int, stamps: bool) -> None:
    assert check_arrivals(Random(seed), ARRIVALS, stamps=stamps) > 0


@pytest.fixture(params=["127.0.0.1", "::1"])
def endpoint(request: pytest.FixtureRequest) -> Iterator[socket.socket]:
    family = socket.AF_INET6 if ":" in request.param else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as one:
        one.bind((request.param, 0))
        yield one


@pytest.mark.skipif(sys.platform != "linux", reason="kernel stamps are those of Linux")
def test_a_datagram_that_waited_has_the_time_of_its_arrival(endpoint: socket.socket) -> None:
    """Unless the machine stalls while the clocks are read, which is tried again."""
    clocks = time_exchange.HostClocks()
    arrivals = ArrivalSocket(endpoint, 10, clocks)
    for _ in range(1000):
        assert arrivals.receive(5) == []
        sent_ns = clocks.monotonic_ns()
        endpoint.sendto(b"0123456789abcdef", endpoint.getsockname()[:2])
        time.sleep(0.01)
        later_ns = clocks.monotonic_ns()
        (found,) = arrivals.receive(5)
        assert found.data == b"0123456789a"  # cut
        assert found.source == endpoint.getsockname()[:2]
        assert sent_ns <= found.latest_ns
        if found.latest_ns < later_ns - 5_000_000:
            return
    pytest.fail("no datagram had the kernel's time of arrival")
