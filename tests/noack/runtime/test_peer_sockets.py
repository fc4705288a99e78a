"""Datagrams from unknown sources: separated by the kernel, read within bounds, counted."""

import select
import socket
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing

import numpy as np
import pytest

from noack.protocol.machine_interface import Notice
from noack.protocol.wire_format import Decoder, Encoder, Flow, Message, Rejection
from noack.runtime import udp_sockets
from noack.runtime.address import LOOPBACK
from noack.runtime.peer_sockets import (
    IN_A_FLOOD,
    IN_AN_INTERVAL,
    FloodWatch,
    SourceCount,
    open_beside,
)
from noack.runtime.udp_sockets import SHED, MessageSocket, bind

RUN_ID, KEY = 7, bytes(range(32))


def opened() -> socket.socket:
    endpoint = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    endpoint.bind((LOOPBACK, 0))
    endpoint.setblocking(False)
    return endpoint


class Ear:
    """A sensor's socket, which receives measurements of two entries from ``peer``."""

    def __init__(self, peer: socket.socket, endpoint: socket.socket | None = None) -> None:
        self._endpoint = bind(0, "port") if endpoint is None else endpoint
        self.decoder = Decoder(Flow.MEASUREMENT, 2, RUN_ID, KEY)
        self.encoder = Encoder(RUN_ID, KEY)
        self.address = self._endpoint.getsockname()
        self.channel = MessageSocket(
            self._endpoint, self.decoder, self.encoder, Flow.UPDATE,
            source=peer.getsockname(), destination=peer.getsockname(),
        )  # fmt: skip
        self.lines: list[Notice] = []

    @staticmethod
    def message(sequence: int) -> Message:
        return Message(Flow.MEASUREMENT, sequence, sequence, np.array([1.0, 2.0]))

    def turns(self, most: int) -> list[int]:
        """Call the socket as the loop does, at most ``most`` times; return the sequence numbers."""
        received = []
        for _ in range(most):
            readable, _, _ = select.select(self.channel.watched, (), (), 0)
            if not readable:
                break
            message = self.channel.receive(readable[0])
            if message is not None:
                received.append(message.sequence)
        return received

    def tend(self) -> None:
        self.lines += self.channel.tend(0)

    def close(self) -> None:
        self.channel.close()
        self._endpoint.close()


BEGUN, OVER = "flood:", "the flood is over:"


def looked_at(watch: FloodWatch, came: int) -> int:
    """Pass ``came`` datagrams; return how many were not read."""
    looked = min(came, watch.left)
    watch.left -= looked
    return came - looked


def test_a_few_datagrams_from_unknown_sources_are_no_flood() -> None:
    watch = FloodWatch()
    for came in (0, 1, IN_AN_INTERVAL - 1, 0, IN_AN_INTERVAL - 1):
        assert looked_at(watch, came) == 0
        assert watch.next_interval(0) is None
        assert watch.left == IN_AN_INTERVAL


def test_a_flood_is_logged_once_and_its_end_with_the_drops() -> None:
    watch, dropped, lines = FloodWatch(), 7, []
    assert watch.next_interval(dropped) is not None  # the drops before the flood count as the first
    watch = FloodWatch()
    for _ in range(100):
        dropped_now = looked_at(watch, 5000)
        assert watch.left == 0
        dropped += dropped_now
        lines.append(watch.next_interval(dropped))
        assert watch.left == IN_A_FLOOD
    assert lines[0] is not None
    assert lines[0].startswith(BEGUN)
    assert lines[1:] == [None] * 99
    calm = 0
    while (line := watch.next_interval(dropped)) is None:
        calm += 1
    assert line == f"{OVER} the kernel dropped {dropped} datagrams from unknown sources"
    assert 10 <= calm <= 40  # between half a second and two seconds
    assert watch.left == IN_AN_INTERVAL


