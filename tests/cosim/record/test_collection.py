"""What hosts kept of a run is merged, and a hostile host changes no row of another process."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.analysis.summary.loop_statistics import missing_rows
from cosim.record import run_directory
from cosim.record.collection import collect
from cosim.record.record_source import with_loop
from cosim.record.record_writing import write_run
from cosim.record.run_record import Rows, RunRecord, load_record
from cosim.record.run_scenario import write_scenario
from cosim.record.spool_conversion import finish_record
from cosim.simulation.virtual_time import simulate
from noack.core.errors import CallerError, MachineError, NoackError, PeerError
from noack.protocol.record_tables import CONTROLLER_STEP, PLANT_STEP
from noack.runtime.spool import SPOOL, SpoolWriter, writer_of
from noack.runtime.telemetry import OwnSpool
from noack.scenario.resolution import resolve, run_tables
from noack.scenario.scenario_file import validate
from tests.helpers.summaries import run_of_one_loop

RUN = "0123456789abcdef"
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
    write_scenario(full_record.scenario, folder)
    run_directory.write_environment(folder, "live", RUN)
    reports = {role: report | {"process": role} for role, report in full_record.reports.items()}
    del reports["controller"]
    (folder / run_directory.REPORTS_FILE).write_text(json.dumps(reports))
    processes = {WRITER[role]: {"process": role} for role in SECRETS}
    (folder / run_directory.PROCESSES_FILE).write_text(json.dumps(processes))
    tables = {table: full_record[table] for table in full_record.tables}
    tables[CONTROLLER_STEP] = tables[CONTROLLER_STEP][:100]
    write_run(run_of_one_loop(RunRecord(full_record.scenario, tables, [], reports)), folder)
    return folder


def stored(record: RunRecord, table: str) -> Rows:
    """The rows of a table as its process stores them."""
    return with_loop(record[table], 0, run_tables(record.scenario)[table])


class HostFiles:
    """What a host kept: the second half of the controller's ticks, and its report."""

    def __init__(self, folder: Path, full_record: RunRecord, role: str = "controller") -> None:
        self.folder, self.role = folder, role
        self.ticks = stored(full_record, CONTROLLER_STEP)[100:]
        self.report = full_record.reports["controller"] | {"instance": WRITER[role]}
        self.spool = OwnSpool(folder, role, SECRETS[role], RUN)

    def path(self, table: str) -> Path:
        return self.folder / SPOOL / f"{table}.{WRITER[self.role]}"

    def add(self, table: str, rows: Any) -> None:
        self.spool.append(table, json.dumps({"first": 100}).encode(), rows.tobytes())

    def keep(self) -> None:
        self.add(CONTROLLER_STEP, self.ticks)
        self.spool.keep_report(self.report)


@pytest.fixture
def host_files(full_record: RunRecord, tmp_path: Path) -> Iterator[HostFiles]:
    host_files = HostFiles(tmp_path / "kept", full_record)
    yield host_files
    host_files.spool.files.close()


