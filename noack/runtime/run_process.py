"""A process in a run, from its admission to its report.

It asks for admission, waits at the start barrier, runs its loop and reports. It ends at the
horizon, on the coordinator's stop, when its launcher has ended, or on SIGINT and SIGTERM. Its rows
go to the recorder, or else to the run directory's spool. Read ``join_run.py`` first, which gets the
run descriptor, then :class:`RunProcess` from top to bottom. :func:`run_machines` is what the processes of
plant, sensor and controller do in it; that of the network has a function of its own (``netem/__main__.py``).
"""

import os
import select
import signal
import socket
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from functools import cached_property
from itertools import chain, repeat
from pathlib import Path
from typing import Protocol

from netem.core.address import Address
from netem.core.clock import NS_PER_S, RunClock, clock_identity
from netem.core.command_line import Signals, print_to_stderr
from netem.core.errors import CallerError, NoackError, PeerError, one_line
from netem.core.realtime_settings import realtime
from netem.core.udp_sockets import enlarge_buffer
from noack.machines.loop_machines import LoopMachines
from noack.protocol.record_tables import OWNER
from noack.protocol.roles import (
    CHANGEABLE,
    ENDS,
    LOOP_ROLES,
    RECEIVES,
    RECORDER,
    SENDS,
    WITH_DEADLINES,
    Notice,
    Record,
    receiver_of,
    sender_to,
)
from noack.protocol.wire_format import Flow, Wire
from noack.runtime.active_runs import run_name
from noack.runtime.control_messages import (
    Admission,
    AdmissionRequest,
    ClockError,
    ControlMessage,
    JoinRequest,
    M,
    RunStart,
    parse_message,
)
from noack.runtime.control_plane import ControlPlane, ParameterUpdates
from noack.runtime.counting_sockets import CountingSockets, bind
from noack.runtime.drivers.live_driver import LiveDriver, LoopSockets
from noack.runtime.drivers.real_time_loop import Driver, ProcessSockets, run_loop
from noack.runtime.end_reasons import HORIZON, LAUNCHER_GONE, LOST_AFTER_S
from noack.runtime.host_clocks import RECEIVED, CausalityCheck, clock_error, realtime_offset_ns
from noack.runtime.run_descriptor import RunDescriptor
from noack.runtime.spool import SPOOL
from noack.runtime.telemetry import OwnSpool, TelemetryBuffer, deliver_report, persisted_rows
from noack.runtime.unsent_rows_file import KeptFile, KeptHead
from noack.scenario.parameter_changes import ParameterChange
from noack.scenario.resolution import ResolvedRun
from noack.scenario.scenario_checks import prepare_changes

_JOIN_TIMEOUT_S = 24 * 3600.0  # a person may start the other processes late; Ctrl-C ends the wait
_ADMISSION_TIMEOUT_S = 10.0
_CHANGES_AT_ONCE = 2
"""Changes taken in the loop every 50 ms: a machine needs some tenths of a millisecond for each."""
_FEW_LOOPS = 8
_COALESCING_SHARE = 25
_LONGEST_COALESCING_NS = 800_000
"""Ticks of more than a few loops that are nearer to others than this part of a period are done
together: waking up for each takes CPU time."""
_GRACE_TURNS = 3  # of housekeeping, 50 ms each, after the horizon for packets in flight
_BUFFER_BYTES, _LARGEST_BUFFER_BYTES = 4 * 1024 * 1024, 256 * 1024 * 1024
"""Receive buffer for each loop, and for all. At 50,000 datagrams a second the largest covers a
stall of 7 s. The kernel takes what is in use."""


class Reconfigurable(Protocol):
    """Accepts changes of settings during the run."""

    def announce(self, change: ParameterChange, now_ns: int) -> Sequence[Record | Notice]:
        """Process the announcement of a change."""


