"""What hosts kept of a run is merged, and a hostile host changes no row of another process."""

import json
import os
import shutil
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.analysis.summary.loop_statistics import missing_rows
from cosim.record import run_directory
from cosim.record.added_rows import add_rows
from cosim.record.record_writing import write_run
from cosim.record.rows import with_loop
from cosim.record.run_record import Rows, RunRecord, load_record
from cosim.record.run_scenario import write_scenario
from cosim.record.spool_conversion import finish_record
from cosim.simulation.virtual_time import simulate
from netem.core.clock import NS_PER_S
from netem.core.errors import CallerError, MachineError, NoackError
from noack.protocol.record_tables import CONTROLLER_STEP, PLANT_STEP
from noack.runtime.control_messages import ClockError
from noack.runtime.spool import writer_of
from noack.runtime.unsent_rows_file import KeptFile, KeptHead
from noack.scenario.resolution import ResolvedRun, resolve
from noack.scenario.run_sections import ClocksSection
from noack.scenario.scenario_file import validate
from tests.cosim.record.changed_records import changed
from tests.helpers.summaries import run_of_one_loop

RUN = "0123456789abcdef"
CLOCKS = ClocksSection()
SECRETS = {"controller": "known to the controller", "plant": "known to the plant"}
WRITER = {role: writer_of(secret) for role, secret in SECRETS.items()}


@pytest.fixture
def full_record(content: dict[str, Any]) -> RunRecord:
    content["horizon_s"] = 2.0
    content["plant"]["rate_hz"] = 100.0
    content["controller"] = {"rate_hz": 100.0}
    return simulate(resolve(validate(content, "here")))


@pytest.fixture
def run_dir(full_record: RunRecord, tmp_path: Path) -> Path:
    """A run whose record lacks the second half of the controller's ticks, and its report."""
    folder = tmp_path / "runs" / "run"
    folder.mkdir(parents=True)
    write_scenario(ResolvedRun(full_record.scenario), folder)
    run_directory.write_environment(folder, "live", RUN)
    reports = {role: report | {"process": role} for role, report in full_record.reports.items()}
    del reports["controller"]
    (folder / run_directory.REPORTS_FILE).write_text(json.dumps(reports))
    processes = {WRITER[role]: role for role in SECRETS}
    (folder / run_directory.PROCESSES_FILE).write_text(json.dumps(processes))
    tables = {table: full_record[table] for table in full_record.tables}
    tables[CONTROLLER_STEP] = tables[CONTROLLER_STEP][:100]
    write_run(run_of_one_loop(RunRecord(full_record.scenario, tables, [], reports)), folder)
    return folder


def stored(record: RunRecord, table: str) -> Rows:
    """The rows of a table as its process stores them."""
    return with_loop(record[table], 0, ResolvedRun(record.scenario).tables[table])


class HostFile:
    """What a host kept: the second half of the controller's ticks, and its report."""

    def __init__(self, folder: Path, full_record: RunRecord, role: str = "controller") -> None:
        self.ticks = stored(full_record, CONTROLLER_STEP)[100:]
        self.report = full_record.reports["controller"] | {"instance": WRITER[role]}
        self._folder = folder
        self.head = KeptHead(run=RUN, process=role, secret=SECRETS[role])

    @cached_property
    def file(self) -> KeptFile:
        return KeptFile(self._folder, self.head)

    @property
    def path(self) -> Path:
        return self.file.path

    def add(self, table: str, rows: Any) -> None:
        self.file.append(table, json.dumps({"first": 100}).encode(), rows.tobytes())

    def keep(self) -> None:
        self.add(CONTROLLER_STEP, self.ticks)
        self.file.keep_report(self.report)


@pytest.fixture
def host_file(full_record: RunRecord, tmp_path: Path) -> HostFile:
    return HostFile(tmp_path / "kept", full_record)


