"""The externally visible behaviour of both engines."""

import errno
import io
import select
import socket
import struct
import sys
import threading
import time
from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from netem.engine import engine_choice as starting
from netem.engine.engine_choice import Engine, open_relay
from netem.engine.relay_interface import LinkSpec
from netem.engine.relay_sockets import raise_file_limit
from noack.core.errors import CallerError
from noack.impairments.kinds.corrupt import Corrupt
from noack.impairments.kinds.delay import Delay
from noack.impairments.kinds.duplicate import Duplicate
from noack.impairments.kinds.loss import LossOf
from noack.impairments.link_records import RecordedDecision
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_models.bernoulli import BernoulliLoss
from noack.impairments.loss_models.periodic_loss import PeriodicLoss
from noack.impairments.loss_models.worst_case import WorstCaseLoss
from noack.protocol.record_tables import Fate
from tests.netem.engine.relays import HOSTS, KeepAll, drain, endpoints, link, name_of, running

ENGINES: Sequence[Engine] = ("batched", "plain")
pytestmark = pytest.mark.parametrize("engine", ENGINES)
HALF = LossOf(loss=BernoulliLoss(probability=0.5))
UDP_SEGMENT, SEGMENTS = 103, 64


def numbers(datagrams: Sequence[tuple[bytes, Any]]) -> list[int]:
    return [int.from_bytes(data[:4], "big") for data, _ in datagrams]


@pytest.mark.parametrize("client_side", [4, 6])
@pytest.mark.parametrize("server_side", [4, 6])
def test_both_directions_work_over_both_versions_of_ip(
    engine: Engine, client_side: int, server_side: int
) -> None:
    here, far = HOSTS[client_side], HOSTS[server_side]
    with endpoints(far, here, here) as (server, *clients):
        with running([link(name_of(server), host=here)], engine) as one:
            there = one.relay.addresses()["test"]
            for client in clients:
                client.sendto(b"question", there)
            for _ in clients:
                data, source = server.recvfrom(100)
                assert data == b"question"
                server.sendto(b"answer to %d" % source[1], source)
            answers = [client.recvfrom(100) for client in clients]
            assert {source[:2] for _, source in answers} == {there}
            assert len({data for data, _ in answers}) == 2
            report = one.report()
        assert (report.clients, report.clients_ever) == (2, 2)
        assert {flow.client for flow in report.forward.flows} == set(map(name_of, clients))


@pytest.mark.parametrize("client_side", [4, 6])
@pytest.mark.parametrize("server_side", [4, 6])
def test_a_one_way_link_sends_from_one_port_and_discards_answers(
    engine: Engine, client_side: int, server_side: int
) -> None:
    """If the relay took an answer for a client's datagram, it would loop to the server forever."""
    here, far = HOSTS[client_side], HOSTS[server_side]
    tap = KeepAll()
    with endpoints(far, here, here) as (server, *clients):
        spec = link(name_of(server), host=here, return_path=False)
        with running([spec], engine, taps=[tap]) as one:
            sources = set()
            for client in clients:
                client.sendto(b"x", one.relay.addresses()["test"])
                data, source = server.recvfrom(10)
                assert data == b"x"
                sources.add(source[:2])
                for _ in range(5):
                    server.sendto(b"answer", source)
            one.settled(2)
            report = one.report()
            assert drain(server) == []
    assert len(sources) == 1
    assert (report.clients_ever, report.forward.counters.received) == (2, 2)
    assert report.reverse.counters.received == 0
    if sys.platform == "linux":
        assert report.discarded == 10
    ports = tap.events["source_port"][tap.events["departure"] == 1]
    assert {port for _, port in sources} == set(ports.tolist())


def test_answers_from_another_address_of_the_server_do_not_make_it_a_client(engine: Engine) -> None:
    with endpoints("0.0.0.0", HOSTS[4]) as (server, client):
        spec = link(("127.0.0.2", name_of(server)[1]), return_path=False)
        with running([spec], engine) as one:
            client.sendto(b"x", one.relay.addresses()["test"])
            server.sendto(b"answer", server.recvfrom(10)[1])
            one.settled(1)
            assert drain(server) == []
            assert one.report().clients_ever == 1


