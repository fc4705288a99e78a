"""The recorder's process: takes the telemetry of all processes, keeps it, and shows it."""

import json
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from zenoh.handlers import FifoChannel, RingChannel

from cosim.analysis.claims.assumption_monitor import AssumptionMonitor
from cosim.analysis.claims.observed_conditions import AssumptionViolation
from cosim.output.viewer.live_viewer import LiveView
from cosim.output.viewer.recording import RunView
from cosim.output.viewer.recording_file import ViewError
from cosim.output.viewer.run_view import open_view, write_view
from cosim.output.viewer.table_feed import ViewFeed
from cosim.record.run_directory import SPOOL, in_flight
from cosim.record.run_record import RunRecord, finish_record, report_of, updates_in, write_reports
from noack.config.parameter_changes import ParameterChange, said_of
from noack.config.resolution import LoopMatrices, loop_of, tables_of
from noack.config.runtime_parameters import is_of_loss_alone
from noack.config.scenario import Scenario
from noack.core.clock import NS_PER_S
from noack.core.errors import ExitStatus, MachineError, PeerError
from noack.protocol.machine_interface import BEGINNING, GENERATION, RESTART, Notice, Start
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    NETEM_PACKET,
    OWNER,
    SENSOR_MEASUREMENT,
    effective,
)
from noack.protocol.topology import LOOP_ROLES, RECORDER
from noack.runtime.command_line import print_to_stderr
from noack.runtime.control_messages import LogLine, parse_message
from noack.runtime.control_plane import ControlPlane
from noack.runtime.process_entry import run_process
from noack.runtime.process_life import LAUNCHER_GONE, RunProcess
from noack.runtime.spool import SpoolWriter, read_chunks
from noack.runtime.telemetry import NOTICES, ReceivedRows, first_row, notice_number, notices_of

_POLL_S = 0.02
_SHOW_S = 0.1
_TOLD_S = 5.0
"""By then a recorder that is started anew has been told of everyone who is still there."""
_CONFIRM_S = 1.0
_BATCHES_IN_WAITING = 4096
"""A minute of them; each place of the ring takes 256 bytes once it has been used."""
_STOP_PATIENCE_S = 8.0


