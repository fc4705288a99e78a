"""The recorder's process: receives the telemetry of all processes, stores it, and shows it.

:func:`main` drives a :class:`Recorder` to the end of its run, with a live viewer on request.
"""

import math
import sys
import time
from collections.abc import Container, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import zenoh
from numpy.typing import NDArray
from pydantic import ConfigDict
from zenoh.handlers import FifoChannel, RingChannel

from cosim.live.recording.telemetry_store import TelemetryStore
from cosim.record.decimation import is_long
from cosim.record.processes import kept_reports, report_of, write_reports
from cosim.record.rows import Rows, messages_in
from cosim.record.run_directory import RECORDING_FILE, active_run
from netem.core.clock import NS_PER_S
from netem.core.command_line import END_SIGNALS, print_to_stderr
from netem.core.errors import ExitStatus, MachineError, PeerError
from netem.core.file_access import remove_file
from netem.core.number_format import counted
from netem.core.packet_rows import NETEM_PACKET, effective
from noack.core.core_library import core
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    LOOP,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)
from noack.protocol.roles import LOOP_ROLES, RECORDER, Notice
from noack.runtime.connections.zenoh_session import header_of
from noack.runtime.control_messages import ChangeAnnouncement, ProcessReport, RunProgress, message_json
from noack.runtime.control_plane import ControlPlane
from noack.runtime.end_reasons import LAUNCHED_LOST_S, LAUNCHER_GONE
from noack.runtime.host_clocks import CLOCK_NOTICE
from noack.runtime.join_run import join_run
from noack.runtime.run_process import RunProcess
from noack.runtime.spool import NOTICES
from noack.runtime.telemetry import first_row
from noack.scenario.parameter_changes import change_notice
from noack.scenario.resolution import ResolvedRun

if TYPE_CHECKING:
    from cosim.output.viewer.live_feed import LiveFeed
    from cosim.output.viewer.recording_viewer import LiveView
    from cosim.output.viewer.run_recording import RunRecording

_POLL_FOR_S = 0.2
"""Longest time for which batches are handled before anything else is done."""
_WAITING_BATCHES = 4096
"""A minute of batches; each place of the ring takes 256 bytes once it has been used."""
_LEAST_BATCHES = 512
"""Some seconds of batches, each with some hundred kilobytes; a lost one is sent again."""
_ROWS_IN_FLIGHT_S = 0.3
"""Longest time by which batches may come after the report of their process."""
_POLL_S, _SHOW_S, _ACKNOWLEDGE_S = 0.02, 0.1, 1.0
"""Wall times between two looks for messages, two updates of the view, two acknowledgements."""
_STOP_TIMEOUT_S = 8.0
"""Wall time that the processes of a stopped run have to report."""


class ProcessTokens:
    """Which processes of the loop have been in the run, and which are gone."""

    def __init__(self, plane: ControlPlane) -> None:
        self._plane = plane
        self._connected_s = time.monotonic()
        self._changes = plane.session.liveliness().declare_subscriber(
            plane.key("alive", "*", "*"), RingChannel(256), history=True
        )
        self._vanished_s: dict[str, dict[str, float]] = {role: {} for role in LOOP_ROLES}
        """When the token of each instance vanished, by role; infinity while it exists."""
        self._stored: set[str] = set()
        """Roles whose process has written its report to the spool."""

    def update(self) -> None:
        """Take the changes that have arrived."""
        while (token := self._changes.try_recv()) is not None:
            role, instance = str(token.key_expr).split("/")[-2:]
            vanished = token.kind == zenoh.SampleKind.DELETE
            if role in self._vanished_s:
                self._vanished_s[role][instance] = time.monotonic() if vanished else math.inf

    def note_stored(self, run_dir: Path) -> None:
        """Note which processes are gone that have written their last rows and their report to the spool."""
        for report in kept_reports(run_dir):
            vanished_s = self._vanished_s[report["process"]].get(report.get("instance", ""), math.inf)
            if vanished_s < math.inf:
                self._stored.add(report["process"])

    def all_done(self, reported: Container[str], *, stopping: bool) -> bool:
        """Whether each process has reported its end, or is gone.

        A token may vanish because a busy machine broke a connection, also the recorder's own. The
        process is gone if it does not come back. A run that is ``stopping`` does not wait for it.
        """
        now_s = time.monotonic()
        if self._plane.coordinator_gone():
            self._connected_s = now_s
            return False
        disconnect_timeout_s = 0.0 if stopping else LAUNCHED_LOST_S

        def is_done(role: str) -> bool:
            if role in reported or role in self._stored:
                return True
            vanished_s = self._vanished_s[role].values()
            return bool(vanished_s) and now_s - max(*vanished_s, self._connected_s) > disconnect_timeout_s

        return all(map(is_done, LOOP_ROLES))


