"""A DNS client that repeats its question: with MANSD it knows how often at most.

Let at most m of a client's successive datagrams be lost on the way there, and at most k on the way
back. If n tries in a row got no answer, d of them came to the server, and all d answers were lost,
so d ≤ k. Before, between and after those d there are d + 1 runs of lost questions, of at most m
each: n ≤ d + (d + 1) m ≤ k + (k + 1) m = (m + 1)(k + 1) − 1. So (m + 1)(k + 1) tries are enough.
This holds from any question on, as runs that began before it are shorter from there; and it needs
that the client keeps its socket, as a new one is a new flow.
"""

import shlex
import socket
import socketserver
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from itertools import groupby, islice
from typing import NamedTuple

import pytest
from dnslib import RR, DNSRecord
from dnslib.server import BaseResolver, DNSHandler, DNSLogger, DNSServer

from netem.cli.emulator_options import LINK_NAME
from netem.link_machine import Link
from netem.words.words_to_settings import settings_of
from tests.netem.programs.conftest import Emulate
from tests.netem.programs.emulator import LET_OUT

TIMEOUT_S = 0.03
"""Of a try. An answer that comes later costs another try, but tells which one it answers."""
QUESTIONS = 4


class Case(NamedTuple):
    forward: str
    reverse: str
    most: int
    """Tries that are enough."""


CASES = {
    "worst": Case("loss worst mansd 2", "loss worst mansd 2", 3 * 3),
    "other cap back": Case("loss worst mansd 1", "loss worst mansd 3", 2 * 4),
    "random": Case("loss 70% mansd 2", "loss 70% mansd 2", 3 * 3),
    "bursts": Case("loss gemodel 30% 20% mansd 2", "loss gemodel 30% 20% mansd 1", 3 * 2),
}
UNCAPPED = Case("loss 70%", "loss 70%", CASES["random"].most)


class Asked(NamedTuple):
    """A question; tries are numbered from 0 on, over all questions."""

    first: int
    answered: int
    """The try that got the first answer."""


class Zone(BaseResolver):
    """A server's zone, in which every name has an address that tells its number."""

    def resolve(self, request: DNSRecord, handler: DNSHandler) -> DNSRecord:
        reply = request.reply()
        number = str(request.q.qname).partition(".")[0]
        reply.add_answer(*RR.fromZone(f"{request.q.qname} 60 A 192.0.2.{number}"))
        return reply


@contextmanager
def dns_server() -> Iterator[str]:
    silent = DNSLogger(logf=lambda _: None)
    # Its own class answers in threads, and so in any order.
    server = DNSServer(
        Zone(), address="127.0.0.1", port=0, logger=silent, server=socketserver.UDPServer
    )
    server.start_thread()
    try:
        yield "{}:{}".format(*server.server.server_address)
    finally:
        server.stop()
        server.thread.join()
        server.server.server_close()


class Client:
    """Repeats a question until it is answered; each try has an identifier of its own."""

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.socket(type=socket.SOCK_DGRAM)
        self._socket.settimeout(TIMEOUT_S)
        self._socket.connect((host, port))
        self.tries = 0

    def ask(self, number: int) -> Asked:
        first = self.tries
        while True:
            question = DNSRecord.question(f"{number}.example")
            question.header.id = self.tries
            self.tries += 1
            self._socket.send(question.pack())
            with suppress(TimeoutError):
                while True:
                    answer = DNSRecord.parse(self._socket.recv(512))
                    if answer.header.id >= first:
                        assert str(answer.a.rdata) == f"192.0.2.{number}"
                        return Asked(first, answer.header.id)

    def close(self) -> None:
        self._socket.close()


def answered(case: Case) -> Iterator[bool]:
    """Whether each try gets an answer, by the rules alone."""
    there, back = (
        Link(settings_of(shlex.split(words)), 0, LINK_NAME, direction)
        for words, direction in ((case.forward, "forward"), (case.reverse, "reverse"))
    )
    while True:
        yield passes(there) and passes(back)


def passes(link: Link) -> bool:
    return link.decide(0, 30, 0).fate in LET_OUT


def ask(emulate: Emulate, case: Case) -> list[Asked]:
    """Ask all questions; what is answered is what the rules foretell."""
    with dns_server() as server:
        emulator = emulate(server, case.forward, "--reverse", case.reverse)
        with closing(Client(emulator.host, emulator.port)) as client:
            asked = [client.ask(number) for number in range(QUESTIONS)]
        link = emulator.finish()
    assert link["forward"]["arrived"] == client.tries
    got = list(islice(answered(case), client.tries))
    assert [one.answered for one in asked] == [got.index(True, one.first) for one in asked]
    return asked


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_with_a_cap_a_client_knows_how_often_it_must_ask(emulate: Emulate, case: Case) -> None:
    needed = [one.answered - one.first + 1 for one in ask(emulate, case)]
    assert max(needed) <= case.most
    if case is CASES["worst"]:  # from its beginning on, so that no smaller number would do
        assert needed[0] == case.most


def test_without_a_cap_it_does_not(emulate: Emulate) -> None:
    needed = [one.answered - one.first + 1 for one in ask(emulate, UNCAPPED)]
    assert needed[0] > UNCAPPED.most


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_so_many_tries_are_enough_wherever_one_begins(case: Case) -> None:
    expected = list(islice(answered(case), 20_000))
    runs = [len(list(run)) for got, run in groupby(expected) if not got]
    assert max(runs) == case.most - 1