class Recorder:
    """Receives, spools and shows the telemetry of one run.

    Args:
        scenario: the resolved scenario.
        run_dir: the run's directory.
        plane: the control plane.
        view: shows the run; None does without.
        live: where the run can be watched, for the person who asked.
        start: where in the run it takes up its work; it may find another's spool.
    """

    def __init__(
        self,
        scenario: Scenario,
        run_dir: Path,
        plane: ControlPlane,
        view: RunView | None,
        live: str | None = None,
        *,
        start: Start = BEGINNING,
    ) -> None:
        self._loop: LoopMatrices = loop_of(scenario)
        self._types = tables_of(scenario)
        self._run_dir = run_dir
        self._plane = plane
        # The one before may have left half a batch at the end of its files.
        self._spool = SpoolWriter(run_dir / SPOOL, plane.instance if start.again else RECORDER)
        self._spool.prepare([*self._types, *map(notices_of, (*LOOP_ROLES, RECORDER))])
        self._feed = None if view is None else ViewFeed(scenario, view)
        self.lost: MachineError | None = None
        """Why what was recorded is not all on disk; known at the end."""
        self._monitor = AssumptionMonitor(scenario)
        self._told_blind = self._judges_no_more = False
        session, key = plane.session, plane.key
        self._batches = session.declare_subscriber(
            key("telemetry", "*", "*"), RingChannel(_BATCHES_IN_WAITING)
        )
        self._goodbyes = session.declare_queryable(key("goodbye", "*"), FifoChannel(64))
        self._lives = session.liveliness().declare_subscriber(
            key("alive", "*", "*"), RingChannel(256), history=True
        )
        self._got: defaultdict[tuple[str, str, int], ReceivedRows] = defaultdict(ReceivedRows)
        self._reports: dict[str, dict[str, Any]] = {}
        self._alive: dict[str, set[str]] = {}
        self._out_of_order = self._again = start.again
        self._began_s = time.monotonic()
        self._junk = 0
        self._account: dict[str, Any] = {
            "t_s": 0.0, "events": 0, "deliveries": 0, "longest_loss_burst": 0, "x_norm": None,
            "live": live, "void": [], "changes": [],
        }  # fmt: skip
        if start.again:
            self._monitor.stop("the recorder was started anew")
            self._take_over()

    @property
    def finished(self) -> bool:
        """Whether every process of the loop has handed over everything, or is gone."""
        # Who left before this recorder came does not say goodbye again.
        told = self._again and time.monotonic() - self._began_s > _TOLD_S
        return all(
            told if (alive := self._alive.get(role)) is None else alive <= self._reports.keys()
            for role in LOOP_ROLES
        )

    def poll(self) -> None:
        """Take everything that has arrived."""
        while (sample := self._batches.try_recv()) is not None:
            self._take(sample)
        while (query := self._goodbyes.try_recv()) is not None:
            self._goodbye(query)
        while (life := self._lives.try_recv()) is not None:
            role, instance = str(life.key_expr).split("/")[-2:]
            alive = self._alive.setdefault(role, set())
            if life.kind == zenoh.SampleKind.DELETE:
                alive.discard(instance)
            else:
                alive.add(instance)

    def judge_no_more(self) -> None:
        """Leave what follows to the summary: the run is stopped, its processes end one by one."""
        self._judges_no_more = True

    def show(self) -> None:
        """Bring the view and the coordinator up to date."""
        self._judge(self._monitor.advance)
        self._give_account()
        if self._feed is not None:
            try:
                self._feed.advance()
            except ViewError as error:
                self._give_up_view(error)

    def _give_account(self) -> None:
        self._plane.session.put(self._plane.key("progress"), json.dumps(self._account))

    def note(self, notice: Notice) -> None:
        """Take a line of its own for the run's log."""
        self._spool.append(notices_of(RECORDER), 0, json.dumps(notice._asdict()).encode())

    def change(self, change: ParameterChange, said: Mapping[str, Any]) -> None:
        """Take a change of the run's settings, and who said so when."""
        notice = said_of(
            change, f"; asked for at {said['said_ns'] / NS_PER_S:.3f} s, {said['said_at']}"
        )
        self.note(notice)
        self._account["changes"].append(notice.text)
        if not is_of_loss_alone(change.settings):
            self._monitor.end_at(change.t_ns / NS_PER_S)
        if self._feed is not None:
            self._feed.log(notice._asdict())

    def confirm(self) -> None:
        """Tell every process what of it is on disk, so that it need not keep it any longer.

        Raises:
            MachineError: what was written is on disk no more.
        """
        self._spool.require_present()
        newest: dict[str, int] = {}
        for role, _, generation in self._got:
            newest[role] = max(newest.get(role, 0), generation)
        for role, generation in newest.items():  # a process hears the last word only
            rows = {
                table: received.ranges
                for (of, table, number), received in self._got.items()
                if (of, number) == (role, generation)
            }
            self._plane.acknowledge_rows(role, {"generation": generation, "rows": rows})

    def finish(self) -> RunRecord:
        """Write the record; complete the view.

        Raises:
            MachineError: the record cannot be written; what was spooled is kept.
        """
        self._judge(self._monitor.end)
        self._give_account()
        try:
            self._spool.require_present()
        except MachineError as error:
            self.lost = error
        self._spool.close()
        write_reports(self._run_dir, self._reports.values())
        record = finish_record(self._run_dir)
        if self._feed is not None:
            try:
                self._feed.advance(final=True)
            except ViewError as error:
                self._give_up_view(error)
        return record

    def abandon(self) -> None:
        """Keep what was spooled, unfinished."""
        self._spool.close()

    @property
    def view_is_incomplete(self) -> bool:
        """Whether batches came late or out of order, so that the view should be written anew."""
        return self._out_of_order

    def _take(self, sample: zenoh.Sample) -> None:
        role, table = str(sample.key_expr).split("/")[-2:]
        payload = sample.payload.to_bytes()
        try:
            header = b"" if sample.attachment is None else sample.attachment.to_bytes()
            self._keep(role, table, *first_row(header), payload)
        except (PeerError, ValueError) as error:
            if not self._junk:
                print_to_stderr(f"noack recorder: ignored what is no telemetry: {error}")
            self._junk += 1

    def _keep(self, role: str, table: str, generation: int, first: int, payload: bytes) -> None:
        """Keep a batch, and show it.

        Raises:
            PeerError: it is none of a process of this run.
            ValueError: its rows are not whole.
        """
        if table == NOTICES and role in LOOP_ROLES:
            notice = parse_message(LogLine, payload)
            self._spool.append(notices_of(role), notice_number(generation, first), payload)
            self._got[role, table, generation].add(first, first + 1)
            if self._feed is not None:
                self._feed.log(notice | {"process": role})
            return
        if table not in self._types or OWNER[table] != role:
            raise PeerError(f"{role} has no table {table}")
        rows = np.frombuffer(payload, self._types[table])
        if not len(rows) or int(rows["input"][0]) // GENERATION != generation:
            raise PeerError("a batch without rows, or with those of another process")
        self._spool.append(table, first, payload)
        got = self._got[role, table, generation]
        follows = first == got.end
        got.add(first, first + len(rows))
        if not follows:
            self._out_of_order = True
            self._monitor.stop("telemetry is missing, or came out of turn")
        else:
            self._count(table, rows)
            self._monitor.take(table, rows)
            if self._feed is not None:
                self._feed.add(table, rows)

    @np.errstate(all="ignore")  # a run may diverge
    def _count(self, table: str, rows: np.ndarray[Any, np.dtype[np.void]]) -> None:
        account = self._account
        if table == SENSOR_MEASUREMENT:
            account["t_s"] = int(rows["t_ns"][-1]) / NS_PER_S
            account["events"] += int((rows["event"] >= 0).sum())
            account["x_norm"] = float(np.linalg.norm(rows["x"][-1]))
        elif table == CONTROLLER_DELIVERY:
            account["deliveries"] += len(rows)
            # With what was overtaken, which the network emulator does not know beforehand.
            self._see_run(rows["dropouts"])
        elif table == NETEM_PACKET:
            rows = updates_in(rows)[0]
            self._see_run(rows["consecutive_losses"][~effective(rows["fate"])])

    def _judge(self, guard: Callable[[], list[AssumptionViolation]]) -> None:
        """Say that claims are void, in the record, the view and the account."""
        if self._judges_no_more:
            return
        try:
            departures = guard()
        except Exception as error:  # whatever it is, what is recorded is recorded
            departures = []
            self._monitor.stop(repr(error))
        for one in departures:
            text = f"void (assumption violated) from {one.t_s:.3f} s on: {one.text}"
            notice = Notice(round(one.t_s * NS_PER_S), "void", text)
            self.note(notice)
            self._account["void"].append(text)
            if self._feed is not None:
                self._feed.log(notice._asdict())
        if self._monitor.stopped is not None and not self._told_blind:
            self._told_blind = True
            text = f"whether claims are void is told after the run only: {self._monitor.stopped}"
            self._account["void"].append(text)

    def _see_run(self, lost: np.ndarray[Any, np.dtype[np.int64]]) -> None:
        longest = int(lost.max(initial=0))
        self._account["longest_loss_burst"] = max(self._account["longest_loss_burst"], longest)

    def _goodbye(self, query: zenoh.Query) -> None:
        role = str(query.key_expr).rpartition("/")[2]
        try:
            report = self._report(role, query)
        except PeerError as error:
            self._plane.refuse(query, str(error))
            return
        # Telemetry travels at lower priority: what was sent before may still be under way.
        self._await_rows(report)
        missing = self._missing(report)
        if not missing:
            self._reports[report["instance"]] = report
        self._plane.answer(query, {"rows": missing})

    def _report(self, role: str, query: zenoh.Query) -> dict[str, Any]:
        if role not in LOOP_ROLES:
            raise PeerError(f"{role} has nothing to report")
        payload = b"" if query.payload is None else query.payload.to_bytes()
        report = report_of(role, payload, self._types)
        return {"generation": 0, "instance": ""} | report | {"process": role}

    def _await_rows(self, report: dict[str, Any]) -> None:
        deadline_s = time.monotonic() + 0.3
        while self._missing(report) and time.monotonic() < deadline_s:
            sample = self._batches.try_recv()
            if sample is None:
                time.sleep(0.005)
            else:
                self._take(sample)

    def _missing(self, report: dict[str, Any]) -> dict[str, list[tuple[int, int]]]:
        role, generation = report["process"], report["generation"]
        missing = {
            table: self._got[role, table, generation].missing(total)
            for table, total in report["rows"].items()
            if table == NOTICES or OWNER.get(table) == role
        }
        return {table: ranges for table, ranges in missing.items() if ranges}

    def _take_over(self) -> None:
        """Learn from the spool what the recorder before has kept."""
        for table, dtype in self._types.items():
            for first, data in read_chunks(self._run_dir / SPOOL, table):
                if len(data) and len(data) % dtype.itemsize == 0:
                    rows = np.frombuffer(data, dtype)
                    generation = int(rows["input"][0]) // GENERATION
                    self._got[OWNER[table], table, generation].add(first, first + len(rows))
                    self._count(table, rows)
        for role in LOOP_ROLES:
            for number, _ in read_chunks(self._run_dir / SPOOL, notices_of(role)):
                generation, first = divmod(number, GENERATION)
                self._got[role, NOTICES, generation].add(first, first + 1)

    def _give_up_view(self, error: ViewError) -> None:
        print_to_stderr(f"noack recorder: {error}; the numeric record goes on")
        self._feed = None
        self._out_of_order = True


