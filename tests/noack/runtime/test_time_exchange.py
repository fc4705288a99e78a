"""Exchanges over real sockets on loopback: own and reference clock are the same, with an offset."""

import select
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from random import Random

import numpy as np
import pytest

from benchmarks.hosts import DrivenClocks
from noack.core.clock import ClockOffset, Restart
from noack.core.errors import CallerError
from noack.protocol.wire_format import Encoder, Flow, Message, Rejection
from noack.runtime.host_clocks.time_exchange import (
    MOST_AT_ONCE,
    TIME_BYTES,
    HostClocks,
    TimeClient,
    TimeDatagram,
    TimeFormat,
    TimeKind,
    TimeReference,
)

KEY = bytes(range(32))
_SO_TIMESTAMPNS = 35


class Pair:
    """A reference, a client, and what the client knows; the test moves the datagrams."""

    def __init__(
        self,
        stack: ExitStack,
        clocks: HostClocks,
        host: str = "127.0.0.1",
        at: Callable[[TimeReference], tuple[str, int]] = lambda reference: reference.address,
    ) -> None:
        self.clocks = clocks
        self.reference = stack.enter_context(closing(TimeReference((host, 0), KEY)))
        self.offset = ClockOffset()
        self.client = stack.enter_context(
            closing(TimeClient(at(self.reference), KEY, self.offset, period_ns=0, clocks=clocks))
        )

    def exchange(self) -> list[Restart]:
        """Poll until one more reply is accepted."""
        found, accepted = [], self.client.accepted
        while self.client.accepted == accepted:
            found += self.client.poll()
            if select.select([self.reference], (), (), 1)[0]:
                self.reference.answer_all()
        return found

    def without_stamps(self) -> None:
        for one in (self.reference, self.client):
            with socket.socket(fileno=one.fileno()) as endpoint:
                endpoint.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 0)
                endpoint.detach()

    def check(self, clocks: DrivenClocks, number: int = 1) -> None:
        """Fail if the true offset is not in the interval."""
        for _ in range(number):
            true_ns = time.monotonic_ns()
            own_ns = true_ns + clocks.added_ns(true_ns)
            interval = self.offset.interval(own_ns)
            assert interval is not None
            assert interval.lower_ns <= true_ns - own_ns <= interval.upper_ns


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


@pytest.mark.parametrize(
    ("host", "stamps", "offset_ns", "drift_ppb"),
    [
        ("127.0.0.1", True, 10**9, 100_000),
        ("::1", True, -(10**9), -100_000),
        ("127.0.0.1", False, 0, 1_000_000),
        ("::1", False, 10**9, 100_000),
    ],
)
def test_the_true_offset_is_in_the_bound(
    stack: ExitStack, host: str, stamps: bool, offset_ns: int, drift_ppb: int
) -> None:
    clocks = DrivenClocks(offset_ns, drift_ppb)
    pair = Pair(stack, clocks, host)
    if not stamps:
        pair.without_stamps()
    for _ in range(40):
        assert pair.exchange() == []
        pair.check(clocks, 50)
    assert pair.client.rejected == pair.reference.rejected == {}
    assert pair.client.accepted == pair.offset.exchanges


@pytest.mark.parametrize("slow", ["forward", "back"])
def test_delays_in_one_direction_only_widen_the_bound(
    stack: ExitStack, wire: socket.socket, slow: str
) -> None:
    """The limit that depends on this direction is off by the delay; the true offset is inside."""
    delay_ns = 20 * 10**6
    clocks = DrivenClocks(-(10**9))
    pair = Pair(stack, clocks, at=lambda _: wire.getsockname())
    client = pair.client._endpoint.getsockname()
    while pair.client.accepted < 5:
        assert pair.client.poll() == []
        while select.select([wire, pair.reference], (), (), 0.1)[0]:
            pair.reference.answer_all()
            if select.select([wire], (), (), 0)[0]:
                data, source = wire.recvfrom(100)
                is_forward = source != pair.reference.address
                _wait(delay_ns * (is_forward == (slow == "forward")))
                wire.sendto(data, pair.reference.address if is_forward else client)
    pair.check(clocks)
    interval = pair.offset.interval(clocks.monotonic_ns())
    assert interval is not None
    slack_ns = interval.upper_ns - 10**9 if slow == "forward" else 10**9 - interval.lower_ns
    assert slack_ns >= delay_ns


