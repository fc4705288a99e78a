"""The recorder's process: takes the telemetry of all processes, keeps it, and shows it."""

import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from zenoh.handlers import FifoChannel, RingChannel

from cosim.environment import Kind
from cosim.record import RunRecord, finish_record, report_of, tables_of, updates_in
from cosim.run_dir import RECORDING_FILE, REPORTS_FILE, SPOOL, under_way
from cosim.viewer.feed import ViewFeed
from cosim.viewer.live import LiveView
from cosim.viewer.recording import RunView, ViewError
from noack.clock import NS_PER_S
from noack.errors import ExitStatus, PeerError
from noack.io.messages import LogLine, heard
from noack.io.node import LAUNCHER_GONE, Node
from noack.io.plane import Plane
from noack.io.process import run_process
from noack.io.spool import SpoolWriter
from noack.io.telemetry import NOTICES, first_row, missing_ranges, notices_of
from noack.records import (
    CONTROLLER_DELIVERY,
    NETEM_PACKET,
    OWNER,
    SENSOR_MEASUREMENT,
    effective,
)
from noack.resolve import Loop, loop_of
from noack.scenario import Scenario
from noack.topology import LOOP_ROLES, RECORDER
from noack.trigger.text import trigger_text

_POLL_S = 0.02
_SHOW_S = 0.1
_BATCHES_IN_WAITING = 100_000
_STOP_PATIENCE_S = 8.0


class Recorder:
    """Receives, spools and shows the telemetry of one run.

    Args:
        scenario: the resolved scenario.
        run_dir: the run's directory.
        plane: the control plane.
        view: shows the run; None does without.
        live: where the run can be watched, for the person who asked.
    """

    def __init__(
        self,
        scenario: Scenario,
        run_dir: Path,
        plane: Plane,
        view: RunView | None,
        live: str | None = None,
    ) -> None:
        self._loop: Loop = loop_of(scenario)
        self._types = tables_of(scenario)
        self._run_dir = run_dir
        self._plane = plane
        self._spool = SpoolWriter(run_dir / SPOOL, RECORDER)
        self._feed = None if view is None else ViewFeed(scenario, view)
        session, key = plane.session, plane.key
        self._batches = session.declare_subscriber(
            key("telemetry", "*", "*"), RingChannel(_BATCHES_IN_WAITING)
        )
        self._goodbyes = session.declare_queryable(key("goodbye", "*"), FifoChannel(64))
        self._lives = session.liveliness().declare_subscriber(key("alive", "*"), RingChannel(256))
        self._got: dict[str, list[tuple[int, int]]] = {}
        self._reports: dict[str, Any] = {}
        self._gone: set[str] = set()
        self._out_of_order = False
        self._junk = 0
        self._account: dict[str, Any] = {
            "t_s": 0.0, "events": 0, "deliveries": 0, "longest_drop_run": 0, "x_norm": None,
            "live": live,
        }  # fmt: skip

    @property
    def finished(self) -> bool:
        """Whether every process of the loop has handed over everything, or is gone."""
        return all(role in self._reports or role in self._gone for role in LOOP_ROLES)

    def poll(self) -> None:
        """Take everything that has arrived."""
        while (sample := self._batches.try_recv()) is not None:
            self._take(sample)
        while (query := self._goodbyes.try_recv()) is not None:
            self._goodbye(query)
        while (life := self._lives.try_recv()) is not None:
            role = str(life.key_expr).rpartition("/")[2]
            if life.kind == zenoh.SampleKind.DELETE:
                self._gone.add(role)

    def show(self) -> None:
        """Bring the view and the coordinator up to date."""
        self._plane.session.put(self._plane.key("progress"), json.dumps(self._account))
        if self._feed is not None:
            try:
                self._feed.advance()
            except ViewError as error:
                self._give_up_view(error)

    def finish(self) -> RunRecord:
        """Write the record; complete the view.

        Raises:
            MachineError: the record cannot be written; what was spooled is kept.
        """
        self._spool.close()
        (self._run_dir / REPORTS_FILE).write_text(
            json.dumps(self._reports, indent=2), encoding="utf-8"
        )
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
            self._keep(role, table, first_row(header), payload)
        except (PeerError, ValueError) as error:
            if not self._junk:
                print(f"noack recorder: ignored what is no telemetry: {error}", file=sys.stderr)
            self._junk += 1

    def _keep(self, role: str, table: str, first: int, payload: bytes) -> None:
        """Keep a batch, and show it.

        Raises:
            PeerError: it is none of a process of this run.
            ValueError: its rows are not whole.
        """
        if table == NOTICES and role in LOOP_ROLES:
            notice = heard(LogLine, payload)
            self._spool.append(notices_of(role), first, payload)
            if self._feed is not None:
                self._feed.log(notice | {"process": role})
            return
        if table not in self._types or OWNER[table] != role:
            raise PeerError(f"{role} has no table {table}")
        rows = np.frombuffer(payload, self._types[table])
        if not len(rows):
            raise PeerError("a batch without rows")
        self._spool.append(table, first, payload)
        got = self._got.setdefault(table, [])
        following = got[-1][1] if got else 0
        got.append((first, first + len(rows)))
        if first != following:
            self._out_of_order = True
        else:
            self._count(table, rows)
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
            self._see_run(rows["drop_run"][~effective(rows["fate"])])

    def _see_run(self, lost: np.ndarray[Any, np.dtype[np.int64]]) -> None:
        longest = int(lost.max(initial=0))
        self._account["longest_drop_run"] = max(self._account["longest_drop_run"], longest)

    def _goodbye(self, query: zenoh.Query) -> None:
        role = str(query.key_expr).rpartition("/")[2]
        try:
            report = self._report(role, query)
        except PeerError as error:
            self._plane.refuse(query, str(error))
            return
        # Telemetry travels at lower priority: what was sent before may still be under way.
        self._await_rows(report["rows"])
        missing = self._missing(report["rows"])
        if not missing:
            self._reports[role] = report
        self._plane.answer(query, missing)

    def _report(self, role: str, query: zenoh.Query) -> dict[str, Any]:
        if role not in LOOP_ROLES:
            raise PeerError(f"{role} has nothing to report")
        payload = b"" if query.payload is None else query.payload.to_bytes()
        return report_of(role, payload, self._types)

    def _await_rows(self, totals: dict[str, int]) -> None:
        deadline_s = time.monotonic() + 0.3
        while self._missing(totals) and time.monotonic() < deadline_s:
            sample = self._batches.try_recv()
            if sample is None:
                time.sleep(0.005)
            else:
                self._take(sample)

    def _missing(self, totals: dict[str, int]) -> dict[str, list[tuple[int, int]]]:
        missing = {
            table: missing_ranges(self._got.get(table, ()), total)
            for table, total in totals.items()
            if table != NOTICES
        }
        return {table: ranges for table, ranges in missing.items() if ranges}

    def _give_up_view(self, error: ViewError) -> None:
        print(f"noack recorder: {error}; the numeric record goes on", file=sys.stderr)
        self._feed = None
        self._out_of_order = True


