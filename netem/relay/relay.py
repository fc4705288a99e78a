"""The relay: one thread, which runs the core and returns to Python for rare events."""

import ctypes
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress

import numpy as np

from netem.core.address import Address
from netem.core.core_library import core, ffi
from netem.core.errors import CallerError
from netem.impairments.link_settings import Counters, LinkSettings
from netem.relay.client_table import ClientTable
from netem.relay.link_sockets import set_receive_timeout, stamp_arrivals
from netem.relay.loss_warnings import LinkWarnings, UnintendedLosses
from netem.relay.relay_links import DeviceLink, LinkSpec, OpenLink, open_links
from netem.relay.relay_memory import RelayDirection, RelayMemory
from netem.relay.relay_reports import DIRECTIONS, Direction, DirectionReport, FlowReport, LinkReport
from netem.relay.timetable import TimedChange, Timetable, TimetableProgress

_PERIOD_NS = 40_000_000
"""Time between two turns of housekeeping."""
_CHECK_PERIOD_NS = 250_000_000
"""Time between two checks for losses, idle clients and return paths."""
_UNREAD_NS = 100_000_000
"""A datagram that arrived so long ago, and before the last turn, has been read: a timed change applies
although none has come since."""
_REPORTED_FLOWS = 16
"""Flows of a direction that a report lists: those with most packets."""
_PR_SET_TIMERSLACK, _PR_GET_TIMERSLACK = 29, 30