def test_only_answers_of_the_server_reach_the_client(engine: Engine) -> None:
    with (
        endpoints(*[HOSTS[4]] * 3) as (server, client, stranger),
        running([link(name_of(server))], engine) as one,
    ):
        client.sendto(b"question", one.relay.addresses()["test"])
        _, path = server.recvfrom(100)
        stranger.sendto(b"lie", path)
        server.sendto(b"truth", path)
        assert client.recv(100) == b"truth"
        assert drain(client) == []
        assert one.report().reverse.counters.received == 1


def test_an_absent_server_is_reported_and_causes_no_later_loss(
    engine: Engine, capfd: pytest.CaptureFixture[str]
) -> None:
    """Each datagram to a closed port causes an ICMP error, which must not fail the next send."""
    with endpoints(HOSTS[4], HOSTS[4]) as (reserved, client):
        address = name_of(reserved)
        with running([link(address)], engine) as one:
            there = one.relay.addresses()["test"]
            reserved.close()
            for number in range(50):
                client.sendto(number.to_bytes(4, "big"), there)
            one.settled(50)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
                server.bind(address)
                for number in range(50, 100):
                    client.sendto(number.to_bytes(4, "big"), there)
                one.settled(100)
                assert numbers(drain(server)) == list(range(50, 100))
            report = one.report()
    assert report.forward.counters.forwarded == 100
    assert report.forward.unintended == {"lost_in_kernel": 0}
    assert report.port_unreachable > 0
    said = capfd.readouterr().err
    assert said == (
        f"noack netem: link test: nothing listens on {address[0]}:{address[1]} "
        "(ICMP port unreachable); what is sent there is lost\n"
    )


@pytest.mark.parametrize("size", [0, 1, 511, 512, 513, 1472, 65_507])
@pytest.mark.parametrize("delay_s", [0.0, 0.002])
def test_datagrams_of_any_size_and_their_copies_arrive(
    engine: Engine, size: int, delay_s: float
) -> None:
    payload = bytes(np.random.default_rng(size).integers(0, 256, size, np.uint8))
    ways = (Duplicate(probability=1), Delay(delay_s=delay_s), Corrupt(probability=1))
    there_and_back = LinkSettings(impairments=ways[:2]), LinkSettings(impairments=ways)
    with (
        endpoints(HOSTS[4], HOSTS[4]) as (server, client),
        running([link(name_of(server), *there_and_back)], engine) as one,
    ):
        for _ in range(5):
            client.sendto(payload, one.relay.addresses()["test"])
        for _ in range(10):
            data, source = server.recvfrom(65_536)
            assert data == payload
        server.sendto(payload, source)
        for _ in range(2):
            found = client.recv(65_536)
            assert len(found) == size
            flipped = np.bitwise_count(
                np.frombuffer(found, np.uint8) ^ np.frombuffer(payload, np.uint8)
            )
            assert flipped.sum() == (1 if size else 0)


def test_a_change_keeps_flows_and_datagrams_in_flight(engine: Engine) -> None:
    late = LinkSettings(impairments=(Delay(delay_s=0.05),), mansd=1)
    lossy = LinkSettings(impairments=(LossOf(loss=WorstCaseLoss()),), mansd=1)
    with (
        endpoints(HOSTS[4], HOSTS[4]) as (server, client),
        running([link(name_of(server), late)], engine) as one,
    ):
        there = one.relay.addresses()["test"]

        def send(begin: int) -> None:
            for number in range(begin, begin + 4):
                client.sendto(number.to_bytes(4, "big"), there)

        send(0)
        one.until(lambda: one.relay.report()[0].forward.in_flight == 4)
        one.ask(lambda: one.relay.change("test", "forward", lossy))
        send(4)
        one.settled(8)
        # The datagrams in flight keep their order; after them, every second one is lost.
        assert numbers(drain(server)) == [0, 1, 2, 3, 5, 7]
        report = one.report()
        assert report.forward.settings == lossy
        assert report.forward.flows[0].packets == 8
        with pytest.raises(CallerError, match="none of this name"):
            one.ask(lambda: one.relay.change("another", "reverse", late))


