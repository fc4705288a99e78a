"""With a loss cap in both directions, a DNS client needs a bounded number of tries.

Let at most m consecutive datagrams be lost in the forward direction and at most k in the reverse
direction. Suppose that n consecutive tries get no answer and that d of them reach the server. All d
answers are lost, so d ≤ k. The other n − d questions form at most d + 1 loss bursts of at most m
each: n ≤ d + (d + 1) m ≤ k + (k + 1) m = (m + 1)(k + 1) − 1. So (m + 1)(k + 1) tries are enough.
The bound holds from any question on, because an earlier start of a loss burst only shortens the
rest of it. The client must keep its socket, because a new socket is a new flow.
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

from netem.emulator_options import LINK_NAME
from netem.tc_words import settings_of
from tests.netem.conftest import FORWARDED, Emulate
from tests.oracles.link import Link

TIMEOUT_S = 0.03
"""Timeout of a try. A later answer costs another try but carries the number of its own try."""
QUESTIONS = 4


class Case(NamedTuple):
    forward: str
    reverse: str
    most: int
    """Sufficient number of tries."""


CASES = {
    "worst": Case("loss worst mansd 2", "loss worst mansd 2", 3 * 3),
    "other cap back": Case("loss worst mansd 1", "loss worst mansd 3", 2 * 4),
    "random": Case("loss 70% mansd 2", "loss 70% mansd 2", 3 * 3),
    "bursts": Case("loss gemodel 30% 20% mansd 2", "loss gemodel 30% 20% mansd 1", 3 * 2),
}


class Zone(BaseResolver):
    """The zone of a server; the address of each name contains the name's number."""

    def resolve(self, request: DNSRecord, handler: DNSHandler) -> DNSRecord:
        reply = request.reply()
        number = str(request.q.qname).partition(".")[0]
        reply.add_answer(*RR.fromZone(f"{request.q.qname} 60 A 192.0.2.{number}"))
        return reply


@contextmanager
def dns_server() -> Iterator[str]:
    silent = DNSLogger(logf=lambda _: None)
    # dnslib's own server answers in threads, and so in any order.
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
    """Repeats a question until it is answered; each try has its own identifier."""

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.socket(type=socket.SOCK_DGRAM)
        self._socket.settimeout(TIMEOUT_S)
        self._socket.connect((host, port))
        self.tries = 0

    def ask(self, number: int) -> tuple[int, int]:
        """Return the first try of the question, and that which was answered first."""
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
                        return first, int(answer.header.id)

    def close(self) -> None:
        self._socket.close()


def answered(case: Case) -> Iterator[bool]:
    """Yield for each try whether it gets an answer, as the links decide without sockets."""
    there, back = (
        Link(settings_of(shlex.split(words)), 0, LINK_NAME, direction)
        for words, direction in ((case.forward, "forward"), (case.reverse, "reverse"))
    )
    while True:
        yield passes(there) and passes(back)


def passes(link: Link) -> bool:
    return link.decide(0, 30, 0).fate in FORWARDED


def test_the_tries_of_a_client_reach_the_bound(emulate: Emulate) -> None:
    """And the answered tries are those that ``answered`` predicts."""
    case = CASES["worst"]
    with dns_server() as server:
        emulator = emulate(server, case.forward, "--reverse", case.reverse)
        with closing(Client(emulator.host, emulator.port)) as client:
            asked = [client.ask(number) for number in range(QUESTIONS)]
        link = emulator.finish()
    assert link["forward"]["received"] == client.tries
    got = list(islice(answered(case), client.tries))
    assert [last for _, last in asked] == [got.index(True, first) for first, _ in asked]
    needed = [last - first + 1 for first, last in asked]
    assert max(needed) == needed[0] == case.most


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_the_bound_on_tries_holds_from_any_question_on(case: Case) -> None:
    expected = list(islice(answered(case), 3000))
    bursts = [len(list(burst)) for got, burst in groupby(expected) if not got]
    assert max(bursts) == case.most - 1
