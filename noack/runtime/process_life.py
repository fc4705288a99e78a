"""The life of a process in a run: join, wait for the common epoch, loop, report, leave.

A process ends when the horizon is reached, when the coordinator asks, when the launcher that holds
its lifeline is gone, or on SIGINT and SIGTERM. What it recorded reaches the recorder, or else the
run directory's spool.
"""

import contextlib
import os
import select
import signal
import socket
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Protocol, TypeVar, cast

from noack.config.parameter_changes import ParameterChange, ReconfigurableMachine
from noack.config.resolution import LoopMatrices, loop_of, tables_of
from noack.core.clock import NS_PER_S, RunClock
from noack.core.errors import CallerError, NoackError, PeerError, one_line
from noack.protocol.machine_interface import BEGINNING, RESTART, Machine, Notice, Record, Start
from noack.protocol.record_tables import OWNER
from noack.protocol.topology import (
    ACKNOWLEDGED_BY,
    ACKNOWLEDGES_TO,
    CHANGEABLE,
    LOOP_ROLES,
    RECORDER,
    ROUTES,
    SENDER,
)
from noack.protocol.wire_format import Decoder, Encoder, Flow, Message
from noack.runtime.address import Address
from noack.runtime.command_line import print_to_stderr
from noack.runtime.control_messages import (
    Admission,
    ChangeAnnouncement,
    ControlMessage,
    MissingRows,
    PersistedAck,
    RunStart,
    parse_message,
)
from noack.runtime.control_plane import ControlPlane
from noack.runtime.join_ticket import Ticket
from noack.runtime.real_time_loop import Channel, run_loop
from noack.runtime.real_time_settings import realtime
from noack.runtime.signals import Signals
from noack.runtime.spool import SpoolWriter
from noack.runtime.telemetry import NOTICES, TelemetryBuffer, first_row, notice_number, notices_of
from noack.runtime.udp_sockets import MessageSocket, bind

T = TypeVar("T")

_JOIN_TIMEOUT_S = 24 * 3600.0
"""A person may take long to start the other processes; who does not want to wait, interrupts."""
_ADMISSION_TIMEOUT_S = 10.0
_COORDINATOR_AWAY_S = 8.0
"""Four leases of the connection, which comes back by itself if a busy machine was its end."""
_GOODBYE_TIMEOUT_S = 5.0
_CHANGES_AT_ONCE = 2
"""In the loop, every 50 ms: a machine takes some tenths of a millisecond for each."""
_GRACE_S = 0.15
"""Wall time after the horizon in which what is still under way arrives."""

HORIZON = "horizon"
"""Why a process ends that has done its work."""
LAUNCHER_GONE = "the launcher is gone"
"""Why a process ends whose launcher has died."""


class ReportingChannel(Channel[T], Protocol[T]):
    """A channel that accounts for what passed through it."""

    def report(self) -> Mapping[str, object]:
        """Counters, for the run's summary."""
        ...

    def close(self) -> None:
        """Close what it opened."""
        ...


OpenChannel = Callable[[socket.socket, Mapping[str, Address]], ReportingChannel[T]]


