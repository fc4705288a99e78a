"""The externally visible behaviour of the relay."""

import errno
import os
import resource
import socket
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pytest

from netem.core import udp_sockets
from netem.core.address import address_text
from netem.core.errors import CallerError
from netem.relay import client_table
from netem.relay.relay_reports import DirectionReport
from netem.tc_words import settings_of
from tests.netem.relay.relays import HOSTS, Received, drain, endpoints, link, name_of, relayed, running

IP_VERSIONS = pytest.mark.parametrize(("here", "there"), [(4, 4), (4, 6), (6, 4), (6, 6)])
V4 = HOSTS[4]
UDP_SEGMENT = 103
THIRD_LOST = settings_of("loss periodic 1/3")


def numbers(datagrams: Received) -> list[int]:
    return [int.from_bytes(data[:4], "big") for data, _ in datagrams]


def send_numbers(client: socket.socket, to: Any, begin: int, end: int) -> None:
    for number in range(begin, end):
        client.sendto(number.to_bytes(4, "big"), to)


@contextmanager
def no_descriptors_left(clients: Sequence[socket.socket]) -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = max(client.fileno() for client in clients) + 2
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@IP_VERSIONS
def test_both_directions_work_over_both_versions_of_ip(here: int, there: int) -> None:
    """Only the server's answers reach a client."""
    with endpoints(*[HOSTS[there]] * 2, *[HOSTS[here]] * 2) as (server, stranger, *clients):
        with running([link(name_of(server), host=HOSTS[here])]) as emulator:
            for client in clients:
                client.sendto(b"question", emulator.address())
            for data, source in emulator.receive(server, 2):
                assert data == b"question"
                server.sendto(b"answer to %d" % source[1], source)
                stranger.sendto(b"lie", source)
            answers = [emulator.receive(client)[0] for client in clients]
            assert {source for _, source in answers} == {emulator.address()}
            assert len({data for data, _ in answers}) == 2
            emulator.settle(2, "reverse")
            assert all(drain(client) == [] for client in clients)
            report = emulator.report()
        assert (report.clients, report.clients_ever) == (2, 2)
        addresses = {address_text(name_of(client)) for client in clients}
        assert {flow.client for flow in report.forward.flows} == addresses


@IP_VERSIONS
def test_a_one_way_link_sends_from_one_port_and_discards_answers(here: int, there: int) -> None:
    """If the relay took an answer for a client's datagram, it would loop to the server forever."""
    with endpoints(HOSTS[there], HOSTS[here], HOSTS[here]) as (server, *clients):
        spec = link(name_of(server), host=HOSTS[here], return_path=False)
        with running([spec]) as emulator:
            sources = set()
            for client in clients:
                client.sendto(b"x", emulator.address())
                ((data, source),) = emulator.receive(server)
                assert data == b"x"
                sources.add(source)
                for _ in range(5):
                    server.sendto(b"answer", source)
            emulator.settle(2)
            report = emulator.report()
            assert drain(server) == []
    assert (report.clients_ever, report.forward.counters.received) == (2, 2)
    assert report.reverse.counters.received == 0
    if sys.platform == "linux":
        assert report.discarded == 10
    assert len(sources) == 1


def test_seven_hundred_clients_keep_their_flows_and_answers_apart() -> None:
    """For 700 clients, the relay loads their data before the decisions."""
    with endpoints(V4) as (server,), endpoints(*[V4] * 700) as clients:
        ports = [name_of(client)[1] for client in clients]
        with running([link(name_of(server), THIRD_LOST)]) as emulator:
            for number in range(3):
                for client, port in zip(clients, ports, strict=True):
                    client.sendto(b"%d %d" % (port, number), emulator.address())
                emulator.settle(700 * (number + 1))
            arrived: dict[int, list[int]] = {}
            for data, path in emulator.receive(server, 1400):
                port, number = map(int, data.split())
                arrived.setdefault(port, []).append(number)
                if len(arrived[port]) == 2:
                    server.sendto(b"%d" % port, path)
            for client, port in zip(clients, ports, strict=True):
                assert [data for data, _ in emulator.receive(client)] == [b"%d" % port]
            report = emulator.report()
    (order,) = set(map(tuple, arrived.values()))  # each flow has the same loss pattern
    assert list(order) == sorted(order)
    assert sorted(arrived) == sorted(ports)
    counters = report.forward.counters
    assert (report.clients, counters.received, counters.dropped) == (700, 2100, 700)