def test_a_pause_does_not_end_a_flood_and_moderate_traffic_does_not_prolong_it() -> None:
    watch, dropped = FloodWatch(), 0
    for interval in range(200):
        dropped += 2 * IN_AN_INTERVAL if interval % 10 == 0 else 0
        line = watch.next_interval(dropped)
        assert line is None or line.startswith(BEGUN)
    assert watch.is_flood
    for _ in range(100):
        dropped += looked_at(watch, IN_AN_INTERVAL // 2)
        if (line := watch.next_interval(dropped)) is not None:
            assert line.startswith(OVER)
            break
    assert not watch.is_flood
    assert looked_at(watch, IN_AN_INTERVAL // 2) == 0


def test_repeated_floods_log_a_bounded_number_of_lines() -> None:
    """A flood that pauses just long enough to end, repeated for two hours."""
    watch, dropped, lines = FloodWatch(), 0, 0
    for _ in range(2 * 3600 * 20):
        dropped += 0 if watch.is_flood else 1000
        lines += watch.next_interval(dropped) is not None
    assert 100 < lines < 2 * 60 * 3


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.fixture
def peer(stack: ExitStack) -> socket.socket:
    return stack.enter_context(opened())


@pytest.fixture
def stranger(stack: ExitStack) -> socket.socket:
    return stack.enter_context(opened())


@pytest.fixture
def ear(stack: ExitStack, peer: socket.socket) -> Ear:
    return stack.enter_context(closing(Ear(peer)))


needs_linux = pytest.mark.skipif(
    sys.platform != "linux", reason="only Linux keeps strangers' datagrams apart"
)


@needs_linux
def test_each_socket_receives_its_peer_and_the_port_cannot_be_bound_again(stack: ExitStack) -> None:
    endpoint, first, second, stranger = (stack.enter_context(opened()) for _ in range(4))
    beside = open_beside(endpoint, [first.getsockname(), second.getsockname()])
    for one in beside:
        stack.enter_context(one)
    for number, sender in enumerate((first, second, stranger)):
        for _ in range(number + 1):
            sender.sendto(bytes([number]), endpoint.getsockname())
    for number, one in enumerate((*beside, endpoint)):
        for _ in range(number + 1):
            assert one.recv(9) == bytes([number])
        with pytest.raises(BlockingIOError):
            one.recv(9)
    for option in (socket.SO_REUSEPORT, socket.SO_REUSEADDR):
        thief = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        thief.setsockopt(socket.SOL_SOCKET, option, 1)
        with pytest.raises(OSError, match="in use"):
            thief.bind(endpoint.getsockname())


@needs_linux
def test_a_flood_displaces_no_peer_datagram_and_all_are_counted(
    ear: Ear, peer: socket.socket, stranger: socket.socket
) -> None:
    stranger_sent = 0
    for round_ in range(10):
        for _ in range(1000):
            stranger.sendto(b"x" * 80, ear.address)
        peer.sendto(ear.encoder.encode(ear.message(round_)), ear.address)
        stranger_sent += 1000
        assert ear.turns(300) == [round_]
        ear.tend()
    report = ear.channel.report()
    rejected = report["rejected"]
    assert isinstance(rejected, dict)
    assert rejected[SHED] > 5000
    assert sum(rejected.values()) == stranger_sent
    assert report["accepted"] == 10
    assert report["lost_in_kernel"] == 0
    assert report["peer_sockets"] is True
    assert [line.text.split(":")[0] for line in ear.lines] == ["flood"]


@needs_linux
def test_a_peer_is_read_before_unknown_sources(
    ear: Ear, peer: socket.socket, stranger: socket.socket
) -> None:
    ear.tend()
    for _ in range(50):
        stranger.sendto(b"", ear.address)
    peer.sendto(ear.encoder.encode(ear.message(0)), ear.address)
    assert ear.turns(1) == [0]


@needs_linux
def test_work_between_two_clock_readings_is_bounded(ear: Ear, peer: socket.socket) -> None:
    """Forged sources put junk into the peer's socket; here the peer itself sends the junk."""
    for _ in range(100):
        peer.sendto(b"x", ear.address)
    assert ear.turns(1) == []
    assert 0 < ear.decoder.rejected[Rejection.LENGTH] <= 16


def test_datagrams_before_the_peer_sockets_are_read_first(
    stack: ExitStack, peer: socket.socket
) -> None:
    """A restarted process receives datagrams before it has a socket per peer."""
    endpoint = stack.enter_context(bind(0, "port"))
    encoder, early = Encoder(RUN_ID, KEY), 2 * IN_AN_INTERVAL
    for sequence in range(early):
        peer.sendto(encoder.encode(Ear.message(sequence)), endpoint.getsockname())
    ear = stack.enter_context(closing(Ear(peer, endpoint)))
    peer.sendto(encoder.encode(ear.message(early)), ear.address)
    assert ear.turns(2 * early) == list(range(early + 1))
    ear.tend()
    assert ear.lines == []


def test_the_loop_receives_without_peer_sockets(
    stack: ExitStack,
    peer: socket.socket,
    stranger: socket.socket,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(udp_sockets, "open_beside", lambda endpoint, peers: ())
    ear = stack.enter_context(closing(Ear(peer)))
    for _ in range(100):
        stranger.sendto(ear.encoder.encode(ear.message(7)), ear.address)
    peer.sendto(ear.encoder.encode(ear.message(0)), ear.address)
    assert ear.turns(30) == [0]
    ear.tend()
    report = ear.channel.report()
    assert report["rejected"] == {"source": 100}
    assert report["peer_sockets"] is False
    assert report["lost_in_kernel"] == 0
    assert ear.lines == []


def test_many_sources_take_bounded_memory_and_a_short_report() -> None:
    peer, rare = (LOOPBACK, 1), (LOOPBACK, 2)
    count = SourceCount([peer, rare])
    count.add(rare)
    total = 1
    for number in range(10_000):
        for source in (peer, (f"127.0.1.{number % 251}", number % 65_521)):
            count.add(source)
            total += 1
    assert len(count._others) <= 256
    report = count.report()
    assert report["127.0.0.1:1"] == 10_000
    assert report["127.0.0.1:2"] == 1
    assert len(report) <= 20
    assert sum(report.values()) == total
    assert count.report() == report


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has peer sockets")
def test_a_peer_socket_has_the_receive_buffer_of_the_first_one_from_the_start() -> None:
    with ExitStack() as stack:
        endpoint = stack.enter_context(bind(0, "port"))
        (one,) = map(stack.enter_context, open_beside(endpoint, [(LOOPBACK, 9)]))
        first, other = (s.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) for s in (endpoint, one))
        assert other == first