class RunProcess:
    """A process of the loop that has been admitted to a run.

    Args:
        role: which process.
        ticket: its admission.
        plane: its connection to the control plane.
        signals: the signals it has received.
    """

    def __init__(self, role: str, ticket: Ticket, plane: ControlPlane, signals: Signals) -> None:
        self.role = role
        self.ticket = ticket
        self.scenario = ticket.scenario
        self.loop: LoopMatrices = loop_of(ticket.scenario)
        self.plane = plane
        self._signals = signals
        self._ended: str | None = None
        self._joining = False
        self._admitted_ns = 0
        self._place: Address | None = None
        self._changes: list[dict[str, Any]] = []
        self._changes_heard = 0
        self._looping = False
        self.start: Start = BEGINNING
        """Where in the run it takes up its work."""
        self.after: str | None = None
        """What became of the one whose place it takes, if it takes one's."""
        self.report: dict[str, Any] = {}

    def request_admission(self) -> None:
        """Ask to be let in; learn whether the run has begun, and another has gone before.

        Raises:
            NoAnswerError: no answer came within ten seconds.
            PeerError: this process is not let in.
        """
        admission = self._ask("admit", {}, Admission, _ADMISSION_TIMEOUT_S)
        self.start = Start(admission["generation"], admission["from_ns"])
        if self.start.again:
            self._place, self.after = admission["address"], admission["after"]
            self._admitted_ns = admission["admitted_ns"]

    def join(self, address: Address | None) -> Mapping[str, Address]:
        """Wait at the start barrier; return everyone's address. Sets the common epoch.

        Args:
            address: where this process receives; None for the recorder, which is not in the loop.

        Raises:
            PeerError: the run never started.
        """
        begin = self._ask("join", {"address": address}, RunStart, _JOIN_TIMEOUT_S)
        self.clock = RunClock(begin["epoch_ns"], self.scenario.speed)
        addresses: Mapping[str, Address] = begin["addresses"]
        self._changes = list(begin.get("changes", ()))
        if not addresses.keys() >= set(LOOP_ROLES):
            raise PeerError("the coordinator did not say where everyone receives")
        if not self.ticket.launched:
            verb = f"takes the place of one before ({self.after})" if self.after else "started"
            print_to_stderr(f"noack {self.role}: {verb}")
        return addresses

    def _ask(
        self, what: str, more: dict[str, Any], answer: type[ControlMessage], timeout_s: float
    ) -> Any:
        """Ask the coordinator as this process."""
        question = {"pid": os.getpid(), "instance": self.plane.instance, **more}
        self._joining = True
        try:
            said = self.plane.request(
                what, question, timeout_s=timeout_s, give_up=lambda: self.stopping
            )
        except PeerError as error:
            # What it was asked to end for says more than that no answer came.
            raise PeerError(self._ended) if self._ended else error from None
        finally:
            self._joining = False
        return parse_message(answer, said)

    def changes(
        self, at_once: int | None = None
    ) -> list[tuple[ParameterChange, Mapping[str, Any]]]:
        """Changes of the run's settings that have become known, each once and in their order.

        Args:
            at_once: how many at the most; the rest waits.

        Returns:
            The changes, and all that was said of each.
        """
        while (said := self.plane.announced()) is not None:
            with contextlib.suppress(PeerError):  # whoever says so is not the coordinator
                self._changes.append(parse_message(ChangeAnnouncement, said))
        found: list[tuple[ParameterChange, Mapping[str, Any]]] = []
        while self._changes and (at_once is None or len(found) < at_once):
            one = self._changes.pop(0)
            if one["number"] >= self._changes_heard:  # a late joiner hears of some twice
                self._changes_heard = one["number"] + 1
                found.append((ParameterChange(one["number"], one["t_ns"], one["settings"]), one))
        return found

    def run_messages(self, machine: Machine[Message]) -> None:
        """Run a machine that speaks the loop's wire format over its leg of the topology."""
        leg = ROUTES[self.role]
        decoder = Decoder(
            leg.receives,
            self.scenario.message_sizes.entries(leg.receives),
            self.ticket.run_id,
            self.ticket.key,
            not_before_ns=self._admitted_ns,
        )
        encoder = Encoder(self.ticket.run_id, self.ticket.key)
        acknowledged = self.scenario.is_acknowledged
        answers_from = ACKNOWLEDGED_BY.get(self.role) if acknowledged else None
        answers_to = ACKNOWLEDGES_TO.get(self.role) if acknowledged else None
        hears = Decoder(Flow.ACKNOWLEDGEMENT, 0, self.ticket.run_id, self.ticket.key)

        def channel(endpoint: socket.socket, addresses: Mapping[str, Address]) -> MessageSocket:
            return MessageSocket(
                endpoint,
                decoder,
                encoder,
                leg.sends,
                source=addresses[SENDER[self.role]],
                destination=addresses[leg.to],
                acknowledgements=(hears, addresses[answers_from]) if answers_from else None,
                acknowledges_to=addresses[answers_to] if answers_to else None,
            )

        self.run(machine, channel)

    def run(self, machine: Machine[T], open_channel: OpenChannel[T]) -> None:
        """Join, drive the machine to the horizon, hand over what is left, and report.

        Args:
            machine: the pure machine.
            open_channel: makes the machine's channel from a bound socket and everyone's address.

        Raises:
            CallerError: the process's port is taken.
            PeerError: the run never started.
        """
        rows = tables_of(self.scenario)
        owned = {table: dtype for table, dtype in rows.items() if OWNER[table] == self.role}
        telemetry = TelemetryBuffer(
            owned, self.plane.publish_telemetry, self.start.generation, self._kept_by_recorder
        )
        grace_ns = int(_GRACE_S * NS_PER_S * self.scenario.speed)
        settings, port = self.scenario.realtime, getattr(self.scenario.ports, self.role)
        port = port if self._place is None else self._place[1]
        place = LOOP_ROLES.index(self.role) if settings.pin_cores else None
        with (
            closing(bind(port, f"ports.{self.role}")) as endpoint,
            # Taken before the barrier: locking memory may take a tenth of a second.
            realtime(settings.enabled, settings.fifo_priority, place) as applied,
        ):
            channel = open_channel(endpoint, self.join(endpoint.getsockname()))
            if self.after is not None:
                telemetry.notice(Notice(self.start.from_ns, RESTART, f"started anew: {self.after}"))
            reached_ns: int | None = None
            changeable = (
                cast(ReconfigurableMachine[T], machine) if self.role in CHANGEABLE else None
            )
            try:
                behind_ns = run_loop(
                    machine,
                    channel,
                    self.clock,
                    telemetry,
                    end_ns=self.scenario.timing.horizon_ns + grace_ns,
                    stop=lambda: self.stopping,
                    spin_us=settings.spin_us,
                    news=lambda now_ns: self._announce(changeable, now_ns),
                )
                reached_ns = self.clock.now_ns() - behind_ns
                if behind_ns and not self.stopping:
                    behind_s = behind_ns / NS_PER_S
                    self._ended = f"too slow: {behind_s:g} s behind; try a lower speed or rate"
            except BaseException as error:
                self.fail(error)
                raise
            finally:
                telemetry.flush()
                self.report = {
                    "pid": os.getpid(),
                    "ended": self.ended,
                    "realtime": applied,
                    "channel": channel.report(),
                    "rows": telemetry.totals(),
                    "generation": self.start.generation,
                    "instance": self.plane.instance,
                    "reached_ns": reached_ns,
                }
                channel.close()
                self._hand_over(telemetry)

    def fail(self, error: BaseException) -> None:
        """End with an error, which the run is then told of."""
        known = isinstance(error, NoackError)
        self._ended = one_line(error) if known else f"an error of its own: {error!r}"

    @property
    def ended(self) -> str:
        """Why the process ended."""
        return self._ended or HORIZON

    @property
    def stopping(self) -> bool:
        """Whether the process has been asked to end."""
        return self._end_reason() is not None

    def _end_reason(self) -> str | None:
        if self._ended is None:
            if self._signals.received is not None:
                self._ended = signal.Signals(self._signals.received).name
            elif (reason := self.plane.stop_requested()) is not None:
                self._ended = reason
            elif self.ticket.launched:
                self._ended = LAUNCHER_GONE if lifeline_cut() else None
            elif self._joining and self.plane.coordinator_gone(for_s=_COORDINATOR_AWAY_S):
                # Once the loop runs, it goes on without the control plane. A launched process
                # has its lifeline: on a busy machine a coordinator may only seem to be gone.
                self._ended = "the run's coordinator is gone"
        return self._ended

    def _announce(
        self, machine: ReconfigurableMachine[Any] | None, now_ns: int
    ) -> Sequence[Record | Notice]:
        """Tell a machine of changes; during the loop a few at a time, as each takes a while."""
        if machine is None:
            return ()
        found: list[Record | Notice] = []
        for change, _ in self.changes(_CHANGES_AT_ONCE if self._looping else None):
            try:
                found += machine.announce(change, now_ns)
            except CallerError as error:  # the coordinator would not have said so
                print_to_stderr(f"noack {self.role}: ignored: {error}")
        self._looping = True
        return found

    def _kept_by_recorder(self) -> Mapping[str, Sequence[tuple[int, int]]]:
        """Rows of this process that are on disk, as far as the recorder has said anew."""
        said = self.plane.kept()
        if said is None:
            return {}
        try:
            kept = parse_message(PersistedAck, said)
        except PeerError:  # whoever says so is not the recorder
            return {}
        rows: Mapping[str, Sequence[tuple[int, int]]] = kept["rows"]
        return rows if kept["generation"] == self.start.generation else {}

    def _hand_over(self, telemetry: TelemetryBuffer) -> None:
        reachable = self.ended != LAUNCHER_GONE and not self.ended.startswith(RECORDER)
        reachable = reachable and not self.plane.coordinator_gone()  # all else goes through it
        try:
            for _ in range(3 if reachable else 0):
                said = self.plane.request("goodbye", self.report, timeout_s=_GOODBYE_TIMEOUT_S)
                missing = parse_message(MissingRows, said)["rows"]
                if not missing:
                    return
                telemetry.resend(missing, self.plane.publish_telemetry_blocking)
        except PeerError:
            pass
        # No recorder, or one that does not take it: the run directory's spool does.
        writer = SpoolWriter(Path(self.ticket.run_dir) / "spool", self.plane.instance)

        def spool(table: str, header: bytes, payload: bytes) -> None:
            generation, first = first_row(header)
            if table == NOTICES:
                table, first = notices_of(self.role), notice_number(generation, first)
            writer.append(table, first, payload)

        telemetry.resend({table: [(0, n)] for table, n in telemetry.totals().items()}, spool)
        writer.close()


def lifeline_cut() -> bool:
    """Whether the launcher has closed our standard input, which it does only by ending."""
    readable, _, _ = select.select([sys.stdin.fileno()], (), (), 0)
    return bool(readable) and os.read(sys.stdin.fileno(), 1) == b""