def test_an_absent_server_is_reported_and_causes_no_later_loss(
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Each datagram to a closed port causes an ICMP error, which must not fail the next send."""
    with endpoints(V4, V4) as (reserved, client):
        address = name_of(reserved)
        with running([link(address)]) as emulator:
            reserved.close()
            send_numbers(client, emulator.address(), 0, 50)
            emulator.settle(50)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
                server.bind(address)
                server.setblocking(False)
                send_numbers(client, emulator.address(), 50, 100)
                emulator.settle(100)
                assert numbers(drain(server)) == list(range(50, 100))
            report = emulator.report()
    assert report.forward.counters.forwarded == 100
    assert report.forward.unintended == {"lost_in_kernel": 0}
    assert report.port_unreachable > 0
    assert capfd.readouterr().err == (
        f"noack-netem: link test: nothing listens on {address[0]}:{address[1]} "
        "(ICMP port unreachable); what is sent there is lost\n"
    )


def test_a_change_keeps_flows_and_datagrams_in_flight() -> None:
    late, lossy = settings_of("delay 500ms mansd 1"), settings_of("loss worst mansd 1")
    with relayed(late) as (server, client, emulator):
        send_numbers(client, emulator.address(), 0, 4)
        emulator.until(lambda: emulator.report().forward.counters.received == 4)
        emulator.relay.change("test", "forward", lossy)
        send_numbers(client, emulator.address(), 4, 8)
        emulator.settle(8)
        # The datagrams in flight keep their order; after them, every second one is lost.
        assert numbers(drain(server)) == [0, 1, 2, 3, 5, 7]
        report = emulator.report()
        assert report.forward.settings == lossy
        assert report.forward.flows[0].packets == 8
        with pytest.raises(CallerError, match="no such link; links: "):
            emulator.relay.change("another", "reverse", late)


def test_a_client_with_datagrams_in_flight_or_unread_is_not_idle() -> None:
    """Although it sends nothing for longer than the idle time."""
    slow = settings_of("loss worst mansd 3 delay 300ms")
    with relayed(slow, idle_s=0.05) as (server, client, emulator):
        send_numbers(client, emulator.address(), 0, 4)
        assert numbers(emulator.receive(server)) == [3]
        emulator.until(lambda: emulator.report().clients == 0)
        client.sendto(b"0", emulator.address())
        emulator.settle(5)
        send_numbers(client, emulator.address(), 1, 4)
        time.sleep(1.2)  # a stall
        emulator.settle(8)
        report = emulator.report()
    assert (report.clients_ever, report.forward.counters.forced) == (2, 2)


def test_more_clients_than_allowed_are_refused_and_counted(
    capfd: pytest.CaptureFixture[str],
) -> None:
    with relayed(most_clients=2, idle_s=0.3, clients=3) as (server, *clients, emulator):
        for client in clients * 2:
            client.sendto(b"x", emulator.address())
        emulator.until(lambda: emulator.report().refused == 2)
        assert emulator.report().clients == 2
        emulator.until(lambda: emulator.report().clients == 0)
        drain(server)
        clients[2].sendto(b"now", emulator.address())
        assert emulator.receive(server)[0][0] == b"now"
        with no_descriptors_left(clients):
            clients[0].sendto(b"x", emulator.address())
            emulator.until(lambda: emulator.report().refused == 3)
    error = capfd.readouterr().err
    assert error.count("at most 2 clients can be served at once") == 1
    assert error.count("no file descriptors are left") == 1


def test_a_link_without_clients_tries_again_after_a_lack_of_descriptors() -> None:
    """With a client it waits for the end of one; without, nothing would end the wait."""
    with relayed() as (server, client, emulator):
        with no_descriptors_left([client]):
            client.sendto(b"x", emulator.address())
            emulator.until(lambda: emulator.report().refused > 0)
        emulator.until(lambda: not emulator.relay._directions[0].row.full)
        client.sendto(b"now", emulator.address())
        assert emulator.receive(server)[0][0] == b"now"


def test_a_return_path_that_could_not_be_opened_is_opened_later(monkeypatch: pytest.MonkeyPatch) -> None:
    lost = {"lost_in_kernel": 0, os.strerror(errno.ENETUNREACH): 1}
    with relayed(clients=2) as (server, client, other, emulator):
        with monkeypatch.context() as patch:
            patch.setattr(client_table, "return_path", lambda _: (None, errno.ENETUNREACH))
            client.sendto(b"before", emulator.address())
            emulator.until(lambda: emulator.report().forward.unintended == lost)
        other.sendto(b"other", emulator.address())
        assert emulator.receive(server)[0][0] == b"other"
        emulator.until(lambda: not emulator.relay._clients._without_path)
        client.sendto(b"after", emulator.address())
        assert emulator.receive(server)[0][0] == b"after"
        assert emulator.report().forward.unintended == lost


@pytest.mark.parametrize("return_path", [True, False])
def test_send_errors_are_counted_by_reason(return_path: bool, capfd: pytest.CaptureFixture[str]) -> None:
    """The kernel refuses broadcasts from a socket without the broadcast option."""
    spec = link(("255.255.255.255", 9), return_path=return_path)
    with endpoints(V4) as (client,), running([spec]) as emulator:
        send_numbers(client, emulator.address(), 0, 10)
        emulator.settle(10)
        report = emulator.report()
    assert report.forward.unintended == {"lost_in_kernel": 0, "Permission denied": 10}
    assert "could not be sent (Permission denied)" in capfd.readouterr().err


def test_datagrams_beyond_the_available_memory_are_dropped_and_counted() -> None:
    with relayed(settings_of("delay 1000s")) as (_, client, emulator):
        client.sendto(b"stored", emulator.address())
        emulator.until(lambda: emulator.report().forward.in_flight == 1)
        emulator.relay._memory.core.headroom_bytes = 2**60
        for _ in range(50):
            client.sendto(bytes(60_000), emulator.address())
        emulator.until(lambda: all_of(emulator.report().forward) == 51)
        forward = emulator.report().forward
    assert forward.unintended[os.strerror(errno.ENOMEM)] > 10
    assert forward.in_flight == forward.counters.received


def all_of(direction: DirectionReport) -> int:
    """Return the number of datagrams that were received or were lost unintentionally."""
    return direction.counters.received + sum(direction.unintended.values())


@pytest.mark.parametrize("segment", [False, True])
def test_all_kernel_drops_are_counted(
    segment: bool, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Each segment counts, although the client sends 64 of them in one call."""
    monkeypatch.setattr(udp_sockets, "_BUFFER_BYTES", 16_384)
    size, many = 72, 1280
    with relayed(host=HOSTS[6], segment=segment) as (server, client, emulator):
        client.connect(emulator.address())
        client.setsockopt(socket.IPPROTO_UDP, UDP_SEGMENT, size)
        for _ in range(many // 64):
            client.send(bytes(size * 64))
        emulator.until(lambda: all_of(emulator.report().forward) == many)
        send_numbers(server, drain(server)[0][1], 0, 300)
        emulator.until(lambda: all_of(emulator.report().reverse) == 300)
        report = emulator.report()
    error = capfd.readouterr().err
    for side in ("forward", "reverse"):
        assert getattr(report, side).unintended["lost_in_kernel"] > 150
        assert f"link test, {side}:" in error
    assert "lost in the kernel" in error


def test_every_departure_is_in_the_histogram_of_delays() -> None:
    many = 500
    with relayed(settings_of("loss 50%")) as (_, client, emulator):
        send_numbers(client, emulator.address(), 0, many)
        emulator.settle(many)
        report = emulator.report()
    assert report.forward.delays.sum() == report.forward.counters.forwarded
    assert report.forward.lateness.sum() == 0
