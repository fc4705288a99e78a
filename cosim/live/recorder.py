"""The recorder's process: receives the telemetry of all processes, stores it, and shows it."""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import zenoh
from zenoh.handlers import FifoChannel, RingChannel

from cosim.live.loops_monitor import Finding, LoopsMonitor
from cosim.live.progress_report import ProgressReport
from cosim.live.telemetry_store import TelemetryStore
from cosim.record.decimate import is_long
from cosim.record.process_reports import report_of, write_reports
from cosim.record.run_directory import active_run
from cosim.record.run_record import Rows, RunRecord
from cosim.record.spool_conversion import finish_record
from noack.config.parameter_changes import ParameterChange, change_notice
from noack.config.runtime_parameters import is_of_loss_alone
from noack.config.scenario import Scenario
from noack.core.clock import NS_PER_S
from noack.core.errors import ExitStatus, MachineError, PeerError
from noack.protocol.machine_interface import BEGINNING, RESTART, Notice, Start
from noack.protocol.topology import LOOP_ROLES, RECORDER
from noack.runtime.command_line import print_to_stderr
from noack.runtime.control_plane import ControlPlane
from noack.runtime.life_cycle import LAUNCHER_GONE
from noack.runtime.process_entry import run_process
from noack.runtime.process_life import RunProcess
from noack.runtime.telemetry import NOTICES, first_row

if TYPE_CHECKING:
    from cosim.output.viewer.live_viewer import LiveView
    from cosim.output.viewer.loops_feed import LoopsFeed
    from cosim.output.viewer.loops_recording import LoopsRecording
    from cosim.output.viewer.recording import RunView
    from cosim.output.viewer.table_feed import ViewFeed

_POLL_S = 0.02
_SHOW_S = 0.1
_DISCOVERY_S = 5.0
"""By then a restarted recorder has received the liveliness tokens of all running processes."""
_ACKNOWLEDGE_S = 1.0
_POLL_FOR_S = 0.2
_WAITING_BATCHES = 4096
"""A minute of batches; each place of the ring takes 256 bytes once it has been used."""
_WAITING_BATCHES_OF_LOOPS = 512
"""Some seconds of batches, each with some hundred kilobytes; a lost one is sent again."""
_ROWS_IN_FLIGHT_S = 0.3
_STOP_TIMEOUT_S = 8.0