def _wait(wait_ns: int) -> None:
    time.sleep(wait_ns * 1e-9)


def received(wire: socket.socket, kind: TimeKind) -> tuple[bytes, tuple[str, int]]:
    """The next datagram of a kind, and its source; others are lost."""
    while True:
        data, source = wire.recvfrom(100)
        if data[3] == kind:
            return data, source


def hostile(random: Random, seen: list[bytes]) -> bytes:
    """A datagram of someone without the key, who has seen the traffic."""
    one = bytearray(random.choice(seen))
    match random.randrange(5):
        case 0:
            one[random.randrange(len(one))] ^= 1 << random.randrange(8)
        case 1:
            del one[random.randrange(len(one)) :]
        case 2:
            one += random.randbytes(random.choice((1, 64, 2000)))
        case 3:
            one = bytearray(random.randbytes(random.choice((0, 1, TIME_BYTES, 1000))))
        case 4:
            other = TimeFormat(bytes(32))
            nonce = bytes(one[8:24])
            one = bytearray(other.encode(TimeDatagram(TimeKind(one[3]), nonce, 5, 6, 7)))
    return bytes(one)


def test_no_hostile_datagram_is_accepted(stack: ExitStack, wire: socket.socket) -> None:
    random = Random(5)
    clocks = DrivenClocks(10**9)
    pair = Pair(stack, clocks, at=lambda _: wire.getsockname())
    pair.client.poll()
    request, client = received(wire, TimeKind.REQUEST)
    wire.sendto(request, pair.reference.address)
    select.select([pair.reference], (), (), 60)
    pair.reference.answer_all()
    reply, _ = received(wire, TimeKind.REPLY)
    loop = Encoder(7, KEY).encode(Message(Flow.UPDATE, 1, 1, np.zeros(2)))
    sent = 0
    for _ in range(200):
        for _ in range(20):  # fit into the receive buffer
            wire.sendto(hostile(random, [request, reply, loop]), pair.reference.address)
            wire.sendto(hostile(random, [request, reply, loop]), client)
            sent += 1
        wire.sendto(reply, pair.reference.address)  # of the other kind
        wire.sendto(request, client)
        wire.sendto(loop, pair.reference.address)
        wire.sendto(loop, client)
        sent += 2
        _read(pair.reference, pair.reference.answer_all)
        _read(pair.client, pair.client.poll)
    assert (pair.reference.answered, pair.client.accepted) == (1, 0)
    assert pair.reference.rejected.total() == pair.client.rejected.total() == sent
    reasons = {Rejection.LENGTH, Rejection.VERSION, Rejection.FLOW, Rejection.TAG}
    assert set(pair.reference.rejected) == set(pair.client.rejected) == reasons


def _read(one: TimeReference | TimeClient, read: Callable[[], object]) -> None:
    while select.select([one], (), (), 0)[0]:
        read()


def test_a_reply_is_accepted_once_and_a_repeated_request_does_no_harm(
    stack: ExitStack, wire: socket.socket
) -> None:
    clocks = DrivenClocks(10**9)
    pair = Pair(stack, clocks, at=lambda _: wire.getsockname())
    pair.client.poll()
    request, client = received(wire, TimeKind.REQUEST)
    for _ in range(3):
        wire.sendto(request, pair.reference.address)
        _wait(10**6)
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
    pair.check(clocks)


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


def test_a_reference_that_is_gone_is_an_error_that_is_counted(stack: ExitStack) -> None:
    pair = Pair(stack, HostClocks())
    pair.exchange()
    pair.reference.close()
    for _ in range(10):
        pair.client.poll()
    assert pair.client.send_errors.total() + pair.client._arrivals.errors > 0


def test_an_address_in_use_is_a_callers_mistake(stack: ExitStack) -> None:
    pair = Pair(stack, HostClocks())
    with pytest.raises(CallerError, match=r"cannot listen on 127\.0\.0\.1"):
        TimeReference(pair.reference.address, KEY)