class RunProcess:
    """A process of a run."""

    def __init__(self, role: str, descriptor: RunDescriptor, plane: ControlPlane, signals: Signals) -> None:
        self.role = role
        self.descriptor = descriptor
        self.resolved = ResolvedRun(descriptor.scenario)
        """All numbers of the run. The descriptor's scenario has them; what is derived for the loops is
        derived again when it is first used."""
        self.scenario = descriptor.scenario
        self.plane = plane
        self.updates = ParameterUpdates(plane)
        self._signals = signals
        self._reason: str | None = None
        """Why it stops before the horizon."""
        self._has_started = False
        self.report: dict[str, object] = {}
        self._realtime: dict[str, str] = {}
        self._clocks: Mapping[str, ClockError] = {}
        """Of all processes, if they have several."""

    def request_admission(self) -> None:
        """Ask the coordinator for admission to the run.

        Raise NoAnswerError without an answer within ten seconds, PeerError if it refuses; MachineError
        if this host's clock is not synchronised.
        """
        request = AdmissionRequest(instance=self.plane.instance, clock=self._clock_error())
        self._request("admit", request, Admission, _ADMISSION_TIMEOUT_S)

    def join(self, address: Address | None) -> Mapping[str, Address]:
        """Wait at the start barrier; return all addresses. Sets the common epoch.

        ``address`` is None for the recorder, which is not in the loop. Raise PeerError if the run
        never started.
        """
        prepare_changes()
        request = JoinRequest(instance=self.plane.instance, address=address)
        begin = self._request("join", request, RunStart, _JOIN_TIMEOUT_S)
        epoch_ns = begin.epoch_ns
        if self.descriptor.clock != clock_identity():
            epoch_ns = begin.epoch_realtime_ns - realtime_offset_ns()
        self.clock, self._clocks = RunClock(epoch_ns, self.scenario.speed), begin.clocks
        self.updates.extend(begin.changes)
        if not begin.addresses.keys() >= set(LOOP_ROLES):
            raise PeerError("the coordinator did not send the addresses of all processes")
        self._has_started = True
        if not self.descriptor.launched:
            print_to_stderr(f"noack {self.role}: started")
        return begin.addresses

    def _request(self, query: str, request: ControlMessage, answer: type[M], timeout_s: float) -> M:
        """Send the coordinator a request of this process; return the answer."""
        try:
            message = self.plane.request(query, request, timeout_s=timeout_s, give_up=lambda: self.stopping)
        except PeerError as error:
            # The reason to stop explains more than a missing answer.
            raise PeerError(self._reason) if self._reason else error from None
        return parse_message(answer, message)

    def _clock_error(self) -> ClockError | None:
        """How far this host's clock may be off; None if it is the coordinator's."""
        settings, clock = self.scenario.clocks, clock_identity()
        if clock == self.descriptor.clock:
            return None
        if settings is None:
            raise PeerError(
                "this process and the recorder have different clocks; open the run with "
                "`noack record --listen`"
            )
        return clock_error(clock, settings.largest_error_us)

    @property
    def wire(self) -> Wire:
        """The common part of the run's datagrams."""
        encrypted = self.scenario.network.encrypted
        return Wire(self.descriptor.run_id, self.descriptor.key, encrypted=encrypted)

    @property
    def spin_ns(self) -> int:
        """Time of busy waiting before a deadline."""
        return round(self.scenario.realtime.spin_us * 1000)

    @property
    def coalescing_ns(self) -> int:
        """Time for which the ticks of many loops are gathered."""
        if len(self.resolved.names) <= _FEW_LOOPS:
            return 0
        period_ns = min(entry.scenario.timing.plant_period_ns for entry in self.resolved.entries)
        return min(int(period_ns / _COALESCING_SHARE / self.scenario.speed), _LONGEST_COALESCING_NS)

    @contextmanager
    def open_socket(self) -> Iterator[socket.socket]:
        """Open the process's socket and apply its real-time settings.

        Raise CallerError if the port is taken.
        """
        settings, port = self.scenario.realtime, getattr(self.scenario.ports, self.role)
        place = LOOP_ROLES.index(self.role) if settings.pin_cores else None
        with (
            closing(bind(port, f"ports.{self.role}", self.descriptor.host)) as endpoint,
            # Before the barrier: locking memory may take a tenth of a second.
            realtime(settings.enabled, settings.fifo_priority, place, len(LOOP_ROLES)) as self._realtime,
        ):
            size_bytes = len(self.resolved.names) * _BUFFER_BYTES  # it may be late to the start
            enlarge_buffer(endpoint, min(size_bytes, _LARGEST_BUFFER_BYTES))
            yield endpoint

    def run(self, driver: Driver, sockets: CountingSockets, machine: Reconfigurable) -> None:
        """Drive the machines to the horizon, hand over the remaining rows, and report.

        Args:
            driver: drives the machines of this process.
            sockets: its sockets, which are closed at the end.
            machine: takes changes of settings.
        """
        telemetry = self._telemetry()
        reached_ns: int | None = None
        try:
            reached_ns = self._drive(driver, sockets, machine, telemetry)
            sockets.finish(self.clock.now_ns(), telemetry)
        except BaseException as error:
            self.fail(error)
            raise
        finally:
            telemetry.flush()
            # Also of a process that failed: the report says how far it came.
            self.report = {
                "pid": os.getpid(),
                "ended": self.ended,
                "realtime": self._realtime,
                "channel": sockets.report(),
                "rows": telemetry.totals(),
                "stored": telemetry.stored(),
                "rows_by_loop": telemetry.totals_by_loop(),
                "instance": self.plane.instance,
                "reached_ns": reached_ns,
            }
            if self.role in self._clocks:
                self.report["clock"] = self._clocks[self.role].fields()
            sockets.close()
            self._hand_over(telemetry)

    @cached_property
    def _spool(self) -> OwnSpool | KeptFile:
        """The recorder reads it, or `noack summary RUN --add` on another host."""
        descriptor, folder = self.descriptor, Path(self.descriptor.run_dir)
        if descriptor.remote is None:
            return OwnSpool(folder, self.role, self.plane.secret)
        name = run_name(descriptor.run_id)
        return KeptFile(folder, KeptHead(run=name, process=self.role, secret=self.plane.secret))

    def _telemetry(self) -> TelemetryBuffer:
        tables = self.resolved.tables
        owned = {table: dtype for table, dtype in tables.items() if OWNER[table] == self.role}
        check = None
        if self._clocks and self.role in RECEIVED:
            check = CausalityCheck(self.role, self._clocks, self.scenario.speed).check
        return TelemetryBuffer(
            owned,
            self.plane.publish_telemetry,
            lambda: persisted_rows(self.plane),
            self._spool.append,
            check,
        )

    def _drive(
        self, driver: Driver, sockets: ProcessSockets, machine: Reconfigurable, telemetry: TelemetryBuffer
    ) -> int:
        """Run the loop; return the simulated time up to which the machines have done their work."""
        limits = chain([None], repeat(_CHANGES_AT_ONCE))  # before the first step: all of them
        late_ns = run_loop(
            driver,
            sockets,
            self.clock,
            telemetry,
            end_ns=self.resolved.end_ns,
            stop=lambda: self.stopping,
            turns_after_end=_GRACE_TURNS,
            all_done=self._all_done,
            external_inputs=lambda now_ns: self._take_inputs(machine, now_ns, next(limits)),
        )
        reached_ns = self.clock.now_ns() - late_ns
        if late_ns and not self.stopping:
            late_s = late_ns / NS_PER_S
            self._reason = f"overrun: {late_s:g} s late; reduce the speed or the rates"
        return reached_ns

    def _all_done(self, is_done: bool) -> bool:
        """Return whether plant and controller have done their last steps, given whether this process has.

        A process that was stopped for a while does them after the horizon. The others must still receive
        what it sends then.
        """
        if is_done and self.role in WITH_DEADLINES:
            self.plane.announce_done()
        return is_done and self.plane.roles_done().issuperset(WITH_DEADLINES)

    def fail(self, error: BaseException) -> None:
        """Stop with an error as the reason."""
        is_expected = isinstance(error, NoackError)
        self._reason = one_line(error) if is_expected else f"internal error: {error!r}"

    @property
    def ended(self) -> str:
        """The reason why the process ended."""
        return self._reason or HORIZON

    @property
    def stopping(self) -> bool:
        """Whether there is a reason to stop before the horizon."""
        if self._reason is None:
            self._reason = self._reason_to_stop()
        return self._reason is not None

    def _reason_to_stop(self) -> str | None:
        if self._signals.received is not None:
            return signal.Signals(self._signals.received).name
        if (reason := self.plane.stop_requested()) is not None:
            return reason
        if self.descriptor.launched:
            return LAUNCHER_GONE if launcher_has_ended() else None
        # A running loop does not need the control plane. A launched process ends with its launcher
        # only: on a busy machine the coordinator may only seem to be gone.
        if not self._has_started and self.plane.coordinator_gone(for_s=LOST_AFTER_S):
            return "the connection to `noack record` is lost"
        return None

    def _take_inputs(self, machine: Reconfigurable, now_ns: int, most: int | None) -> list[Record | Notice]:
        """Pass announced changes on; return the outputs."""
        outputs: list[Record | Notice] = []
        for announced in self.updates.take(most) if self.role in CHANGEABLE else ():
            try:
                outputs += machine.announce(announced.change, now_ns)
            except CallerError as error:  # not from the coordinator, which checks changes
                print_to_stderr(f"noack {self.role}: ignored: {error}")
        return outputs

    def _hand_over(self, telemetry: TelemetryBuffer) -> None:
        """Deliver the report and the rows to the recorder; without one, write them to the spool."""
        reachable = self.ended != LAUNCHER_GONE and not self.ended.startswith(RECORDER)
        # All messages to the recorder pass the coordinator.
        reachable = reachable and not self.plane.coordinator_gone()
        delivered = reachable and deliver_report(self.plane, self.report, telemetry)
        if not delivered:
            telemetry.store_all()
            self._spool.keep_report(self.report)
            self._say_how_to_complete()
        if isinstance(self._spool, KeptFile) and (not delivered or any(telemetry.stored().values())):
            reason = "the recorder was too slow" if delivered else "cannot reach the recorder"
            print_to_stderr(
                f"noack {self.role}: {reason}; rows are kept in {self._spool.path}; copy this file to the "
                f"recorder's host, and add it there: noack summary RUN --add {self._spool.path.name}"
            )

    def _say_how_to_complete(self) -> None:
        """Say where the rows are, and what completes the record, if `noack record` cannot say it."""
        run_dir = self.descriptor.run_dir
        if self.descriptor.remote is None and not self.descriptor.launched and self.plane.coordinator_gone():
            print_to_stderr(
                f"noack {self.role}: cannot reach `noack record`; rows are kept in {run_dir}/{SPOOL}; "
                f"`noack summary {run_dir}` completes the record"
            )


