"""The Linux engine: one thread, which runs compiled code and returns to Python for rare events."""

import ctypes
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext, suppress
from functools import cache

import numpy as np

from netem.compile_notice import announced
from netem.engine.batched_clients import ClientTable
from netem.engine.batched_directions import BatchedDirection
from netem.engine.compiled_pump import are_kept, functions
from netem.engine.compiled_rules import folder
from netem.engine.epoll_waiter import Epoll
from netem.engine.link_listeners import open_links
from netem.engine.pump.pump_layout import (
    CLIENT_NAME,
    EVENTS_FULL,
    HOUSEKEEPING,
    NEW_CLIENT,
    NO_NAME,
    SERVER_NAME,
    STORE_FULL,
)
from netem.engine.pump_memory import PumpMemory
from netem.engine.relay_interface import (
    DIRECTIONS,
    Address,
    Direction,
    DirectionReport,
    FlowReport,
    LinkReport,
    LinkSpec,
    Tap,
)
from netem.engine.relay_sockets import raise_file_limit, stamp_arrivals
from netem.engine.socket_names import name_of
from netem.engine.unintended_losses import UnintendedLosses
from netem.engine.unreachable_servers import UnreachableServers
from noack.core.errors import CallerError
from noack.impairments.link_records import Counters, PacketDecision, dtype_of
from noack.impairments.link_settings import LinkSettings
from noack.runtime.udp_sockets import LOOPBACK, drops_of

_PERIOD_NS = 20_000_000
_RARELY_NS = 250_000_000
_COMPILING_S = 15.0
_LONG_AGO_NS = -(2**62)
_REPORTED_FLOWS = 16
_PR_SET_TIMERSLACK, _PR_GET_TIMERSLACK = 29, 30


