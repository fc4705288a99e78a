"""The life of a process in a run: join, wait for the common epoch, loop, report, leave.

A process ends when the horizon is reached, when the coordinator asks, when the launcher that holds
its lifeline is gone, or on SIGINT and SIGTERM. What it recorded reaches the recorder, or else the
run directory's spool.
"""

import os
import select
import signal
import socket
import sys
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, Protocol, TypeVar

from noack.clock import NS_PER_S, RunClock
from noack.errors import PeerError
from noack.io.address import Address
from noack.io.loop import Channel, run_loop
from noack.io.plane import Plane
from noack.io.realtime import realtime
from noack.io.signals import Signals
from noack.io.spool import SpoolWriter
from noack.io.telemetry import NOTICES, TelemetryBuffer, first_row, notices_of
from noack.io.ticket import Ticket
from noack.io.udp import MessageSocket, bind
from noack.machine import Machine
from noack.records import OWNER, tables
from noack.resolve import Loop, loop_of
from noack.topology import (
    ACKNOWLEDGED_BY,
    ACKNOWLEDGES_TO,
    LEGS,
    LOOP_ROLES,
    RECORDER,
    SENDER,
)
from noack.wire import Decoder, Encoder, Flow, Message

T = TypeVar("T")

_JOIN_TIMEOUT_S = 24 * 3600.0
"""A person may take long to start the other processes; who does not want to wait, interrupts."""
_GOODBYE_TIMEOUT_S = 5.0
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


OpenChannel = Callable[[socket.socket, Mapping[str, Address]], ReportingChannel[T]]


class Node:
    """A process of the loop that has been admitted to a run.

    Args:
        role: which process.
        ticket: its admission.
        plane: its connection to the control plane.
        signals: the signals it has received.
    """

    def __init__(self, role: str, ticket: Ticket, plane: Plane, signals: Signals) -> None:
        self.role = role
        self.ticket = ticket
        self.scenario = ticket.scenario
        self.loop: Loop = loop_of(ticket.scenario)
        self.plane = plane
        self._signals = signals
        self._ended: str | None = None
        self._joining = False
        self.report: dict[str, Any] = {}

    def join(self, address: Address | None) -> Mapping[str, Address]:
        """Wait at the start barrier; return everyone's address. Sets the common epoch.

        Args:
            address: where this process receives; None for the recorder, which is not in the loop.

        Raises:
            PeerError: the run never started.
        """
        hello = {"pid": os.getpid(), "address": address}
        self._joining = True
        start = self.plane.request(
            "join", hello, timeout_s=_JOIN_TIMEOUT_S, give_up=lambda: self.stopping
        )
        self._joining = False
        self.clock = RunClock(start["epoch_ns"], self.scenario.speed)
        if not self.ticket.launched:
            print(f"noack {self.role}: started", file=sys.stderr)
        return {role: (host, port) for role, (host, port) in start["addresses"].items()}

    def run_messages(self, machine: Machine[Message]) -> None:
        """Run a machine that speaks the loop's wire format over its leg of the topology."""
        leg = LEGS[self.role]
        dimension = self.loop.m if leg.receives is Flow.ACTUATION else self.loop.n
        decoder = Decoder(leg.receives, dimension, self.ticket.run_id, self.ticket.key)
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
        rows = tables(self.loop.n, self.loop.m, acknowledged=self.scenario.is_acknowledged)
        owned = {table: dtype for table, dtype in rows.items() if OWNER[table] == self.role}
        telemetry = TelemetryBuffer(owned, self.plane.publish_telemetry)
        grace_ns = int(_GRACE_S * NS_PER_S * self.scenario.speed)
        settings, port = self.scenario.realtime, getattr(self.scenario.ports, self.role)
        place = LOOP_ROLES.index(self.role) if settings.pin_cores else None
        with (
            closing(bind(port, self.role, f"ports.{self.role}")) as endpoint,
            # Taken before the barrier: locking memory may take a tenth of a second.
            realtime(settings.enabled, settings.fifo_priority, place) as granted,
        ):
            channel = open_channel(endpoint, self.join(endpoint.getsockname()))
            try:
                behind_ns = run_loop(
                    machine,
                    channel,
                    self.clock,
                    telemetry,
                    end_ns=self.scenario.horizon_ns + grace_ns,
                    stop=lambda: self.stopping,
                    spin_us=settings.spin_us,
                )
                if behind_ns and not self.stopping:
                    behind_s = behind_ns / NS_PER_S
                    self._ended = f"too slow: {behind_s:g} s behind; try a lower speed or rate"
            except BaseException as error:
                self._ended = f"an error of its own: {error!r}"
                raise
            finally:
                telemetry.flush()
                self.report = {
                    "pid": os.getpid(),
                    "ended": self.ended,
                    "realtime": granted,
                    "channel": channel.report(),
                    "rows": telemetry.totals(),
                }
                self._hand_over(telemetry)

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
            elif self.ticket.launched and _lifeline_cut():
                self._ended = LAUNCHER_GONE
            elif self._joining and self.plane.coordinator_gone():
                # Once the loop runs, it goes on without the control plane.
                self._ended = "the run's coordinator is gone"
        return self._ended

    def _hand_over(self, telemetry: TelemetryBuffer) -> None:
        reachable = self.ended != LAUNCHER_GONE and not self.ended.startswith(RECORDER)
        try:
            for _ in range(3 if reachable else 0):
                missing = self.plane.request("goodbye", self.report, timeout_s=_GOODBYE_TIMEOUT_S)
                if not missing:
                    return
                telemetry.resend(missing, self.plane.publish_telemetry_blocking)
        except PeerError:
            pass
        # No recorder, or one that does not take it: the run directory's spool does.
        writer = SpoolWriter(Path(self.ticket.run_dir) / "spool", self.role)
        everything = {table: [(0, rows)] for table, rows in telemetry.totals().items()}
        telemetry.resend(
            everything,
            lambda table, header, payload: writer.append(
                notices_of(self.role) if table == NOTICES else table, first_row(header), payload
            ),
        )
        writer.close()


def _lifeline_cut() -> bool:
    """Whether the launcher has closed our standard input, which it does only by ending."""
    readable, _, _ = select.select([sys.stdin.fileno()], (), (), 0)
    return bool(readable) and os.read(sys.stdin.fileno(), 1) == b""