class Relay:
    """A relay with its links; all of it is called in one thread.

    Directions are numbered: 2·link forward, 2·link + 1 reverse.

    Args:
        specs: the links, at least one.
        segment: send successive datagrams of equal size as one message, which the kernel segments,
            if the kernel supports it.
        spin_ns: busy-wait instead of sleeping for this time before a delayed datagram is due, to
            avoid the delay of a wake-up.
        devices: those of a shell, in the place of sockets; its link is the only one.
        timetable: changes of settings; a datagram meets those that apply at its arrival.

    Raises:
        CallerError: a socket cannot be bound, or a link is invalid.
    """

    def __init__(
        self,
        specs: Sequence[LinkSpec],
        *,
        segment: bool = False,
        spin_ns: int = 0,
        devices: DeviceLink | None = None,
        timetable: Timetable | None = None,
    ) -> None:
        self._timetable = TimetableProgress(timetable or Timetable())
        self.on_timed_change: Callable[[TimedChange, Counters], None] = lambda change, counters: None
        """Called after each change of the timetable with the counts until then."""
        self.specs: Sequence[LinkSpec] = tuple(specs)
        self._warnings = [LinkWarnings(spec) for spec in self.specs]
        self._losses = [UnintendedLosses(spec.name, side) for spec in specs for side in DIRECTIONS]
        self._epoch_ns = self._next_check_ns = 0
        self._memory = RelayMemory(len(self.specs), segment=segment)
        self._memory.core.spin_ns = spin_ns
        # Direction 2k is forward of link k, and 2k + 1 is its reverse, as in the core.
        self._directions = [
            self._new_direction(spec, side, 2 * number + reverse)
            for number, spec in enumerate(self.specs)
            for reverse, side in enumerate(DIRECTIONS)
        ]
        # The sockets of the links, or the two devices of a shell.
        self._open_links: Sequence[OpenLink | DeviceLink] = (
            open_links(self.specs) if devices is None else [devices]
        )
        for number in range(len(self.specs)):
            self._listen(number)
        self._clients = ClientTable(self._open_links, self._warnings, self._directions, self._memory)
        for number, direction in enumerate(self._directions):
            direction.is_timed = timetable is not None
            self._stamp_arrivals(number)

    def addresses(self) -> Mapping[str, Address]:
        """Return the address at which each link listens."""
        return {link.spec.name: link.address for link in self._open_links}

    def run(self, stop: Callable[[], bool], housekeeping: Callable[[], None]) -> None:
        """Relay until ``stop()``; both are called at least every 50 ms, in this thread.

        Meanwhile, the thread's timer slack is 1 ns.
        """
        prctl = ctypes.CDLL(None).prctl
        slack_ns = prctl(_PR_GET_TIMERSLACK, 0, 0, 0, 0)
        prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
        try:
            self._run(stop, housekeeping)
        finally:
            prctl(_PR_SET_TIMERSLACK, slack_ns, 0, 0, 0)

    def _run(self, stop: Callable[[], bool], housekeeping: Callable[[], None]) -> None:
        if self._epoch_ns == 0:
            self._epoch_ns = time.monotonic_ns()
        read_ns = 0
        while not stop():
            housekeeping()
            now_ns = self._now_ns()
            self._apply_due(max(min(read_ns, now_ns - _UNREAD_NS), 0))
            self._do_housekeeping(now_ns)
            read_ns = now_ns
            self._relay_until(now_ns + _PERIOD_NS)
        self._end()

    def _new_direction(self, spec: LinkSpec, side: Direction, number: int) -> RelayDirection:
        with _refused(spec.name, side):
            row = self._memory.core.directions[number]
            return RelayDirection(getattr(spec, side), spec.seed, (spec.stream, side), row)

    def change(self, link: str, direction: Direction, settings: LinkSettings) -> None:
        """Change a direction's impairments between two datagrams.

        Flows keep their numbers, the positions in their random streams, and their counters. Packets
        in flight leave at their planned times.

        Raises:
            CallerError: there is no such link, or it cannot have the settings.
        """
        number = self._number_of(link, direction)
        changed = self._directions[number]
        with _refused(link, direction):
            changed.change(settings, self._memory.latest_ns(number, changed.rows))
        self._stamp_arrivals(number)

    def _apply_due(self, now_ns: int) -> None:
        """Apply the changes of the timetable until a time, at which the core asks for the next."""
        for change in self._timetable.take(now_ns):
            self.change(change.link, change.direction, change.settings)
            number = self._number_of(change.link, change.direction)
            self.on_timed_change(change, self._directions[number].counters)
        self._memory.core.change_ns = self._timetable.next_ns

    def _number_of(self, link: str, direction: Direction) -> int:
        names = [spec.name for spec in self.specs]
        if link not in names:
            raise CallerError(f"link {link}: no such link; links: {', '.join(names)}")
        return 2 * names.index(link) + DIRECTIONS.index(direction)

    def report(self) -> Sequence[LinkReport]:
        """Return the counts so far."""
        self._update_losses()
        reports = []
        for number, link in enumerate(self._open_links):
            clients, clients_ever, refused, port_unreachable = self._link_counts(number)
            reports.append(
                LinkReport(
                    link.spec.name, link.address, link.spec.to, clients, clients_ever, refused,
                    link.discarded, port_unreachable,
                    self._report_direction(2 * number), self._report_direction(2 * number + 1),
                )
            )  # fmt: skip
        return reports

    def close(self) -> None:
        """Close all sockets."""
        for link in self._open_links:
            link.close()
        self._clients.close()
        self._memory.close()

    def _now_ns(self) -> int:
        return time.monotonic_ns() - self._epoch_ns

    def _end(self) -> None:
        self._clients.query_all_drops()
        self._update_losses()
        for losses in self._losses:
            losses.report()

    def _update_losses(self) -> None:
        for number, link in enumerate(self._open_links):
            *_, port_unreachable = self._link_counts(number)
            self._warnings[number].set_port_unreachable(port_unreachable)
            self._losses[2 * number].set_lost_in_kernel(link.drops("forward"))
            drops = self._clients.drops[number] + link.drops("reverse")
            self._losses[2 * number + 1].set_lost_in_kernel(drops)
        for direction, error, datagrams in self._send_errors():
            self._losses[direction].set_not_sent(error, datagrams)

    def _relay_until(self, until_ns: int) -> None:
        """Relay datagrams, and do what the core needs meanwhile."""
        relay = self._memory.core
        relay.clock.epoch_ns = self._epoch_ns
        while (reason := core.noack_relay_run(relay, until_ns)) != core.NOACK_HOUSEKEEPING:
            if reason == core.NOACK_NEW_CLIENT:
                name = bytes(ffi.buffer(core.noack_relay_sender(relay), core.NOACK_NAME_BYTES))
                receiver = core.noack_relay_receiver(relay)
                outside = bool(relay.devices) and receiver > 0
                self._clients.add(receiver % len(self.specs), name, from_outside=outside)
            elif reason == core.NOACK_CHANGE_DUE:
                self._apply_due(relay.now_ns)

    def _do_housekeeping(self, now_ns: int) -> None:
        """Remove idle clients, open return paths again, check for losses."""
        self._memory.core.no_memory = 0  # check again
        self._clients.query_some_drops()
        if now_ns >= self._next_check_ns:
            self._next_check_ns = now_ns + _CHECK_PERIOD_NS
            self._update_losses()
            self._clients.expire(now_ns)
            self._clients.reconnect()

    def _link_counts(self, link: int) -> tuple[int, int, int, int]:
        """Return present clients, all clients, refused datagrams, ICMP port-unreachable errors."""
        row = self._directions[2 * link].row
        present, total = self._clients.present_counts[link], self._clients.total_counts[link]
        return present, total, row.refused, row.port_unreachable

    def _send_errors(self) -> Iterator[tuple[int, int, int]]:
        """Yield direction, errno and number of datagrams that could not be sent or stored."""
        for number, direction in enumerate(self._directions):
            if direction.has_errors:
                counts = direction.counts_of("errors")
                for error in np.flatnonzero(counts).tolist():
                    yield number, error, int(counts[error])

    def _report_direction(self, number: int) -> DirectionReport:
        direction = self._directions[number]
        return DirectionReport(
            settings=direction.settings,
            counters=direction.counters,
            unintended=self._losses[number].counts(),
            in_flight=direction.in_flight,
            flows=self._report_flows(number),
            delays=direction.counts_of("delays"),
            lateness=direction.counts_of("lateness"),
        )

    def _report_flows(self, direction: int) -> Sequence[FlowReport]:
        clients, flows = self._memory.clients, self._directions[direction].flows
        rows = self._clients.rows_of(direction // 2)
        packets = flows["packets"][clients["flow_row"][rows]]
        busiest = rows[np.argsort(-packets, kind="stable")[:_REPORTED_FLOWS]].tolist()
        return [
            FlowReport(
                int(clients["number"][row]),
                self._clients.text(row),
                int(flow["packets"]),
                int(flow["longest_loss_burst"]),
            )
            for row, flow in zip(busiest, flows[clients["flow_row"][busiest]], strict=True)
        ]

    def _listen(self, number: int) -> None:
        link = self._open_links[number]
        forward, reverse = self._directions[2 * number : 2 * number + 2]
        if isinstance(link, DeviceLink):
            self._memory.core.devices = 1
            for index, device in enumerate(link.devices):
                self._memory.watch(device, index)
            forward.row.sends = core.NOACK_LINK_SOCKET
            reverse.row.sends = core.NOACK_LISTENING_SOCKET
            return
        if len(self.specs) == 1 and not link.spec.return_path:
            self._memory.wait_for_only(link.endpoint.fileno(), number, set_receive_timeout(link.endpoint))
        else:
            self._memory.watch(link.endpoint.fileno(), number)
        sends = core.NOACK_OWN_SOCKET
        if link.path is not None:
            self._memory.core.sockets[len(self.specs) + number].fd = link.path.fileno()
            sends = core.NOACK_DESTINATION_NAME
            with suppress(OSError):  # there is no route now; perhaps later
                # For a connected socket, the kernel looks up the route once, not per datagram.
                link.path.connect(link.server)
                sends = core.NOACK_LINK_SOCKET
        forward.set_server(link.server, sends)
        reverse.set_server(link.server, core.NOACK_CLIENT_NAME)

    def _stamp_arrivals(self, direction: int) -> None:
        """Enable arrival timestamps where delays and timed changes count from the arrival."""
        link = self._open_links[direction // 2]
        if self._directions[direction].needs_arrivals and not isinstance(link, DeviceLink):
            core.noack_relay_read_stamps(self._memory.core)
            if direction % 2 == 0:
                stamp_arrivals(link.endpoint)
            else:
                self._clients.stamp_arrivals(direction // 2)


@contextmanager
def _refused(link: str, direction: Direction) -> Iterator[None]:
    """Raise CallerError in place of ValueError for settings that the core refuses."""
    try:
        yield
    except ValueError as error:
        raise CallerError(f"link {link} {direction}: {error}") from None