def run_machines(process: RunProcess, machines: LoopMachines) -> None:
    """Join the run, drive the machines of all loops to the horizon, and report.

    Raises:
        CallerError: the process's port is taken.
        PeerError: the run never started, or the system refused a socket for a peer.
    """
    driver = LiveDriver(
        machines,
        process.wire,
        spin_ns=process.spin_ns,
        coalescing_ns=process.coalescing_ns,
    )
    with process.open_socket() as endpoint:
        addresses = process.join(endpoint.getsockname()[:2])
        role, network = process.role, process.scenario.network.flows
        answers, end = Flow.ACKNOWLEDGEMENT in network, ENDS[Flow.ACKNOWLEDGEMENT]
        sockets = LoopSockets(
            endpoint,
            driver,
            SENDS[role],
            source=addresses[sender_to(role, RECEIVES[role], network)],
            destination=addresses[receiver_of(role, SENDS[role], network)],
            acknowledged_by=addresses["netem"] if answers and role == end.receiver else None,
            acknowledges_to=addresses["netem"] if answers and role == end.sender else None,
        )
        process.run(driver, sockets, machines)


def launcher_has_ended() -> bool:
    """Whether the launcher has closed this process's standard input, as it does by ending."""
    readable, _, _ = select.select([sys.stdin.fileno()], (), (), 0)
    return bool(readable) and os.read(sys.stdin.fileno(), 1) == b""