def contents(folder: Path) -> dict[str, bytes]:
    """All files below a folder but the lock."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_kept_rows_complete_the_record_also_twice(
    run_dir: Path, host_file: HostFile, full_record: RunRecord
) -> None:
    host_file.keep()
    for _ in range(2):
        _, role = add_rows(run_dir, host_file.path, finish_record)
        assert role == "controller"
        reloaded = load_record(run_dir)
        assert not +missing_rows(reloaded)
        for table in full_record.tables:
            assert reloaded[table].tobytes() == full_record[table].tobytes(), table
        assert [path.name for path in run_dir.parent.iterdir()] == ["run"]


def test_a_truncated_file_gives_its_complete_parts(run_dir: Path, host_file: HostFile) -> None:
    for rows in (host_file.ticks[:50], host_file.ticks[50:]):
        host_file.add(CONTROLLER_STEP, rows)
    os.truncate(host_file.path, host_file.path.stat().st_size - 1)
    add_rows(run_dir, host_file.path, finish_record)
    assert load_record(run_dir).count(CONTROLLER_STEP) == 150


def test_of_an_unreachable_host_the_steps_up_to_the_end_are_missing(run_dir: Path) -> None:
    """The record has 100 of the 200 ticks, and no report of the controller."""
    record = load_record(run_dir)
    clock = ClockError(clock="b", error_ns=1, source="stated").fields()
    ended = {"clock": clock, "reached_ns": 2 * NS_PER_S}
    reports = {role: report | ended for role, report in record.reports.items()}
    apart = changed(record, reports=reports, scenario=record.scenario.model_copy(update={"clocks": CLOCKS}))
    assert (+missing_rows(apart))[CONTROLLER_STEP] in (100, 101)
    assert not (+missing_rows(record))[CONTROLLER_STEP]  # on one host the process has ended


def other_role(host_file: HostFile, full_record: RunRecord) -> None:
    host_file.keep()
    host_file.add(PLANT_STEP, stored(full_record, PLANT_STEP))


def other_process(host_file: HostFile, full_record: RunRecord) -> None:
    """In the name of a process of another host, whose secret is not known here."""
    host_file.head = KeptHead(run=RUN, process="plant", secret=SECRETS["controller"])
    host_file.add(PLANT_STEP, stored(full_record, PLANT_STEP))


def unknown_process(host_file: HostFile, full_record: RunRecord) -> None:
    host_file.head = host_file.head.model_copy(update={"secret": "guessed"})
    host_file.keep()


def another_run(host_file: HostFile, full_record: RunRecord) -> None:
    host_file.head = host_file.head.model_copy(update={"run": "another"})
    host_file.keep()


def renumbered(host_file: HostFile, full_record: RunRecord) -> None:
    host_file.keep()
    host_file.ticks["input"] += 10_000
    host_file.add(CONTROLLER_STEP, host_file.ticks)


def changed_rows(host_file: HostFile, full_record: RunRecord) -> None:
    rows = stored(full_record, CONTROLLER_STEP)
    rows["u"][50] += 1.0
    rows["input"][0] -= 1  # so that the batch comes before the recorded one
    host_file.add(CONTROLLER_STEP, rows)
    host_file.file.keep_report(host_file.report)


def fewer_reported(host_file: HostFile, full_record: RunRecord) -> None:
    host_file.report["rows"] = host_file.report["rows"] | {CONTROLLER_STEP: 150}
    host_file.keep()


def report_of_another(host_file: HostFile, full_record: RunRecord) -> None:
    host_file.report["instance"] = WRITER["plant"]
    host_file.keep()


def fifo(host_file: HostFile, full_record: RunRecord) -> None:
    host_file.path.unlink()
    os.mkfifo(host_file.path)


def part_of_a_row(host_file: HostFile, full_record: RunRecord) -> None:
    host_file.keep()
    host_file.add(CONTROLLER_STEP, np.zeros(7, np.uint8))


def huge_part(host_file: HostFile, full_record: RunRecord) -> None:
    host_file.keep()
    with host_file.path.open("ab") as file:
        file.write(b'{"table": "controller_step", "first": 0, "bytes": 8589934592}\n')
        file.truncate(2**33 + 2**20)  # sparse


def no_file_of_noack(host_file: HostFile, full_record: RunRecord) -> None:
    host_file.path.write_bytes(b"\x89PNG")


@pytest.mark.parametrize(
    ("attack", "reason"),
    [
        (other_role, "the controller has no table 'plant_step'"),
        (other_process, "it is not of the plant of this run"),
        (unknown_process, "it is not of the controller of this run"),
        (another_run, "it belongs to another run than "),
        (report_of_another, "it has the report of another process"),
        (part_of_a_row, "damaged: part of a row of controller_step"),
        (renumbered, "has 100 more than the controller reported"),
        (changed_rows, "it has other rows of controller_step than were recorded"),
        (fewer_reported, "has 50 more than the controller reported"),
        (fifo, "cannot be read: not a regular file"),
        (huge_part, "damaged: not a valid kept part: bytes"),
        (no_file_of_noack, "not a file of rows that a process kept"),
    ],
)
def test_a_hostile_host_changes_nothing(
    run_dir: Path, host_file: HostFile, full_record: RunRecord, attack: Callable[..., None], reason: str
) -> None:
    attack(host_file, full_record)
    before = contents(run_dir.parent)
    with pytest.raises(NoackError, match=reason) as error:
        add_rows(run_dir, host_file.path, finish_record)
    assert len(str(error.value).splitlines()) == 1
    assert contents(run_dir.parent) == before


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (ZeroDivisionError(), r"its rows cannot be merged: ZeroDivisionError\(\)"),
        (CallerError("damaged"), "its rows cannot be merged: damaged"),
        (
            MachineError("record: disk full; try again"),
            "^record: disk full; nothing was added from",
        ),
        (shutil.Error([("a", "b", "disk full")]), "nothing was added from .*: disk full"),
    ],
)
def test_a_record_that_cannot_be_completed_changes_nothing(
    run_dir: Path, host_file: HostFile, error: Exception, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise error

    host_file.keep()
    before = contents(run_dir.parent)
    if isinstance(error, shutil.Error):
        monkeypatch.setattr(shutil, "copytree", fail)
    with pytest.raises(NoackError, match=reason):
        add_rows(run_dir, host_file.path, fail)
    assert contents(run_dir.parent) == before
