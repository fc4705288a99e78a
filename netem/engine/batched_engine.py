"""The Linux engine: one thread, which runs compiled code and returns to Python for rare events."""

import ctypes
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, nullcontext, suppress
from functools import cache

import numpy as np

from netem.compile_notice import announced
from netem.engine.batched_clients import ClientTable
from netem.engine.batched_directions import BatchedDirection
from netem.engine.compiled_rules import compile_rule, is_kept, prepare
from netem.engine.epoll_object import Epoll
from netem.engine.native_pump import compiled_pump, kept_pump
from netem.engine.pump import pump_layout
from netem.engine.pump.client_table import insert, remove
from netem.engine.pump_memory import PumpMemory
from netem.engine.relay_base import RARE_PERIOD_NS, REPORTED_FLOWS, Relay
from netem.engine.relay_interface import DIRECTIONS, DirectionReport, FlowReport, LinkSpec, Tap
from netem.engine.relay_sockets import stamp_arrivals
from noack.core.core_library import dtype_of
from noack.impairments.link_settings import LinkSettings
from noack.runtime.address import LOOPBACK
from noack.runtime.native.socket_structs import packed_name

_COMPILING_S = 15.0
_LONG_AGO_NS = -(2**62)
_PR_SET_TIMERSLACK, _PR_GET_TIMERSLACK = 29, 30