class BatchedRelay:
    """See :class:`netem.engine.relay_interface.Relay`; all of it is called in one thread.

    Args:
        specs: the links.
        segment: send successive datagrams of equal size as one message, which the kernel segments.
        taps: receivers of all events.
        spin_ns: busy-wait instead of sleeping for this time before a delayed datagram is due.

    Raises:
        CallerError: a socket cannot be bound, or a link is invalid.
    """

    engine = "batched"

    def __init__(
        self,
        specs: Sequence[LinkSpec],
        segment: bool = False,
        taps: Sequence[Tap] = (),
        spin_ns: int = 0,
    ) -> None:
        self.specs: Sequence[LinkSpec] = tuple(specs)
        self._taps = tuple(taps)
        self._functions = functions()
        raise_file_limit()
        self._links = open_links(self.specs)
        data = any(tap.wants_data for tap in self._taps)
        self._memory = PumpMemory(len(self.specs), segment, 1 + data if self._taps else 0)
        self._epoll = Epoll()
        memory, pump = self._memory.memory, self._memory.pump
        pump["epoll"] = self._epoll.fileno()
        pump["sleeps"] = not self._epoll.waits_by_ns()
        pump["spin_ns"] = spin_ns
        self._ways: list[BatchedDirection] = []
        self._losses: list[UnintendedLosses] = []
        self._unreachable = [UnreachableServers(spec) for spec in self.specs]
        for number, link in enumerate(self._links):
            self._listen(number)
            for side, direction in enumerate(DIRECTIONS):
                place = slice(len(self._ways), len(self._ways) + 1)
                self._ways.append(
                    BatchedDirection(
                        (link.spec.forward, link.spec.reverse)[side],
                        link.spec.seed,
                        (link.spec.name, direction),
                        link.spec.decisions.get(direction, ()),
                        memory.directions[place],
                        memory.link_states[place],
                        memory.counters[place],
                    )
                )
                self._losses.append(UnintendedLosses(link.spec.name, direction))
        self._clients = ClientTable(
            self._links, self._ways, self._memory, self._functions, self._epoll
        )
        for number in range(len(self._ways)):
            self._stamp_arrivals(number)
        self._verdicts = np.zeros(1, dtype_of(PacketDecision))
        self._rarely_ns = 0
        self.began_unix_ns: int | None = None
        """Unix time at which the relay started to run; the origin of its times."""

    def addresses(self) -> Mapping[str, Address]:
        """Return the address at which each link listens."""
        return {link.spec.name: link.address for link in self._links}

    def run(self, stop: Callable[[], bool], housekeeping: Callable[[], None]) -> None:
        """Relay until ``stop()``; both are called every 20 ms, in this thread."""
        pump = self._memory.pump
        if self.began_unix_ns is None:
            pump["epoch_ns"] = time.monotonic_ns()
            self.began_unix_ns = pump["unix_ns"] = time.time_ns()
        with _shortest_timer_slack():
            while not stop():
                housekeeping()
                now_ns = time.monotonic_ns() - int(pump["epoch_ns"])
                self._keep_house(now_ns)
                while (reason := self._run_pump(now_ns + _PERIOD_NS)) != HOUSEKEEPING:
                    self._serve(reason)
                self._tell_taps()
        self._clients.ask_all()
        self._look_at_losses()
        for losses in self._losses:
            losses.tell()

    def change(self, link: str, direction: Direction, settings: LinkSettings) -> None:
        """Change a direction's impairments; see :meth:`netem.engine.relay_interface.Relay.change`.

        Raises:
            CallerError: there is no such link.
        """
        for number, spec in enumerate(self.specs):
            if spec.name == link:
                place = 2 * number + DIRECTIONS.index(direction)
                way = self._ways[place]
                way.change(settings, self._memory.latest_ns(place, way.rows))
                self._stamp_arrivals(place)
                return
        names = ", ".join(spec.name for spec in self.specs)
        raise CallerError(f"link {link}: there is none of this name, but {names}")

    def report(self) -> Sequence[LinkReport]:
        """Return the counts so far."""
        self._look_at_losses()
        reports = []
        for number, link in enumerate(self._links):
            forward, reverse = (self._report_way(2 * number + side) for side in range(2))
            reports.append(
                LinkReport(
                    name=link.spec.name,
                    listen=link.address,
                    to=link.spec.to,
                    clients=self._clients.now[number],
                    clients_ever=self._clients.ever[number],
                    refused=int(self._memory.memory.directions["refused"][2 * number]),
                    discarded=link.discarded,
                    port_unreachable=self._port_unreachable(number),
                    forward=forward,
                    reverse=reverse,
                )
            )
        return reports

    def close(self) -> None:
        """Close all sockets."""
        self._clients.close()
        for link in self._links:
            link.close()
        self._epoll.close()

    def _listen(self, number: int) -> None:
        link, memory = self._links[number], self._memory.memory
        memory.sockets["fd"][number] = link.endpoint.fileno()
        self._epoll.add(link.endpoint.fileno(), number)
        if link.path is not None:
            memory.sockets["fd"][len(self._links) + number] = link.path.fileno()
        here, _ = name_of(link.here)
        server, server_bytes = name_of(link.server)
        for place in (2 * number, 2 * number + 1):
            memory.directions["listen"][place] = np.frombuffer(here, np.uint8)
            memory.directions["name"][place] = np.frombuffer(server, np.uint8)
            memory.directions["name_bytes"][place] = server_bytes
        memory.directions["sends"][2 * number] = NO_NAME if link.path is None else SERVER_NAME
        memory.directions["sends"][2 * number + 1] = CLIENT_NAME

    def _stamp_arrivals(self, place: int) -> None:
        """Enable arrival timestamps where datagrams are delayed: delays count from the arrival."""
        if self._ways[place].program.tracks:
            self._memory.pump["stamps"] = 1
            self._memory.read_controls()
            if place % 2 == 0:
                stamp_arrivals(self._links[place // 2].endpoint)
            else:
                self._clients.stamp_arrivals(place // 2)

    def call_all(self) -> None:
        """Call every compiled function once, to load it."""
        self._run_pump(_LONG_AGO_NS)
        memory, way = self._memory.memory, self._ways[0]
        self._functions.insert(memory.table, memory.clients, 0, memory.in_names[0])
        self._functions.remove(memory.table, memory.clients, 0)
        nothing_ns = np.full(way.rows, -1, np.int64)
        self._functions.carry(way.program, way.state, way.program, way.state, nothing_ns)

    def _run_pump(self, until_ns: int) -> int:
        way = self._ways[0]
        return self._functions.run_pump(
            self._memory.memory, way.program, way.state, self._verdicts, until_ns
        )

    def _serve(self, reason: int) -> None:
        """Handle the reason why the pump returned."""
        if reason == NEW_CLIENT:
            pump = self._memory.pump
            name = self._memory.memory.in_names[pump["batch_next"]].tobytes()
            self._clients.add(int(pump["batch_socket"]), name)
        elif reason == STORE_FULL:
            self._memory.pump["no_memory"] = not self._memory.add_room()
        elif reason == EVENTS_FULL:
            self._tell_taps()

    def _tell_taps(self) -> None:
        pump, memory = self._memory.pump, self._memory.memory
        events, data = int(pump["events"]), int(pump["data"])
        if events:
            for tap in self._taps:
                tap.take(memory.events[:events], memory.data[:data])
            pump["events"] = pump["data"] = 0

    def _keep_house(self, now_ns: int) -> None:
        self._memory.pump["no_memory"] = 0  # check again
        self._look_at_losses()
        self._clients.ask_some()
        if now_ns >= self._rarely_ns:
            self._rarely_ns = now_ns + _RARELY_NS
            self._clients.expire(now_ns)
            self._clients.reconnect()

    def _look_at_losses(self) -> None:
        errors = self._memory.memory.errors
        for number, link in enumerate(self._links):
            drops = drops_of(link.endpoint)
            if drops is not None:
                self._losses[2 * number].lost_in_kernel(drops)
            self._losses[2 * number + 1].lost_in_kernel(self._clients.drops[number])
            self._unreachable[number].seen(self._port_unreachable(number))
        for place, error in np.argwhere(errors).tolist():
            self._losses[place].not_sent(error, int(errors[place, error]))

    def _port_unreachable(self, number: int) -> int:
        return int(self._memory.memory.directions["port_unreachable"][2 * number])

    def _report_way(self, place: int) -> DirectionReport:
        memory, way = self._memory.memory, self._ways[place]
        return DirectionReport(
            settings=way.settings,
            counters=Counters(*memory.counters[place].tolist()),
            unintended=self._losses[place].counts(),
            in_flight=int(memory.link_states["in_flight"][place]),
            flows=self._report_flows(place),
            delays=memory.delays[place].copy(),
            lateness=memory.lateness[place].copy(),
        )

    def _report_flows(self, place: int) -> Sequence[FlowReport]:
        clients = self._memory.memory.clients
        flows = np.asarray(self._ways[place].state.flows)
        rows = self._clients.rows_of(place // 2)
        packets = flows["packets"][clients["place"][rows]]
        busiest = rows[np.argsort(-packets, kind="stable")[:_REPORTED_FLOWS]].tolist()
        return [
            FlowReport(
                flow=int(clients["number"][row]),
                client=self._clients.address(row),
                packets=int(flows["packets"][clients["place"][row]]),
                longest_loss_burst=int(flows["longest_loss_burst"][clients["place"][row]]),
            )
            for row in busiest
        ]


@contextmanager
def _shortest_timer_slack() -> Iterator[None]:
    """Set this thread's timer slack to the minimum; this needs no privilege."""
    libc = ctypes.CDLL(None)
    slack_ns = 0
    with suppress(AttributeError):
        slack_ns = libc.prctl(_PR_GET_TIMERSLACK, 0, 0, 0, 0)
        libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    try:
        yield
    finally:
        if slack_ns > 0:
            libc.prctl(_PR_SET_TIMERSLACK, slack_ns, 0, 0, 0)


@cache
def load() -> None:
    """Load or compile the code once, before ports are open: else datagrams would wait for it."""
    nothing = LinkSettings()
    spec = LinkSpec("none", (LOOPBACK, 0), (LOOPBACK, 9), nothing, nothing)
    told = nullcontext() if are_kept() else announced("the relay", folder(), _COMPILING_S)
    with told, closing(BatchedRelay([spec])) as relay:
        relay.call_all()
