"""Datagrams from unknown sources: separated by the kernel, counted; addresses in text form."""

import socket
from collections.abc import Iterator
from contextlib import ExitStack, closing
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem.core.address import LOOPBACK, Address, address_text, family_of, parse_address, parse_destination
from netem.core.errors import CallerError, PeerError
from netem.core.udp_sockets import enlarge_buffer
from noack.protocol.record_tables import SENSOR_MEASUREMENT
from noack.protocol.wire_format import Flow
from noack.runtime import counting_sockets
from noack.runtime.counting_sockets import DROPPED_IN_FLOOD, SourceCount, bind, open_beside
from noack.runtime.drivers.live_driver import LoopSockets
from tests.noack.runtime.drivers.live_loops import Live, measurement, scenario


def opened() -> socket.socket:
    endpoint = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    endpoint.bind((LOOPBACK, 0))
    endpoint.setblocking(False)
    return endpoint


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def test_each_socket_receives_its_peer_and_the_port_cannot_be_bound_again(stack: ExitStack) -> None:
    endpoint, first, second, unknown_sender = (stack.enter_context(opened()) for _ in range(4))
    beside = open_beside(endpoint, [first.getsockname(), second.getsockname()])
    for receiver in beside:
        stack.enter_context(receiver)
    for number, sender in enumerate((first, second, unknown_sender)):
        for _ in range(number + 1):
            sender.sendto(bytes([number]), endpoint.getsockname())
    for number, receiver in enumerate((*beside, endpoint)):
        for _ in range(number + 1):
            assert receiver.recv(9) == bytes([number])
        with pytest.raises(BlockingIOError):
            receiver.recv(9)
    for option in (socket.SO_REUSEPORT, socket.SO_REUSEADDR):
        second_endpoint = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        second_endpoint.setsockopt(socket.SOL_SOCKET, option, 1)
        with pytest.raises(OSError, match="in use"):
            second_endpoint.bind(endpoint.getsockname())


@pytest.mark.sanitized
def test_a_flood_displaces_no_peer_datagram_and_all_are_counted(content: dict[str, Any]) -> None:
    with closing(Live("sensor", [scenario(content)])) as live:
        sent = 0
        for round_ in range(10):
            for _ in range(1000):
                live.other.sendto(b"x" * 80, live.address)
            sent += 1000
            live.send(measurement(round_, [1.0, 0.0]))
            live.drive_until_accepted(round_ + 1)
            live.sockets.do_housekeeping(0, live.rows)
        while len(live.rows.notices) < 2:
            live.sockets.do_housekeeping(0, live.rows)
        live.sockets.finish(0, live.rows)
        report = live.sockets.report()
    rejected: Any = report["rejected"]
    assert rejected[DROPPED_IN_FLOOD] > 5000
    assert sum(rejected.values()) == sent
    assert report["accepted"] == 10
    assert report["kernel_drops"] == 0
    lines = [line.text.split(":")[0] for line in live.rows.notices]
    assert lines == ["flood", "the flood is over"]


def test_datagrams_before_the_peer_sockets_are_read_first(content: dict[str, Any]) -> None:
    """A process receives datagrams before it has a socket per peer."""
    early = 9000  # more than Python reads in one turn later

    def before(live: Live) -> None:
        enlarge_buffer(live.endpoint, 256 * 1024 * 1024)
        live.send(*(measurement(number, [1.0, 0.0]) for number in range(early)))

    with closing(Live("sensor", [scenario(content, horizon_s=10.0)], early=before)) as live:
        live.send(measurement(early, [1.0, 0.0]))
        live.sockets.do_housekeeping(0, live.rows)
        assert live.driver.accepted == early
        live.drive_until_accepted(early + 1)
        assert not any(live.driver.rejected.values())
        assert live.rows.notices == []
        numbers = [row[2] for row in live.rows.tables[SENSOR_MEASUREMENT]]
        assert numbers == list(range(early + 1))


def test_a_process_needs_a_socket_for_each_peer(
    content: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    own = (LOOPBACK, 9)
    with closing(Live("sensor", [scenario(content)])) as live, closing(bind(0, "port")) as endpoint:
        monkeypatch.setattr(counting_sockets, "open_beside", lambda endpoint, peers: ())
        with pytest.raises(PeerError, match="refused to open a socket for each peer"):
            LoopSockets(endpoint, live.driver, Flow.UPDATE, source=own, destination=own)


@pytest.mark.sanitized
def test_many_sources_take_bounded_memory_and_a_short_report() -> None:
    peer, rare = (LOOPBACK, 1), (LOOPBACK, 2)
    count = SourceCount([peer, rare])
    count.add(rare)
    total = 1
    for number in range(10_000):
        for source in (peer, (f"127.0.1.{number % 251}", number % 65_521)):
            count.add(source)
            total += 1
    assert len(count.others) <= 256
    report = count.report()
    assert report["127.0.0.1:1"] == 10_000
    assert report["127.0.0.1:2"] == 1
    assert len(report) <= 20
    assert sum(report.values()) == total
    assert count.report() == report


# --- addresses ------------------------------------------------------------------------------------


@pytest.mark.sanitized
@given(st.one_of(st.ip_addresses(v=4), st.ip_addresses(v=6)), st.integers(0, 65_535))
def test_addresses_survive_formatting_and_parsing(host: object, port: int) -> None:
    address = (str(host), port)
    read = parse_address(address_text(address), "here")
    family = family_of(address)
    assert socket.inet_pton(family, read[0]) == socket.inet_pton(family, address[0])
    assert read[1] == port


@pytest.mark.parametrize(
    ("text", "like", "address"),
    [
        (":9000", None, ("127.0.0.1", 9000)),
        (":9000", ("::1", 1), ("::1", 9000)),
        ("localhost:9000", None, ("127.0.0.1", 9000)),
        ("[::1]:9000", ("192.0.2.1", 1), ("::1", 9000)),
    ],
)
def test_a_missing_host_means_loopback_of_the_same_family(
    text: str, like: Address | None, address: Address
) -> None:
    assert parse_address(text, "here", like) == address


def test_a_destination_has_a_port() -> None:
    assert parse_destination(":9001", "--to") == ("127.0.0.1", 9001)
    with pytest.raises(CallerError, match="--to: expected a port from 1 to 65535; found ':0'"):
        parse_destination(":0", "--to")