class ProgressReport(RunProgress):
    """The recorder's progress report, as it grows."""

    model_config = ConfigDict(frozen=False)

    @np.errstate(all="ignore")  # a run may diverge
    def count(self, table: str, rows: Rows) -> None:
        """Count rows of a table."""
        if table == SENSOR_MEASUREMENT:
            self.t_s = int(rows["t_ns"][-1]) / NS_PER_S
            self.events += int((rows["event"] >= 0).sum())
            # Of each loop, the newest state in the batch.
            _, from_end = np.unique(rows[LOOP][::-1], return_index=True)
            newest = rows["x"][len(rows) - 1 - from_end]
            self.x_norm = float(np.linalg.norm(newest, axis=1).max())
        elif table == CONTROLLER_DELIVERY:
            self.deliveries += len(rows)
            # Includes stale updates, which the emulator cannot know in advance.
            self._count_losses(rows["dropouts"])
        elif table == NETEM_PACKET:
            rows = messages_in(rows)[0]
            self._count_losses(rows["consecutive_losses"][~effective(rows["fate"])])

    def _count_losses(self, consecutive: NDArray[np.int64]) -> None:
        self.longest_loss_burst = max(self.longest_loss_burst, int(consecutive.max(initial=0)))


class Recorder:
    """Receives, stores and shows the telemetry of one run."""

    def __init__(
        self,
        run: ResolvedRun,
        run_dir: Path,
        plane: ControlPlane,
        live: str | None = None,
    ) -> None:
        self._run_dir = run_dir
        self._plane = plane
        self.store = TelemetryStore(run.tables, run_dir)
        self._run = run
        self._feed: LiveFeed | None = None
        self.lost: MachineError | None = None
        """Why some stored rows are no longer on disk; known at the end."""
        self.is_stopping = False
        """Whether the processes of the run end one by one."""
        session, key = plane.session, plane.key
        self._batches = session.declare_subscriber(
            key("telemetry", "*", "*"),
            RingChannel(max(_WAITING_BATCHES // len(run.names), _LEAST_BATCHES)),
        )
        self._report_queries = session.declare_queryable(key("report", "*"), FifoChannel(64))
        self._tokens = ProcessTokens(plane)
        self._reports: dict[str, ProcessReport] = {}
        """Final reports by role."""
        self.view_is_incomplete = False
        """Whether batches came late or out of order, so that the view must be written again."""
        self._invalid = 0
        self._progress = ProgressReport(
            t_s=0.0, events=0, deliveries=0, longest_loss_burst=0, x_norm=None, live=live
        )

    @property
    def finished(self) -> bool:
        """Whether every process of the loop has handed over its rows, or is gone."""
        return self._tokens.all_done(self._reports.keys(), stopping=self.is_stopping)

    def note_stored(self) -> None:
        """Note which processes have written their reports to the spool instead of sending them."""
        if self.without_report:
            self._tokens.note_stored(self._run_dir)

    @property
    def without_report(self) -> list[str]:
        """Processes of the loop that have not reported their end to this recorder."""
        return [role for role in LOOP_ROLES if role not in self._reports]

    def show_in(self, view: "RunRecording") -> None:
        """Show the telemetry in a view, from the first batch that is handled afterwards."""
        from cosim.output.viewer.live_feed import LiveFeed  # imports rerun

        self._feed = LiveFeed(self._run, view, self._progress.warnings.append)

    def poll(self) -> bool:
        """Handle messages that have arrived; return whether there may be more.

        It returns after a while, even if batches arrive faster than they are handled: the processes
        keep their rows until they are acknowledged.
        """
        until_s = time.monotonic() + _POLL_FOR_S
        more = True
        while more and time.monotonic() < until_s:
            if more := (sample := self._batches.try_recv()) is not None:
                self._take(sample)
        while (query := self._report_queries.try_recv()) is not None:
            self._take_report(query)
        self._tokens.update()
        return more

    def show(self) -> None:
        """Bring the view and the progress report up to date."""
        self._publish_progress()
        if self._feed is not None:
            try:
                self._feed.advance()
            except MachineError as error:
                self.give_up_view(error)

    def change(self, announced: ChangeAnnouncement) -> None:
        """Log a change of runtime parameters, with the time of its request."""
        at_s = announced.requested_ns / NS_PER_S
        requested = f"; requested at {at_s:.3f} s, {announced.requested_at}"
        notice = change_notice(announced.change, requested)
        self.store.add_own_notice(notice)
        self._progress.changes.append(notice.text)
        if self._feed is not None:
            self._feed.log(notice.line())

    def acknowledge(self) -> None:
        """Confirm to each process which of its rows are on disk, so that it can drop them.

        Raise MachineError if stored rows are no longer on disk.
        """
        for role, content in self.store.acknowledgements():
            self._plane.acknowledge_rows(role, content)

    def finish(self) -> None:
        """Complete spool and view; the launcher writes the record."""
        self._publish_progress()
        try:
            self.store.writer.require_present()
        except MachineError as error:
            self.lost = error
        self.store.writer.close()
        if self._feed is not None:
            try:
                self._feed.advance(final=True)
            except MachineError as error:
                self.give_up_view(error)

    def report(self) -> None:
        """Write the final reports of the processes; raise MachineError if that fails."""
        reports = self._reports.items()
        write_reports(self._run_dir, [report.fields() | {"process": role} for role, report in reports])

    def _take(self, sample: zenoh.Sample) -> None:
        role, table = str(sample.key_expr).split("/")[-2:]
        payload = sample.payload.to_bytes()
        try:
            if (header := header_of(sample)) is None:
                raise PeerError("it was sent with another key")
            first = first_row(header)
            if table == NOTICES and role in LOOP_ROLES:
                for line in self.store.add_notices(role, first, payload):
                    if line["level"] == CLOCK_NOTICE:
                        self._progress.warnings.append(str(line["text"]))
                    if self._feed is not None:
                        self._feed.log(line)
            else:
                rows, follows = self.store.add_rows(role, table, first, payload)
                self._take_rows(table, rows, follows=follows)
        except (PeerError, ValueError) as error:
            if not self._invalid:
                print_to_stderr(f"noack recorder: ignored an invalid telemetry message: {error}")
            self._invalid += 1

    def _take_rows(self, table: str, rows: Rows, *, follows: bool) -> None:
        """Count and show rows that are stored."""
        if not follows:
            self.view_is_incomplete = True
            return
        self._progress.count(table, rows)
        if table in (PLANT_STEP, CONTROLLER_STEP):
            late_us = float((rows["now_ns"] - rows["t_ns"]).max()) / (1e3 * self._run.scenario.speed)
            self._progress.late_us = max(self._progress.late_us, late_us)
        if self._feed is not None:
            self._feed.add(table, rows)

    def _publish_progress(self) -> None:
        self._plane.publish("progress", content=message_json(self._progress))

    def _take_report(self, query: zenoh.Query) -> None:
        """Answer a final report with the rows that are missing."""
        role = str(query.key_expr).rpartition("/")[2]
        payload = b"" if query.payload is None else query.payload.to_bytes()
        try:
            if role not in LOOP_ROLES:
                raise PeerError(f"{role} has nothing to report")
            report = report_of(role, payload, self.store.types)
        except PeerError as error:
            self._plane.refuse(query, str(error))
            return
        if stored := self.store.add_stored(role, report):
            text = f"{role} wrote {counted(stored, 'row')} to disk itself, because the recorder was slow"
            self.store.add_own_notice(Notice(report.reached_ns or 0, "info", text))
        # Telemetry has a lower priority: batches that were sent earlier may still be in flight.
        deadline_s = time.monotonic() + _ROWS_IN_FLIGHT_S
        while (missing := self.store.missing(role, report)) and time.monotonic() < deadline_s:
            if (sample := self._batches.try_recv()) is None:
                time.sleep(0.005)
            else:
                self._take(sample)
        if not missing:
            self._reports[role] = report
        self._plane.answer(query, {"rows": missing})

    def give_up_view(self, error: MachineError) -> None:
        """Show the run no longer; the view is written again at the end."""
        print_to_stderr(f"noack recorder: {error}; the numeric record goes on")
        self._feed = None
        self.view_is_incomplete = True


def main(arguments: Sequence[str] | None = None) -> ExitStatus:
    """Run the recorder; ``--live`` also opens a viewer."""
    live = "--live" in (sys.argv[1:] if arguments is None else arguments)
    with join_run(RECORDER, ()) as process, ExitStack() as stack:
        stack.enter_context(active_run(Path(process.descriptor.run_dir)))
        live_view = None
        if live:
            from cosim.output.viewer.recording_viewer import LiveView  # imports rerun

            live_view = LiveView()
            stack.callback(live_view.close)  # it would not exit by itself
        _record(process, live_view)
    return ExitStatus.OK


def _record(process: RunProcess, live_view: "LiveView | None") -> None:
    """Record a run to its end."""
    from cosim.output.viewer.rerun_program import is_installed

    run_dir = Path(process.descriptor.run_dir)
    # A live view is ready when the run begins. The libraries of a recording take half a second to
    # load: the other processes do not wait for them.
    view = _open_view(process, live_view) if live_view else None
    status = live_view.status if live_view else None
    recorder = Recorder(process.resolved, run_dir, process.plane, status)
    process.join(None)
    core.noack_prefer_others()  # without real-time settings, the loop would wait for milliseconds
    # The launcher writes the view of a long run, and of several loops.
    unseen = len(process.resolved.names) > 1 or is_long(process.scenario)
    can_record = is_installed() and not unseen
    if view is not None or can_record:
        try:
            view = view or _open_view(process, None)
            recorder.show_in(view)
        except MachineError as error:
            recorder.give_up_view(error)
    if not _poll_to_the_end(process, recorder):
        # The other processes spool their last rows now; `noack summary` completes the record.
        recorder.store.writer.close()
        if view is not None:
            view.close()
        return
    while recorder.poll():
        pass
    if silent := recorder.without_report:
        print_to_stderr(f"noack recorder: there is no report from {', '.join(silent)}")
    recorder.show()
    recorder.finish()
    try:
        if view is not None:
            view.close()
    except MachineError as error:
        print_to_stderr(f"noack recorder: {error}; the numeric record is complete")
    if recorder.view_is_incomplete or unseen:
        remove_file(run_dir / RECORDING_FILE)  # the launcher writes another one
    recorder.report()
    if recorder.lost is not None:
        raise recorder.lost


def _open_view(process: RunProcess, live_view: "LiveView | None") -> "RunRecording":
    from cosim.output.viewer.run_recording import open_recording  # imports rerun

    run_dir, run_id = Path(process.descriptor.run_dir), process.descriptor.run_id
    return open_recording(process.resolved, run_dir, run_id, live_view)


def _poll_to_the_end(process: RunProcess, recorder: Recorder) -> bool:
    """Receive until all processes have handed over their rows, or the recorder must stop.

    Returns:
        Whether the record can be completed now; not when the launcher has ended early.
    """
    shown_s = stop_s = None
    acknowledged_s = time.monotonic()
    while not recorder.finished:
        more = recorder.poll()
        recorder.is_stopping = process.stopping
        for announced in process.updates.take():
            recorder.change(announced)
        now_s = time.monotonic()
        if shown_s is None or now_s - shown_s >= _SHOW_S:
            recorder.show()
            shown_s = now_s
        if now_s - acknowledged_s >= _ACKNOWLEDGE_S:
            recorder.acknowledge()
            recorder.note_stored()
            acknowledged_s = now_s
        if process.stopping:
            if process.ended == LAUNCHER_GONE:
                return False
            stop_s = stop_s or now_s
            if process.ended in END_SIGNALS or now_s - stop_s > _STOP_TIMEOUT_S:
                return True
        if not more:
            time.sleep(_POLL_S)
    return True


if __name__ == "__main__":
    sys.exit(main())