def main(arguments: Sequence[str] | None = None) -> ExitStatus:
    """Run the recorder; ``--live`` also opens a viewer."""
    arguments = sys.argv[1:] if arguments is None else arguments
    live = "--live" in arguments

    def body(node: RunProcess) -> None:
        _record(node, live=live)

    return run_process(RECORDER, body)


def _record(node: RunProcess, *, live: bool) -> None:
    with in_flight(Path(node.ticket.run_dir)), ExitStack() as stack:
        live_view = None
        if live and not node.start.again:
            live_view = LiveView()
            stack.callback(live_view.close)  # one that stands still would not end by itself
        _record_run(node, live_view)


def _record_run(node: RunProcess, live_view: LiveView | None) -> None:
    run_dir = Path(node.ticket.run_dir)
    view = None
    if not node.start.again:  # else the recording is written anew in the end
        view = open_view(node.scenario, run_dir, node.ticket.run_id, live_view)
    recorder = Recorder(
        node.scenario,
        run_dir,
        node.plane,
        view,
        live_view.status if live_view else None,
        start=node.start,
    )
    if node.after is not None:
        recorder.note(Notice(node.start.from_ns, RESTART, f"started anew: {node.after}"))
    node.join(None)
    shown_s = stop_s = None
    confirmed_s = time.monotonic()
    while not recorder.finished:
        recorder.poll()
        if node.stopping:
            recorder.judge_no_more()
        for change, said in node.changes():
            recorder.change(change, said)
        now_s = time.monotonic()
        if shown_s is None or now_s - shown_s >= _SHOW_S:
            recorder.show()
            shown_s = now_s
        if now_s - confirmed_s >= _CONFIRM_S:
            recorder.confirm()
            confirmed_s = now_s
        if node.stopping:
            if node.ended in ("SIGINT", "SIGTERM"):
                break
            if node.ended == LAUNCHER_GONE:
                # The others spool their own last rows now; `noack summary` finishes the record.
                recorder.abandon()
                if view is not None:
                    view.close()
                return
            stop_s = stop_s or now_s
            if now_s - stop_s > _STOP_PATIENCE_S:
                break
        time.sleep(_POLL_S)
    recorder.poll()
    recorder.show()
    record = recorder.finish()
    try:
        if view is not None:
            view.close()
    except ViewError as error:
        print_to_stderr(f"noack recorder: {error}; the numeric record is whole")
    if recorder.view_is_incomplete:
        write_view(record, run_dir, node.ticket.run_id)
    if recorder.lost is not None:
        raise recorder.lost


if __name__ == "__main__":
    sys.exit(main())