def test_idle_clients_are_forgotten_and_come_back_as_new_flows(engine: Engine) -> None:
    third = LinkSettings(impairments=(LossOf(loss=PeriodicLoss(period=3)),))
    with (
        endpoints(HOSTS[4], HOSTS[4]) as (server, client),
        running([link(name_of(server), third, idle_s=0.05)], engine) as one,
    ):
        there, found = one.relay.addresses()["test"], []
        for flow in range(3):
            for number in range(4):
                client.sendto(bytes([flow, number]), there)
            one.settled(4 * (flow + 1))
            found.append([data for data, _ in drain(server)])
            report = one.report()
            assert [(f.flow, f.packets) for f in report.forward.flows] in ([(flow, 4)], [])
            one.until(lambda: one.relay.report()[0].clients == 0)
            assert one.report().clients_ever == flow + 1
    assert found == [[bytes([flow, 1]), bytes([flow, 2])] for flow in range(3)]


def test_a_client_with_datagrams_in_flight_is_not_idle(engine: Engine) -> None:
    late = LinkSettings(impairments=(Delay(delay_s=0.9),))
    with (
        endpoints(HOSTS[4], HOSTS[4]) as (server, client),
        running([link(name_of(server), late, idle_s=0.01)], engine) as one,
    ):
        client.sendto(b"late", one.relay.addresses()["test"])
        assert server.recv(10) == b"late"
        one.until(lambda: one.relay.report()[0].clients == 0)


def test_a_client_with_unread_datagrams_is_not_idle(engine: Engine) -> None:
    """A stall longer than the idle time does not make clients with queued datagrams idle."""
    cap = LinkSettings(impairments=(LossOf(loss=WorstCaseLoss()),), mansd=3)
    with (
        endpoints(HOSTS[4], HOSTS[4]) as (server, client),
        running([link(name_of(server), cap, idle_s=0.3)], engine) as one,
    ):
        there = one.relay.addresses()["test"]
        client.sendto(b"0", there)
        one.settled(1)
        stopped = threading.Thread(target=one.ask, args=(lambda: time.sleep(1.5),))
        stopped.start()
        time.sleep(0.2)
        for _ in range(3):
            client.sendto(b"x", there)
        stopped.join()
        one.settled(4)
        report = one.report()
    assert (report.clients_ever, report.forward.counters.forced) == (1, 1)


def test_more_clients_than_allowed_are_refused_and_counted(
    engine: Engine, capfd: pytest.CaptureFixture[str]
) -> None:
    with (
        endpoints(*[HOSTS[4]] * 4) as (server, *clients),
        running([link(name_of(server), most_clients=2, idle_s=0.3)], engine) as one,
    ):
        there = one.relay.addresses()["test"]
        for client in clients * 2:
            client.sendto(b"x", there)
        one.until(lambda: one.relay.report()[0].refused == 2)
        assert one.report().clients == 2
        one.until(lambda: one.relay.report()[0].clients == 0)
        drain(server)
        clients[2].sendto(b"now", there)
        assert server.recv(10) == b"now"
    assert capfd.readouterr().err.count("no more than 2 clients at once") == 1


