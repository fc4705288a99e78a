"""A relay in a thread, sockets for clients and servers, and a tap that keeps all events."""

import queue
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from netem.engine.engine_choice import Engine, open_relay
from netem.engine.relay_interface import Address, LinkReport, LinkSpec, Relay, Tap
from noack.impairments.link_settings import LinkSettings
from noack.runtime.udp_sockets import enlarge_buffer

PATIENCE_S = 60
"""Timeout for events that never happen; no test measures time with it."""
HOSTS = {4: "127.0.0.1", 6: "::1"}


class KeepAll:
    """A tap that keeps all events and payloads."""

    wants_data = True

    def __init__(self) -> None:
        self._events: list[NDArray[Any]] = []
        self.payloads: list[bytes] = []
        self.lost = 0

    def take(self, events: NDArray[Any], data: NDArray[np.uint8]) -> None:
        self._events.append(events.copy())
        whole = data.tobytes()
        for event in events:
            begin = int(event["offset"])
            self.payloads.append(whole[begin : begin + int(event["size_bytes"])])

    def missing(self, events: int) -> None:
        self.lost += events

    @property
    def events(self) -> NDArray[Any]:
        return np.concatenate(self._events)


class Running:
    """A relay that runs in its own thread."""

    def __init__(self, relay: Relay) -> None:
        self.relay = relay
        self._asked: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = queue.SimpleQueue()
        self._waiting: list[tuple[Callable[[], bool], Future[None]]] = []
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._failure: BaseException | None = None

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._end.set()
        if self._thread.is_alive():
            self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()
        assert self._failure is None

    def ask(self, what: Callable[[], Any]) -> Any:
        """Call a function in the relay's thread, between two datagrams; return its result."""
        answer: Future[Any] = Future()
        self._asked.put((what, answer))
        return answer.result(PATIENCE_S)

    def until(self, condition: Callable[[], bool]) -> None:
        """Wait until a condition holds, evaluated in the relay's thread."""
        done: Future[None] = Future()
        self._asked.put((lambda: self._waiting.append((condition, done)), Future()))
        done.result(PATIENCE_S)

    def report(self, number: int = 0) -> LinkReport:
        report: LinkReport = self.ask(lambda: self.relay.report()[number])
        return report

    def settled(self, arrived: int, side: str = "forward", number: int = 0) -> None:
        """Wait until ``arrived`` datagrams have arrived and none is in flight."""

        def is_settled() -> bool:
            found = getattr(self.relay.report()[number], side)
            return bool(found.counters.received >= arrived and found.in_flight == 0)

        self.until(is_settled)

    def _run(self) -> None:
        try:
            self.relay.run(self._end.is_set, self._keep_house)
        except BaseException as failure:
            self._failure = failure
            raise

    def _keep_house(self) -> None:
        while not self._asked.empty():
            what, answer = self._asked.get()
            try:
                answer.set_result(what())
            except BaseException as failure:
                answer.set_exception(failure)
        for condition, done in tuple(self._waiting):
            if condition():
                self._waiting.remove((condition, done))
                done.set_result(None)


@contextmanager
def running(
    specs: Sequence[LinkSpec],
    engine: Engine,
    *,
    segment: bool = False,
    taps: Sequence[Tap] = (),
    start: bool = True,
) -> Iterator[Running]:
    """Yield a running relay; it ends with the block."""
    relay = open_relay(specs, engine, segment, taps)
    one = Running(relay)
    try:
        if start:
            one.start()
        yield one
    finally:
        one.stop()
        relay.close()


@contextmanager
def endpoints(*hosts: str) -> Iterator[list[socket.socket]]:
    """Yield a bound socket on each host, with a large buffer."""
    with ExitStack() as stack:
        found = []
        for host in hosts:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            endpoint = stack.enter_context(socket.socket(family, socket.SOCK_DGRAM))
            endpoint.bind((host, 0))
            endpoint.settimeout(PATIENCE_S)
            enlarge_buffer(endpoint)
            found.append(endpoint)
        yield found


def name_of(endpoint: socket.socket) -> Address:
    host, port = endpoint.getsockname()[:2]
    return host, port


def drain(endpoint: socket.socket) -> list[tuple[bytes, Address]]:
    """Read all received datagrams."""
    found = []
    endpoint.settimeout(0)
    while True:
        try:
            data, source = endpoint.recvfrom(65_536)
        except BlockingIOError:
            endpoint.settimeout(PATIENCE_S)
            return found
        found.append((data, source[:2]))


def link(
    to: Address,
    forward: LinkSettings | None = None,
    reverse: LinkSettings | None = None,
    *,
    host: str = HOSTS[4],
    **others: Any,
) -> LinkSpec:
    """Return a link on loopback from a free port to a server."""
    own = {"name": "test", "listen": (host, 0), "seed": 7} | others
    nothing = LinkSettings()
    return LinkSpec(to=to, forward=forward or nothing, reverse=reverse or nothing, **own)