class Recorder:
    """Receives, stores and shows the telemetry of one run."""

    def __init__(
        self,
        scenario: Scenario,
        run_dir: Path,
        plane: ControlPlane,
        live: str | None = None,
        *,
        start: Start = BEGINNING,
    ) -> None:
        self._run_dir = run_dir
        self._plane = plane
        self._store = TelemetryStore(scenario, run_dir, plane.instance, start)
        self._scenario = scenario
        self._feed: ViewFeed | LoopsFeed | None = None
        self.lost: MachineError | None = None
        """Why some stored rows are no longer on disk; known at the end."""
        self._monitor = LoopsMonitor(scenario)
        self._blind_reported = self._monitoring_ended = False
        session, key = plane.session, plane.key
        self._batches = session.declare_subscriber(
            key("telemetry", "*", "*"),
            RingChannel(_WAITING_BATCHES if scenario.loops is None else _WAITING_BATCHES_OF_LOOPS),
        )
        self._report_queries = session.declare_queryable(key("report", "*"), FifoChannel(64))
        self._tokens = session.liveliness().declare_subscriber(
            key("alive", "*", "*"), RingChannel(256), history=True
        )
        self._reports: dict[str, dict[str, Any]] = {}
        """Final reports by instance."""
        self._alive: dict[str, set[str]] = {}
        """Instances with a liveliness token, by role."""
        self._out_of_order = self._is_restart = start.is_restart
        self._began_s = time.monotonic()
        self._invalid = 0
        self._progress = ProgressReport(live)
        if start.is_restart:
            self._monitor.stop("the recorder was restarted")
            self._store.load(self._progress.count)

    @property
    def finished(self) -> bool:
        """Whether every process of the loop has handed over its rows, or is gone."""
        # A process that ended before a restarted recorder began will not report again.
        discovered = self._is_restart and time.monotonic() - self._began_s > _DISCOVERY_S
        reported = self._reports.keys()
        return all(
            discovered if (alive := self._alive.get(role)) is None else alive <= reported
            for role in LOOP_ROLES
        )

    def show_in(self, view: "RunView | LoopsRecording") -> None:
        """Show the telemetry in a view, from the first batch that is handled afterwards."""
        from cosim.output.viewer.recording import RunView

        if isinstance(view, RunView):
            from cosim.output.viewer.table_feed import ViewFeed

            self._feed = ViewFeed(self._scenario, view)
        else:
            from cosim.output.viewer.loops_feed import LoopsFeed

            self._feed = LoopsFeed(self._scenario, view, self._progress.add_warning)

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
        while (token := self._tokens.try_recv()) is not None:
            role, instance = str(token.key_expr).split("/")[-2:]
            alive = self._alive.setdefault(role, set())
            if token.kind == zenoh.SampleKind.DELETE:
                alive.discard(instance)
            else:
                alive.add(instance)
        return more

    def end_monitoring(self) -> None:
        """Check no more assumptions: the run is stopping, and its processes end one by one."""
        self._monitoring_ended = True

    def show(self) -> None:
        """Bring the view and the progress report up to date."""
        self._monitor_assumptions(self._monitor.advance)
        self._publish_progress()
        if self._feed is not None:
            try:
                self._feed.advance()
            except MachineError as error:
                self.give_up_view(error)

    def note(self, notice: Notice) -> None:
        """Store a line of the recorder's own for the run's log."""
        self._store.add_own_notice(notice)

    def change(self, change: ParameterChange, announcement: Mapping[str, Any]) -> None:
        """Log a change of runtime parameters, with the time of its request."""
        at_s, date = announcement["requested_ns"] / NS_PER_S, announcement["requested_at"]
        notice = change_notice(change, f"; requested at {at_s:.3f} s, {date}")
        self.note(notice)
        self._progress.add_change(notice.text)
        if not is_of_loss_alone(change.settings):
            self._monitor.end_at(change.t_ns / NS_PER_S)
        if self._feed is not None:
            self._feed.log(notice.line())

    def acknowledge(self) -> None:
        """Confirm to each process which of its rows are on disk, so that it can drop them.

        Raises:
            MachineError: stored rows are no longer on disk.
        """
        for role, content in self._store.acknowledgements():
            self._plane.acknowledge_rows(role, content)

    def finish(self) -> RunRecord | None:
        """Write the record and complete the view; the launcher writes the records of several loops.

        Raises:
            MachineError: the record cannot be written; the spool is kept.
        """
        self._monitor_assumptions(self._monitor.end)
        self._publish_progress()
        try:
            self._store.require_present()
        except MachineError as error:
            self.lost = error
        self._store.close()
        write_reports(self._run_dir, self._reports.values())
        record = finish_record(self._run_dir) if self._scenario.loops is None else None
        if self._feed is not None:
            try:
                self._feed.advance(final=True)
            except MachineError as error:
                self.give_up_view(error)
        return record

    def abandon(self) -> None:
        """Keep the spool as it is."""
        self._store.close()

    @property
    def view_is_incomplete(self) -> bool:
        """Whether batches came late or out of order, so that the view must be written again."""
        return self._out_of_order

    def _take(self, sample: zenoh.Sample) -> None:
        role, table = str(sample.key_expr).split("/")[-2:]
        payload = sample.payload.to_bytes()
        try:
            header = b"" if sample.attachment is None else sample.attachment.to_bytes()
            generation, first = first_row(header)
            if table == NOTICES and role in LOOP_ROLES:
                line = self._store.add_notice(role, generation, first, payload)
                if self._feed is not None:
                    self._feed.log(line)
            else:
                rows, follows = self._store.add_rows(role, table, generation, first, payload)
                self._take_rows(table, rows, follows=follows)
        except (PeerError, ValueError) as error:
            if not self._invalid:
                print_to_stderr(f"noack recorder: ignored an invalid telemetry message: {error}")
            self._invalid += 1

    def _take_rows(self, table: str, rows: Rows, *, follows: bool) -> None:
        """Count, check and show rows that are stored."""
        if not follows:
            self._out_of_order = True
            self._monitor.stop("telemetry is missing or arrived out of order")
            return
        self._progress.count(table, rows)
        self._monitor.take(table, rows)
        if self._feed is not None:
            self._feed.add(table, rows)

    def _monitor_assumptions(self, check: Callable[[], list[Finding]]) -> None:
        """Report violated assumptions in the log, the view and the progress report."""
        if self._monitoring_ended:
            return
        try:
            findings = check()
        except Exception as error:  # whatever it is: recording goes on
            findings = []
            self._monitor.stop(repr(error))
        for notice, text in findings:
            self.note(notice)
            self._progress.add_warning(text)
            if self._feed is not None:
                self._feed.log(notice.line())
        if self._monitor.stopped is not None and not self._blind_reported:
            self._blind_reported = True
            self._progress.add_warning(
                f"claims are checked after the run only: {self._monitor.stopped}"
            )

    def _publish_progress(self) -> None:
        self._plane.session.put(self._plane.key("progress"), self._progress.dumps())

    def _take_report(self, query: zenoh.Query) -> None:
        """Answer a final report with the rows that are missing."""
        role = str(query.key_expr).rpartition("/")[2]
        payload = b"" if query.payload is None else query.payload.to_bytes()
        try:
            if role not in LOOP_ROLES:
                raise PeerError(f"{role} has nothing to report")
            fields = report_of(role, payload, self._store.types)
        except PeerError as error:
            self._plane.refuse(query, str(error))
            return
        report: dict[str, Any] = {"generation": 0, "instance": ""} | fields | {"process": role}
        if stored := self._store.add_stored(report):
            text = f"{role}: {stored} rows were written to disk by itself: the recorder was slow"
            self.note(Notice(report.get("reached_ns") or 0, "info", text))
        # Telemetry has a lower priority: batches that were sent earlier may still be in flight.
        self._await_rows(report)
        missing = self._store.missing(report)
        if not missing:
            self._reports[report["instance"]] = report
        self._plane.answer(query, {"rows": missing})

    def _await_rows(self, report: dict[str, Any]) -> None:
        deadline_s = time.monotonic() + _ROWS_IN_FLIGHT_S
        while self._store.missing(report) and time.monotonic() < deadline_s:
            sample = self._batches.try_recv()
            if sample is None:
                time.sleep(0.005)
            else:
                self._take(sample)

    def give_up_view(self, error: MachineError) -> None:
        """Show the run no longer; the view is written again at the end."""
        print_to_stderr(f"noack recorder: {error}; the numeric record goes on")
        self._feed = None
        self._out_of_order = True