def test_a_lack_of_file_descriptors_is_reported_and_counted(
    engine: Engine, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import resource

    with endpoints(*[HOSTS[4]] * 13) as (server, *clients):
        spec = link(name_of(server))
        with running([spec], engine, start=False) as one:
            limit = resource.getrlimit(resource.RLIMIT_NOFILE)
            used = max(server.fileno(), *(client.fileno() for client in clients)) + 8
            resource.setrlimit(resource.RLIMIT_NOFILE, (used, limit[1]))
            try:
                one.start()
                for client in clients:
                    client.sendto(b"x", one.relay.addresses()["test"])
                one.until(lambda: sum_of(one.relay.report()[0]) == len(clients))
                report = one.report()
                one.stop()
            finally:
                resource.setrlimit(resource.RLIMIT_NOFILE, limit)
    assert report.refused > 0
    assert "no file descriptors are left" in capfd.readouterr().err


def sum_of(report: Any) -> int:
    return int(report.refused + report.forward.counters.received)


@pytest.mark.parametrize("return_path", [True, False])
def test_send_errors_are_counted_by_reason(
    engine: Engine, return_path: bool, capfd: pytest.CaptureFixture[str]
) -> None:
    """The kernel refuses broadcasts from a socket without the broadcast option."""
    with endpoints(HOSTS[4]) as (client,):
        spec = link(("255.255.255.255", 9), return_path=return_path)
        with running([spec], engine) as one:
            for _ in range(10):
                client.sendto(b"x", one.relay.addresses()["test"])
            one.settled(10)
            report = one.report()
    assert report.forward.unintended == {"lost_in_kernel": 0, "Permission denied": 10}
    assert "could not be sent (Permission denied)" in capfd.readouterr().err


@pytest.mark.parametrize("version", [4, 6])
def test_all_kernel_drops_are_counted(
    engine: Engine, version: int, capfd: pytest.CaptureFixture[str]
) -> None:
    host, many = HOSTS[version], 20_000
    with (
        endpoints(host, host) as (server, client),
        running([link(name_of(server), host=host)], engine, start=False) as one,
    ):
        there = one.relay.addresses()["test"]
        for _ in range(many):
            client.sendto(b"x", there)
        one.start()
        one.until(lambda: all_of(one.relay.report()[0].forward) == many)
        _, path = server.recvfrom(10)

        def answer() -> None:
            for _ in range(many):
                server.sendto(b"y", path)

        one.ask(answer)
        one.until(lambda: all_of(one.relay.report()[0].reverse) == many)
        report = one.report()
    for way in (report.forward, report.reverse):
        assert way.unintended["lost_in_kernel"] > 1000
    said = capfd.readouterr().err
    assert "link test, forward:" in said
    assert "link test, reverse:" in said
    assert "lost in the kernel" in said


def test_all_kernel_drops_of_segmented_messages_are_counted(engine: Engine) -> None:
    """Each segment counts, although the client sends them in one call."""
    messages, size = 3000, 72
    with (
        endpoints(HOSTS[4], HOSTS[4]) as (server, client),
        running([link(name_of(server))], engine, segment=True, start=False) as one,
    ):
        client.connect(one.relay.addresses()["test"])
        client.setsockopt(socket.IPPROTO_UDP, UDP_SEGMENT, size)
        for _ in range(messages):
            client.send(bytes(size * SEGMENTS))
        one.start()
        one.until(lambda: all_of(one.relay.report()[0].forward) == messages * SEGMENTS)
        assert one.report().forward.unintended["lost_in_kernel"] > 1000


def all_of(way: Any) -> int:
    return int(way.counters.received + way.unintended["lost_in_kernel"])


@pytest.mark.parametrize("segment", [False, True])
def test_segments_are_separate_datagrams(engine: Engine, segment: bool) -> None:
    """The client sends one message, and the kernel cuts it into segments."""
    third = LinkSettings(impairments=(LossOf(loss=PeriodicLoss(period=3)),))
    with (
        endpoints(HOSTS[4], HOSTS[4]) as (server, client),
        running([link(name_of(server), third)], engine, segment=segment) as one,
    ):
        client.connect(one.relay.addresses()["test"])
        sizes = [(1000, 60), (1400, 40), (8, 64), (30, 1)]
        sent, total = [], 0
        for size, count in sizes:
            run = [bytes([number % 251]) * size for number in range(count)]
            run[-1] = run[-1][: size // 2]
            client.sendmsg(
                [b"".join(run)], [(socket.IPPROTO_UDP, UDP_SEGMENT, struct.pack("=H", size))]
            )
            sent += run
            total += count
        one.settled(total)
        assert one.report().forward.counters.received == total
        kept = [data for number, data in enumerate(sent) if number % 3]
        assert [data for data, _ in drain(server)] == kept


def test_links_are_independent(engine: Engine) -> None:
    half = LinkSettings(impairments=(HALF,))
    with endpoints(*[HOSTS[4]] * 3) as (one_server, other_server, client):
        specs = [
            link(name_of(server), half, name=name)
            for server, name in ((one_server, "one"), (other_server, "other"))
        ]
        with running(specs, engine) as relay:
            for number in range(200):
                for there in relay.relay.addresses().values():
                    client.sendto(number.to_bytes(4, "big"), there)
            relay.settled(200, number=0)
            relay.settled(200, number=1)
            found = [numbers(drain(server)) for server in (one_server, other_server)]
    assert found[0] != found[1]
    assert all(60 < len(kept) < 140 for kept in found)


class CountOnly:
    """A tap that does not read payloads."""

    wants_data = False

    def __init__(self) -> None:
        self.arrivals = self.departures = self.bytes = 0

    def take(self, events: NDArray[Any], data: NDArray[np.uint8]) -> None:
        self.departures += int(events["departure"].sum())
        self.arrivals += int((events["departure"] == 0).sum())
        self.bytes += data.size

    def missing(self, events: int) -> None:
        raise AssertionError(events)


def test_taps_receive_every_event(engine: Engine) -> None:
    many, tap = 9000, CountOnly()
    half = LinkSettings(impairments=(HALF,))
    with (
        endpoints(HOSTS[4], HOSTS[4]) as (server, client),
        running([link(name_of(server), half)], engine, taps=[tap], start=False) as one,
    ):
        for _ in range(many):
            client.sendto(b"x", one.relay.addresses()["test"])
        one.start()
        one.settled(many)
        report = one.report()
    assert (tap.arrivals, tap.bytes) == (many, 0)
    assert tap.departures == report.forward.counters.forwarded
    assert report.forward.delays.sum() == tap.departures
    assert report.forward.lateness.sum() == 0


def free_port(host: str) -> int:
    with endpoints(host) as (one,):
        return name_of(one)[1]


@pytest.mark.parametrize(
    ("listen", "to"),
    [
        ("127.0.0.1", "127.0.0.1"), ("::1", "::1"), ("0.0.0.0", "127.0.0.1"),
        ("127.0.0.1", "0.0.0.0"), ("0.0.0.0", "127.1.2.3"), ("::", "::1"), ("::", "127.0.0.1"),
        ("::1", "::"),
    ],
)  # fmt: skip
def test_a_link_that_leads_back_to_itself_is_refused(engine: Engine, listen: str, to: str) -> None:
    port = free_port(listen)
    with pytest.raises(CallerError, match=r"leads back to itself$"):
        open_relay([link((to, port), listen=(listen, port))], engine)


@pytest.mark.parametrize(
    ("listen", "to"),
    [("127.0.0.1", "127.0.0.2"), ("0.0.0.0", "192.0.2.1"), ("127.0.0.2", "0.0.0.0")],
)
def test_a_link_to_the_same_port_of_another_address_is_allowed(
    engine: Engine, listen: str, to: str
) -> None:
    port = free_port(listen)
    open_relay([link((to, port), listen=(listen, port))], engine).close()


def test_links_may_form_a_chain_but_not_a_cycle(engine: Engine) -> None:
    ports = {name: free_port(HOSTS[4]) for name in "abc"}

    def chain(*names: str) -> list[LinkSpec]:
        return [
            link((HOSTS[4], ports[to]), listen=(HOSTS[4], ports[name]), name=name)
            for name, to in pairwise(names)
        ]

    open_relay(chain("a", "b", "c"), engine).close()
    with pytest.raises(CallerError, match=r"^link b: .* leads back to itself over c$"):
        open_relay(chain("a", "b", "c", "b"), engine)


def test_a_server_needs_a_port(engine: Engine) -> None:
    with pytest.raises(CallerError, match=r"^link test: to 127.0.0.1:0: nobody can be at port 0"):
        open_relay([link(("127.0.0.1", 0))], engine)


@pytest.mark.parametrize(
    ("others", "message"),
    [
        ({"listen": ("localhost", 0)}, "not an address of IPv4 or IPv6"),
        ({"listen": ("192.0.2.1", 0)}, "is no address of this machine"),
    ],
)
def test_an_impossible_link_is_refused(
    engine: Engine, others: dict[str, Any], message: str
) -> None:
    with pytest.raises(CallerError, match=message):
        open_relay([link(("127.0.0.1", 9), **others)], engine)


def test_a_port_or_a_name_that_is_taken_is_refused(engine: Engine) -> None:
    with endpoints(HOSTS[4]) as (other,):
        taken = name_of(other)
        with pytest.raises(CallerError, match="already taken"):
            open_relay([link(("127.0.0.1", 9), listen=taken)], engine)
    with pytest.raises(CallerError, match="two of this name"):
        open_relay([link(("127.0.0.1", 9))] * 2, engine)


def test_the_engine_is_the_one_that_was_asked_for(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    relay = open_relay([link(("127.0.0.1", 9))], engine)
    relay.close()
    assert relay.engine == engine
    monkeypatch.setattr(starting.importlib.util, "find_spec", lambda name: None)
    relay = open_relay([link(("127.0.0.1", 9))])
    relay.close()
    assert relay.engine == "plain"
    with pytest.raises(CallerError, match="needs numba"):
        open_relay([link(("127.0.0.1", 9))], "batched")


def test_a_relay_runs_again_after_it_was_stopped(engine: Engine) -> None:
    with endpoints(HOSTS[4], HOSTS[4]) as (server, client):
        spec = link(name_of(server))
        with running([spec], engine) as first:
            client.sendto(b"1", first.relay.addresses()["test"])
            assert server.recv(10) == b"1"
            first.stop()
            client.sendto(b"2", first.relay.addresses()["test"])
            assert not select.select([server], [], [], 0)[0]
            count = iter(range(10))
            first.relay.run(lambda: next(count) == 3, lambda: None)
            assert server.recv(10) == b"2"


class _Broken(io.TextIOBase):
    def write(self, text: str, /) -> int:
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")


@pytest.mark.parametrize("stderr", [_Broken(), None])
def test_the_relay_continues_if_standard_error_is_unusable(
    engine: Engine, stderr: io.TextIOBase | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    with endpoints(*[HOSTS[4]] * 3) as (server, one, another):
        spec = link(name_of(server), most_clients=1)
        monkeypatch.setattr(sys, "stderr", stderr)
        with running([spec], engine) as relaying:
            there = relaying.relay.addresses()["test"]
            one.sendto(b"first", there)
            relaying.settled(1)
            another.sendto(b"of one too many", there)
            relaying.until(lambda: relaying.relay.report()[0].refused == 1)
            one.sendto(b"second", there)
            relaying.settled(2)
            assert [server.recv(10) for _ in range(2)] == [b"first", b"second"]


def test_a_change_does_not_interrupt_a_replay(engine: Engine) -> None:
    lost = RecordedDecision(Fate.DROPPED, -1, -1, -1, -1)
    passed = RecordedDecision(Fate.DELIVERED, 0, -1, -1, -1)
    record = [lost, passed, lost, lost, passed, lost]
    worst = LinkSettings(impairments=(LossOf(loss=WorstCaseLoss()),), mansd=3)
    with endpoints(*[HOSTS[4]] * 2) as (server, client):
        spec = link(name_of(server), decisions={"forward": [record]})
        with running([spec], engine) as one:
            there = one.relay.addresses()["test"]
            for number in range(10):
                client.sendto(number.to_bytes(4, "big"), there)
                one.settled(number + 1)
                if number == 2:
                    one.ask(partial(one.relay.change, "test", "forward", worst))
            assert numbers(drain(server)) == [1, 4, 8]


def test_more_links_than_the_limit_of_select_work(engine: Engine) -> None:
    raise_file_limit()
    with endpoints(HOSTS[4], HOSTS[4]) as (server, client):
        specs = [link(name_of(server), name=f"link{number}") for number in range(1100)]
        with running(specs, engine) as one:
            client.sendto(b"hello", one.relay.addresses()["link1099"])
            assert server.recv(10) == b"hello"