def open_view(
    scenario: Scenario,
    run_dir: Path,
    run_id: int,
    live: LiveView | None,
    kind: Kind = "live",
) -> RunView:
    """Create the recording of a run."""
    loop = loop_of(scenario)
    return RunView(
        run_dir / RECORDING_FILE,
        run_id=f"{run_id:016x}",
        title=f"{scenario.name} ({scenario.mode})",
        about=about(scenario, kind),
        state_names=loop.state_names,
        input_names=loop.input_names,
        processes=LOOP_ROLES if kind == "live" else (),
        live=live,
    )


def about(scenario: Scenario, kind: Kind = "live") -> str:
    """Markdown that says what the view shows."""
    network = scenario.network
    late = {
        "live": "* **Lateness**: wall time by which each process acted after its input was due.",
        "simulated": "* The run was **simulated**, in virtual time: nothing was ever late.",
    }[kind]
    protocol, x_s_is_reset = "Nothing is acknowledged.", "at every event"
    if scenario.is_acknowledged:
        protocol, x_s_is_reset = "**Updates are acknowledged.**", "when an update is acknowledged"
    hold = "a model of the plant" if scenario.mode == "model" else "a zero-order hold"
    return f"""# {scenario.name}

{scenario.description}

Sensor and controller run **{hold}** between updates. The sensor transmits when
{trigger_text(scenario.trigger)}.
The network ({network.loss.model.replace("_", "-")} loss) drops at most
M − 1 = {network.mansd} packets in a row. {protocol}

* **States**: the plant's x, the sensor's model x_s (reset {x_s_is_reset}), the controller's model
  x_c (reset only by what survives). Where x_c leaves the other two, packets were lost.
* **Intervals**: time since the last broadcast, and since the last reception.
* **Errors**: e_s = x_s − x against its threshold, and e_c = x_c − x, which nobody in the loop can
  measure, below what is known of it: the bound from identity (I1), and the certified one, which
  holds as long as nothing is later than the certificate allows (the summary's claims say so).
{late}
"""


def main(arguments: Sequence[str] | None = None) -> ExitStatus:
    """Run the recorder; ``--live`` also opens a viewer."""
    arguments = sys.argv[1:] if arguments is None else arguments
    live = "--live" in arguments

    def body(node: Node) -> None:
        _record(node, live=live)

    return run_process(RECORDER, body)


def _record(node: Node, *, live: bool) -> None:
    with under_way(Path(node.ticket.run_dir)):
        _record_run(node, live=live)


def _record_run(node: Node, *, live: bool) -> None:
    run_dir = Path(node.ticket.run_dir)
    live_view = LiveView() if live else None
    view = open_view(node.scenario, run_dir, node.ticket.run_id, live_view)
    recorder = Recorder(
        node.scenario, run_dir, node.plane, view, live_view.status if live_view else None
    )
    node.join(None)
    shown_s = stop_s = None
    while not recorder.finished:
        recorder.poll()
        now_s = time.monotonic()
        if shown_s is None or now_s - shown_s >= _SHOW_S:
            recorder.show()
            shown_s = now_s
        if node.stopping:
            if node.ended in ("SIGINT", "SIGTERM"):
                break
            if node.ended == LAUNCHER_GONE:
                # The others spool their own last rows now; `noack summary` finishes the record.
                recorder.abandon()
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
        view.close()
    except ViewError as error:
        print(f"noack recorder: {error}; the numeric record is whole", file=sys.stderr)
    if recorder.view_is_incomplete:
        write_view(record, run_dir, node.ticket.run_id)


def write_view(record: RunRecord, run_dir: Path, run_id: int) -> None:
    """Write a run's recording from its finished record."""
    with open_view(record.scenario, run_dir, run_id, None, record.kind) as view:
        feed = ViewFeed(record.scenario, view)
        for table in record.tables:
            feed.add(table, record[table])
        for notice in record.notices:
            feed.log(notice)
        feed.advance(final=True)


if __name__ == "__main__":
    sys.exit(main())