def main(arguments: Sequence[str] | None = None) -> ExitStatus:
    """Run the recorder; ``--live`` also opens a viewer."""
    live = "--live" in (sys.argv[1:] if arguments is None else arguments)

    def body(process: RunProcess) -> None:
        with active_run(Path(process.ticket.run_dir)), ExitStack() as stack:
            live_view = None
            if live and not process.start.is_restart:
                from cosim.output.viewer.live_viewer import LiveView

                live_view = LiveView()
                stack.callback(live_view.close)  # it would not exit by itself
            _record(process, live_view)

    return run_process(RECORDER, body)


def _record(process: RunProcess, live_view: "LiveView | None") -> None:
    """Record a run to its end."""
    run_dir, run_id = Path(process.ticket.run_dir), process.ticket.run_id
    # A live view is ready when the run begins. The libraries of a recording take half a second to
    # load: the other processes do not wait for them.
    view = _open_view(process, live_view) if live_view else None
    status = live_view.status if live_view else None
    recorder = Recorder(process.scenario, run_dir, process.plane, status, start=process.start)
    if process.replaces is not None:
        recorder.note(Notice(process.start.from_ns, RESTART, f"restarted: {process.replaces}"))
    process.join(None)
    # A restarted recorder writes the view at the end; the launcher writes that of a long run, and
    # that of a run of several loops.
    unseen = process.scenario.loops is not None or is_long(process.scenario)
    if view is not None or not (process.start.is_restart or unseen):
        try:
            view = view or _open_view(process, None)
            recorder.show_in(view)
        except MachineError as error:
            recorder.give_up_view(error)
    if not _poll_to_the_end(process, recorder):
        # The other processes spool their last rows now; `noack summary` completes the record.
        recorder.abandon()
        if view is not None:
            view.close()
        return
    while recorder.poll():
        pass
    recorder.show()
    record = recorder.finish()
    try:
        if view is not None:
            view.close()
    except MachineError as error:
        print_to_stderr(f"noack recorder: {error}; the numeric record is complete")
    if recorder.view_is_incomplete and not unseen and record is not None:
        from cosim.output.viewer.run_view import write_view

        write_view(record, run_dir, run_id)
    if recorder.lost is not None:
        raise recorder.lost


def _open_view(process: RunProcess, live_view: "LiveView | None") -> "RunView | LoopsRecording":
    scenario, run_id, run_dir = process.scenario, process.ticket.run_id, process.ticket.run_dir
    if scenario.loops is not None:
        from cosim.output.viewer.loops_recording import open_loops_view

        return open_loops_view(scenario, Path(run_dir), run_id, live_view)
    from cosim.output.viewer.run_view import open_view

    return open_view(scenario, Path(run_dir), run_id, live_view)


def _poll_to_the_end(process: RunProcess, recorder: Recorder) -> bool:
    """Receive until all processes have handed over their rows, or the recorder must stop.

    Returns:
        Whether the record can be completed now; not when the launcher has ended early.
    """
    shown_s = stop_s = None
    acknowledged_s = time.monotonic()
    while not recorder.finished:
        more = recorder.poll()
        if process.stopping:
            recorder.end_monitoring()
        for change, announcement in process.updates.take():
            recorder.change(change, announcement)
        now_s = time.monotonic()
        if shown_s is None or now_s - shown_s >= _SHOW_S:
            recorder.show()
            shown_s = now_s
        if now_s - acknowledged_s >= _ACKNOWLEDGE_S:
            recorder.acknowledge()
            acknowledged_s = now_s
        if process.stopping:
            if process.ended == LAUNCHER_GONE:
                return False
            stop_s = stop_s or now_s
            if process.ended in ("SIGINT", "SIGTERM") or now_s - stop_s > _STOP_TIMEOUT_S:
                return True
        if not more:
            time.sleep(_POLL_S)
    return True


if __name__ == "__main__":
    sys.exit(main())
