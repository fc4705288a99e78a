"""Datagrams from unknown sources: separated by the kernel, read within bounds, counted."""

import socket
from collections.abc import Iterator
from contextlib import ExitStack, closing
from typing import Any

import pytest

from noack.core.errors import PeerError
from noack.protocol.record_tables import SENSOR_MEASUREMENT
from noack.protocol.wire_format import Flow
from noack.runtime import udp_sockets
from noack.runtime.address import LOOPBACK
from noack.runtime.live_driver import LoopChannel
from noack.runtime.udp_sockets import (
    IN_A_FLOOD,
    IN_AN_INTERVAL,
    SHED,
    FloodWatch,
    SourceCount,
    bind,
    enlarge_buffer,
    open_beside,
)
from tests.noack.runtime.live_loops import Live, measurement, scenario


def opened() -> socket.socket:
    endpoint = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    endpoint.bind((LOOPBACK, 0))
    endpoint.setblocking(False)
    return endpoint


BEGUN, OVER = "flood:", "the flood is over:"


def looked_at(watch: FloodWatch, came: int) -> int:
    """Pass ``came`` datagrams; return how many were not read."""
    looked = min(came, watch.left)
    watch.left -= looked
    return came - looked


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


def test_a_flood_displaces_no_peer_datagram_and_all_are_counted(content: dict[str, Any]) -> None:
    with closing(Live("sensor", [scenario(content)])) as live:
        sent = 0
        for round_ in range(10):
            for _ in range(1000):
                live.other.sendto(b"x" * 80, live.address)
            sent += 1000
            live.send(measurement(round_, [1.0, 0.0]))
            live.drive_until_accepted(round_ + 1)
            live.channel.tend(0, live.rows)
        live.channel.finish(0, live.rows)
        report = live.channel.report()
    rejected: Any = report["rejected"]
    assert rejected[SHED] > 5000
    assert sum(rejected.values()) == sent
    assert report["accepted"] == 10
    assert report["kernel_drops"] == 0
    assert [line.text.split(":")[0] for line in live.rows.notices] == ["flood"]


def test_datagrams_before_the_peer_sockets_are_read_first(content: dict[str, Any]) -> None:
    """A restarted process receives datagrams before it has a socket per peer."""
    early = 9000  # more than Python reads in one turn later

    def before(live: Live) -> None:
        enlarge_buffer(live.endpoint, 256 * 1024 * 1024)
        live.send(*(measurement(number, [1.0, 0.0]) for number in range(early)))

    with closing(Live("sensor", [scenario(content, horizon_s=10.0)], early=before)) as live:
        live.send(measurement(early, [1.0, 0.0]))
        live.channel.tend(0, live.rows)
        assert live.driver.accepted == early
        live.drive_until_accepted(early + 1)
        assert not any(live.driver.rejected.values())
        assert live.rows.notices == []
        numbers = [row[2] for row in live.rows.tables[SENSOR_MEASUREMENT]]
        assert numbers == list(range(early + 1))


def test_of_strangers_datagrams_python_reads_a_bounded_number_at_a_turn(
    content: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Datagrams may come faster than Python reads them: it must not read until there are none."""
    with closing(Live("sensor", [scenario(content)])) as live:
        taken = list[bytes]()

        def take(data: bytes, *_: Any) -> None:
            taken.append(data)
            live.other.sendto(b"y", live.address)

        monkeypatch.setattr(live.channel, "take", take)
        live.other.sendto(b"x", live.address)
        live.channel.tend(0, live.rows)
        assert len(taken) == IN_AN_INTERVAL


def test_authentic_datagrams_of_others_are_replays(content: dict[str, Any]) -> None:
    with closing(Live("sensor", [scenario(content)])) as live:
        for number in range(100):
            live.send(measurement(number, [1.0, 0.0]), by=live.other)
        live.send(measurement(0, [1.0, 0.0]))
        live.drive_until_accepted(1)
        live.channel.finish(0, live.rows)
        report = live.channel.report()
        names = ["{}:{}".format(*one.getsockname()) for one in (live.peer, live.other)]
    assert report["rejected"] == {"source": 100}
    assert report["received_from"] == dict(zip(names, (1, 100), strict=True))
    assert live.rows.notices == []


def test_a_process_needs_a_socket_for_each_peer(
    content: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    own = (LOOPBACK, 9)
    with closing(Live("sensor", [scenario(content)])) as live, closing(bind(0, "port")) as endpoint:
        monkeypatch.setattr(udp_sockets, "open_beside", lambda endpoint, peers: ())
        with pytest.raises(PeerError, match="refused to open a socket for each peer"):
            LoopChannel(endpoint, live.driver, Flow.UPDATE, source=own, destination=own)


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


def test_a_peer_socket_has_the_receive_buffer_of_the_first_one_from_the_start() -> None:
    with ExitStack() as stack:
        endpoint = stack.enter_context(bind(0, "port"))
        (one,) = map(stack.enter_context, open_beside(endpoint, [(LOOPBACK, 9)]))
        first, other = (s.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) for s in (endpoint, one))
        assert other == first