def contents(folder: Path) -> dict[str, bytes]:
    """All files below a folder but the lock."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_kept_rows_complete_the_record_also_twice(
    run_dir: Path, host_files: HostFiles, full_record: RunRecord
) -> None:
    host_files.keep()
    for _ in range(2):
        _, roles = collect(run_dir, str(host_files.folder), finish_record)
        assert roles == ["controller"]
        reloaded = load_record(run_dir)
        assert not +missing_rows(reloaded)
        for table in full_record.tables:
            assert reloaded[table].tobytes() == full_record[table].tobytes(), table
        assert [path.name for path in run_dir.parent.iterdir()] == ["run"]


def test_a_truncated_file_gives_its_complete_batches(run_dir: Path, host_files: HostFiles) -> None:
    for rows in (host_files.ticks[:50], host_files.ticks[50:]):
        host_files.add(CONTROLLER_STEP, rows)
    path = host_files.path(CONTROLLER_STEP)
    os.truncate(path, path.stat().st_size - 1)
    collect(run_dir, str(host_files.folder), finish_record)
    assert load_record(run_dir).count(CONTROLLER_STEP) == 150


def other_role(host_files: HostFiles, full_record: RunRecord) -> None:
    host_files.keep()
    host_files.add(PLANT_STEP, stored(full_record, PLANT_STEP))


def other_process(host_files: HostFiles, full_record: RunRecord) -> None:
    """Named after a process of another host, whose secret is not known here."""
    host_files.keep()
    spool = SpoolWriter(host_files.folder / SPOOL, WRITER["plant"])
    spool.append(PLANT_STEP, 0, stored(full_record, PLANT_STEP).tobytes())
    spool.append("key", 0, b"guessed")
    spool.close()


def unknown_process(host_files: HostFiles, full_record: RunRecord) -> None:
    host_files.keep()
    host_files.path(CONTROLLER_STEP).rename(host_files.folder / SPOOL / f"{CONTROLLER_STEP}.stranger")


def renumbered(host_files: HostFiles, full_record: RunRecord) -> None:
    host_files.keep()
    host_files.ticks["input"] += 10_000
    host_files.add(CONTROLLER_STEP, host_files.ticks)


def changed(host_files: HostFiles, full_record: RunRecord) -> None:
    rows = stored(full_record, CONTROLLER_STEP)
    rows["u"][50] += 1.0
    rows["input"][0] -= 1  # so that the batch comes before the recorded one
    host_files.add(CONTROLLER_STEP, rows)
    host_files.spool.keep_report(host_files.report)


def fewer_reported(host_files: HostFiles, full_record: RunRecord) -> None:
    host_files.report["rows"] = host_files.report["rows"] | {CONTROLLER_STEP: 150}
    host_files.keep()


def report_of_another(host_files: HostFiles, full_record: RunRecord) -> None:
    host_files.report["instance"] = WRITER["plant"]
    host_files.keep()


def link(host_files: HostFiles, full_record: RunRecord) -> None:
    host_files.keep()
    secret = host_files.path(CONTROLLER_STEP).rename(host_files.folder / "elsewhere")
    host_files.path(CONTROLLER_STEP).symlink_to(secret)


def fifo(host_files: HostFiles, full_record: RunRecord) -> None:
    host_files.keep()
    os.mkfifo(host_files.path("controller_setting"))


def part_of_a_row(host_files: HostFiles, full_record: RunRecord) -> None:
    host_files.keep()
    host_files.add(CONTROLLER_STEP, np.zeros(7, np.uint8))


def huge_batch(host_files: HostFiles, full_record: RunRecord) -> None:
    host_files.keep()
    with host_files.path(CONTROLLER_STEP).open("ab") as file:
        file.write((0).to_bytes(8, "little") + (2**33).to_bytes(8, "little"))
        file.truncate(2**33 + 2**20)  # sparse


@pytest.mark.parametrize(
    ("attack", "reason"),
    [
        (other_role, "the controller has no table of this name"),
        (other_process, "the plant of this run did not run there"),
        (unknown_process, "belongs to no process that joined this run"),
        (report_of_another, "is the report of another process"),
        (part_of_a_row, "is damaged"),
        (renumbered, "has 100 more than the controller reported"),
        (changed, "it has other rows of controller_step than were recorded"),
        (fewer_reported, "has 50 more than the controller reported"),
        (link, "is not a regular file"),
        (fifo, "is not a regular file"),
        (huge_batch, "has a batch of 8589934592 bytes"),
    ],
)
def test_a_hostile_host_changes_nothing(
    run_dir: Path, host_files: HostFiles, full_record: RunRecord, attack: Callable[..., None], reason: str
) -> None:
    attack(host_files, full_record)
    before = contents(run_dir.parent)
    with pytest.raises(PeerError, match=reason) as error:
        collect(run_dir, str(host_files.folder), finish_record)
    assert len(str(error.value).splitlines()) == 1
    assert contents(run_dir.parent) == before


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (ZeroDivisionError(), r"cannot be merged: ZeroDivisionError\(\)"),
        (CallerError("damaged"), "cannot be merged: damaged"),
        (
            MachineError("record: disk full; try again"),
            "^record: disk full; nothing was added from",
        ),
        (shutil.Error([("a", "b", "disk full")]), "nothing was added from .*: disk full"),
    ],
)
def test_a_record_that_cannot_be_completed_changes_nothing(
    run_dir: Path, host_files: HostFiles, error: Exception, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise error

    host_files.keep()
    before = contents(run_dir.parent)
    if isinstance(error, shutil.Error):
        monkeypatch.setattr(shutil, "copytree", fail)
    with pytest.raises(NoackError, match=reason):
        collect(run_dir, str(host_files.folder), fail)
    assert contents(run_dir.parent) == before


def test_a_folder_without_kept_rows_of_this_run_is_refused(
    run_dir: Path, host_files: HostFiles, tmp_path: Path
) -> None:
    with pytest.raises(CallerError, match="nothing was kept there"):
        collect(run_dir, str(tmp_path), finish_record)
    host_files.keep()
    (host_files.folder / "run_name.txt").write_text("another")
    with pytest.raises(CallerError, match="it belongs to another run"):
        collect(run_dir, str(host_files.folder), finish_record)
    (host_files.folder / "run_name.txt").unlink()
    os.mkfifo(host_files.folder / "run_name.txt")
    with pytest.raises(NoackError, match="it belongs to another run"):
        collect(run_dir, str(host_files.folder), finish_record)