class BatchedRelay(Relay):
    """The fast relay; see :func:`netem.engine.engine_choice.open_relay` for its arguments."""

    engine = "batched"

    def __init__(
        self,
        specs: Sequence[LinkSpec],
        segment: bool = False,
        taps: Sequence[Tap] = (),
        spin_ns: int = 0,
    ) -> None:
        super().__init__(specs)
        self._taps = tuple(taps)
        self._run_compiled = compiled_pump()
        data = any(tap.wants_data for tap in self._taps)
        self._memory = PumpMemory(len(self.specs), segment, 1 + data if self._taps else 0)
        self._epoll = Epoll()
        memory, pump = self._memory.memory, self._memory.pump
        pump["epoll"] = self._epoll.fileno()
        pump["sleeps"] = not self._epoll.waits_by_ns()
        pump["spin_ns"] = spin_ns
        for number in range(len(self.specs)):
            self._listen(number)
        self._directions = [
            BatchedDirection(
                getattr(spec, side), spec.seed, (spec.name, side), 2 * number + reverse, memory,
                spec.decisions.get(side, ()),
            )
            for number, spec in enumerate(self.specs)
            for reverse, side in enumerate(DIRECTIONS)
        ]  # fmt: skip
        self._clients = ClientTable(
            self._open_links, self._warnings, self._directions, self._memory, self._epoll
        )
        for number in range(len(self._directions)):
            self._stamp_arrivals(number)
        self._decisions = np.zeros(1, dtype_of("noack_decision"))
        self._rarely_ns = 0

    def run(self, stop: Callable[[], bool], housekeeping: Callable[[], None]) -> None:
        """See :meth:`netem.engine.relay_base.Relay.run`; the thread's timer slack is 1 ns."""
        prctl = ctypes.CDLL(None).prctl
        slack_ns = prctl(_PR_GET_TIMERSLACK, 0, 0, 0, 0)
        prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
        try:
            super().run(stop, housekeeping)
        finally:
            prctl(_PR_SET_TIMERSLACK, slack_ns, 0, 0, 0)

    def _end(self) -> None:
        self._clients.query_all_drops()
        super()._end()

    def close(self) -> None:
        """Close all sockets."""
        super().close()
        self._clients.close()
        self._epoll.close()

    def call_all(self) -> None:
        """Call every compiled function once, to load it."""
        self._run_pump(_LONG_AGO_NS)
        memory = self._memory.memory
        compile_rule(insert)(memory.table, memory.clients, 0, memory.in_names[0])
        compile_rule(remove)(memory.table, memory.clients, 0)

    def _relay_until(self, until_ns: int) -> None:
        pump = self._memory.pump
        pump["epoch_ns"], pump["unix_ns"] = self._epoch_ns, self.began_unix_ns
        while (reason := self._run_pump(until_ns)) != pump_layout.HOUSEKEEPING:
            if reason == pump_layout.NEW_CLIENT:
                name = self._memory.memory.in_names[pump["batch_next"]].tobytes()
                self._clients.add(int(pump["batch_socket"]), name)
            elif reason == pump_layout.STORE_FULL:
                pump["no_memory"] = not self._memory.add_room()
            elif reason == pump_layout.EVENTS_FULL:
                self._report_events()
        self._report_events()

    def _change(self, direction: int, settings: LinkSettings) -> None:
        one = self._directions[direction]
        one.change(settings, self._memory.latest_ns(direction, one.rows))
        self._stamp_arrivals(direction)

    def _link_counts(self, link: int) -> tuple[int, int, int, int]:
        forward = self._memory.memory.directions[2 * link]
        refused, port_unreachable = int(forward["refused"]), int(forward["port_unreachable"])
        return self._clients.present[link], self._clients.ever[link], refused, port_unreachable

    def _report_direction(self, direction: int) -> DirectionReport:
        memory = self._memory.memory
        return DirectionReport(
            settings=self._directions[direction].settings,
            counters=self._directions[direction].counters,
            unintended=self._losses[direction].counts(),
            in_flight=int(self._directions[direction].core.in_flight),
            flows=self._report_flows(direction),
            delays=memory.delays[direction].copy(),
            lateness=memory.lateness[direction].copy(),
        )

    def _report_flows(self, direction: int) -> Sequence[FlowReport]:
        clients = self._memory.memory.clients
        flows = self._directions[direction].flows
        rows = self._clients.rows_of(direction // 2)
        packets = flows["packets"][clients["place"][rows]]
        busiest = rows[np.argsort(-packets, kind="stable")[:REPORTED_FLOWS]].tolist()
        return [
            FlowReport(
                int(clients["number"][row]), self._clients.address(row), int(flow["packets"]),
                int(flow["longest_loss_burst"]),
            )
            for row, flow in zip(busiest, flows[clients["place"][busiest]], strict=True)
        ]  # fmt: skip

    def _listen(self, number: int) -> None:
        link, memory = self._open_links[number], self._memory.memory
        memory.sockets["fd"][number] = link.endpoint.fileno()
        self._epoll.add(link.endpoint.fileno(), number)
        if link.path is not None:
            memory.sockets["fd"][len(self.specs) + number] = link.path.fileno()
        both = memory.directions[2 * number : 2 * number + 2]
        server, both["name_bytes"] = packed_name(link.server)
        both["name"] = np.frombuffer(server, np.uint8)
        both["listen"] = np.frombuffer(packed_name(link.name)[0], np.uint8)
        sends = pump_layout.OWN_SOCKET
        if link.path is not None:
            sends = pump_layout.DESTINATION_NAME
            with suppress(OSError):  # there is no route now; perhaps later
                # For a connected socket, the kernel looks up the route once, not per datagram.
                link.path.connect(link.server)
                sends = pump_layout.LINK_SOCKET
        both["sends"] = sends, pump_layout.CLIENT_NAME

    def _stamp_arrivals(self, direction: int) -> None:
        """Enable arrival timestamps where datagrams are delayed: delays count from the arrival."""
        if self._directions[direction].tracks:
            self._memory.pump["stamps"] = 1
            self._memory.read_controls()
            if direction % 2 == 0:
                stamp_arrivals(self._open_links[direction // 2].endpoint)
            else:
                self._clients.stamp_arrivals(direction // 2)

    def _run_pump(self, until_ns: int) -> int:
        return self._run_compiled(self._memory.memory, self._decisions, until_ns)

    def _report_events(self) -> None:
        """Pass the collected events to the taps."""
        pump, memory = self._memory.pump, self._memory.memory
        events, data = int(pump["events"]), int(pump["data"])
        if events:
            for tap in self._taps:
                tap.take(memory.events[:events], memory.data[:data])
            pump["events"] = pump["data"] = 0

    def _keep_house(self, now_ns: int) -> None:
        self._memory.pump["no_memory"] = 0  # check again
        self._update_losses()
        self._clients.query_some_drops()
        if now_ns >= self._rarely_ns:
            self._rarely_ns = now_ns + RARE_PERIOD_NS
            self._clients.expire(now_ns)
            self._clients.reconnect()

    def _path_drops(self, link: int) -> int:
        return self._clients.drops[link]

    def _send_errors(self) -> Iterator[tuple[int, int, int]]:
        errors = self._memory.memory.errors
        if errors.any():
            for direction, error in np.argwhere(errors).tolist():
                yield direction, error, int(errors[direction, error])


@cache
def load() -> None:
    """Load or compile the code once, before ports are open: else datagrams would wait for it."""
    nothing = LinkSettings()
    spec = LinkSpec("none", (LOOPBACK, 0), (LOOPBACK, 9), nothing, nothing)
    kept = all(is_kept(function) for function in (insert, remove)) and kept_pump() is not None
    notice = nullcontext() if kept else announced("the relay", prepare(), _COMPILING_S)
    with notice, closing(BatchedRelay([spec])) as relay:
        relay.call_all()
