"""The recorder of one run: receives the telemetry of all processes, stores it, and shows it."""

import time
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import zenoh
from zenoh.handlers import FifoChannel, RingChannel

from cosim.live.process_tokens import ProcessTokens
from cosim.live.progress_report import ProgressReport
from cosim.live.telemetry_store import TelemetryStore
from cosim.record.process_reports import report_of, write_reports
from cosim.record.run_record import Rows
from noack.config.parameter_changes import ParameterChange, change_notice
from noack.config.runtime_parameters import is_of_loss_alone
from noack.config.scenario import Scenario, loop_names
from noack.core.clock import NS_PER_S
from noack.core.errors import MachineError, PeerError
from noack.protocol.machine_interface import BEGINNING, Notice, Start
from noack.protocol.topology import LOOP_ROLES
from noack.runtime.command_line import print_to_stderr
from noack.runtime.control_plane import ControlPlane
from noack.runtime.log_lines import NOTICES
from noack.runtime.telemetry import first_row
from noack.runtime.zenoh_session import header_of

if TYPE_CHECKING:
    from cosim.live.claim_monitor import ClaimMonitor, Finding
    from cosim.output.viewer.network_recording import NetworkRecording
    from cosim.output.viewer.recording import RunView
    from cosim.output.viewer.run_feed import LoopFeed, NetworkFeed

_POLL_FOR_S = 0.2
_WAITING_BATCHES = 4096
"""A minute of batches; each place of the ring takes 256 bytes once it has been used."""
_LEAST_BATCHES = 512
"""Some seconds of batches, each with some hundred kilobytes; a lost one is sent again."""
_ROWS_IN_FLIGHT_S = 0.3


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
        self._feed: LoopFeed | NetworkFeed | None = None
        self.lost: MachineError | None = None
        """Why some stored rows are no longer on disk; known at the end."""
        self._blind_reported = self._monitoring_ended = False
        session, key = plane.session, plane.key
        self._batches = session.declare_subscriber(
            key("telemetry", "*", "*"),
            RingChannel(max(_WAITING_BATCHES // len(loop_names(scenario)), _LEAST_BATCHES)),
        )
        self._report_queries = session.declare_queryable(key("report", "*"), FifoChannel(64))
        self._tokens = ProcessTokens(plane, restarted=start.is_restart)
        self._reports: dict[str, dict[str, Any]] = {}
        """Final reports by instance."""
        self._out_of_order = start.is_restart
        self._invalid = 0
        self._progress = ProgressReport(live)
        if start.is_restart:
            self._monitor.stop("the recorder was restarted")
            self._store.load(self._progress.count)

    @cached_property
    def _monitor(self) -> "ClaimMonitor":
        """Checks claims. It imports the theory, for which the other processes do not wait."""
        from cosim.live.claim_monitor import ClaimMonitor

        return ClaimMonitor(self._scenario)

    @property
    def finished(self) -> bool:
        """Whether every process of the loop has handed over its rows, or is gone."""
        return self._tokens.all_done(self._reports.keys(), stopping=self._monitoring_ended)

    @property
    def without_report(self) -> list[str]:
        """Processes of the loop that have not reported their end to this recorder."""
        reported = {report["process"] for report in self._reports.values()}
        return [role for role in LOOP_ROLES if role not in reported]

    def show_in(self, view: "RunView | NetworkRecording") -> None:
        """Show the telemetry in a view, from the first batch that is handled afterwards."""
        from cosim.output.viewer.run_feed import feed_of

        self._feed = feed_of(self._scenario, view, self._progress.add_warning)

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

    def finish(self) -> None:
        """Complete spool and view; the launcher writes the record."""
        self._monitor_assumptions(self._monitor.end)
        self._publish_progress()
        try:
            self._store.require_present()
        except MachineError as error:
            self.lost = error
        self._store.close()
        if self._feed is not None:
            try:
                self._feed.advance(final=True)
            except MachineError as error:
                self.give_up_view(error)

    def report(self) -> None:
        """Write the final reports of the processes, as the last step.

        Raises:
            MachineError: they cannot be written.
        """
        write_reports(self._run_dir, self._reports.values())

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
            if (header := header_of(sample)) is None:
                raise PeerError("it was sent with another key")
            generation, first = first_row(header)
            if table == NOTICES and role in LOOP_ROLES:
                lines = self._store.add_notices(role, generation, first, payload)
                if self._feed is not None:
                    for line in lines:
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

    def _monitor_assumptions(self, check: "Callable[[], list[Finding]]") -> None:
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
        self._plane.publish("progress", content=self._progress.dumps())

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
