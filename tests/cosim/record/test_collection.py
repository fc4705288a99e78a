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
from cosim.record.spool_conversion import finish_record
from cosim.simulation.virtual_time import simulate
from noack.core.errors import CallerError, MachineError, NoackError, PeerError
from noack.protocol.record_tables import CONTROLLER_STEP, PLANT_STEP
from noack.runtime.spool import SPOOL, SpoolWriter, writer_of
from noack.runtime.telemetry import OwnSpool
from noack.scenario.resolution import resolve, run_tables
from noack.scenario.scenario_file import validate
from tests.helpers.summaries import alone

RUN = "0123456789abcdef"
SECRETS = {"controller": "known to the controller", "plant": "known to the plant"}
WRITER = {role: writer_of(secret) for role, secret in SECRETS.items()}


@pytest.fixture
def whole(content: dict[str, Any]) -> RunRecord:
    content["horizon_s"] = 2.0
    content["plant"]["rate_hz"] = 100.0
    content["controller"] = {"rate_hz": 100.0}
    return simulate(resolve(validate(content, "here")))


@pytest.fixture
def run_dir(whole: RunRecord, tmp_path: Path) -> Path:
    """A run whose record lacks the second half of the controller's ticks, and its report."""
    found = tmp_path / "runs" / "run"
    found.mkdir(parents=True)
    run_directory.write_scenario(whole.scenario, found)
    run_directory.write_environment(found, "live", RUN)
    reports = {role: one | {"process": role, "generation": 0} for role, one in whole.reports.items()}
    del reports["controller"]
    (found / run_directory.REPORTS_FILE).write_text(json.dumps(reports))
    joined = {WRITER[role]: {"process": role, "generation": 0} for role in SECRETS}
    (found / run_directory.PROCESSES_FILE).write_text(json.dumps(joined))
    tables = {table: whole[table] for table in whole.tables}
    tables[CONTROLLER_STEP] = tables[CONTROLLER_STEP][:100]
    write_run(alone(RunRecord(whole.scenario, tables, [], reports)), found)
    return found


def stored(record: RunRecord, table: str) -> Rows:
    """The rows of a table as its process stores them."""
    return with_loop(record[table], 0, run_tables(record.scenario)[table])


class Kept:
    """What a host kept: the second half of the controller's ticks, and its report."""

    def __init__(self, folder: Path, whole: RunRecord, role: str = "controller") -> None:
        self.folder, self.role = folder, role
        self.ticks = stored(whole, CONTROLLER_STEP)[100:]
        self.report = whole.reports["controller"] | {"instance": WRITER[role], "generation": 0}
        self.spool = OwnSpool(folder, role, SECRETS[role], RUN)

    def path(self, table: str) -> Path:
        return self.folder / SPOOL / f"{table}.{WRITER[self.role]}"

    def add(self, table: str, rows: Any) -> None:
        self.spool.append(table, json.dumps({"first": 100}).encode(), rows.tobytes())

    def keep(self) -> None:
        self.add(CONTROLLER_STEP, self.ticks)
        self.spool.keep_report(self.report)


@pytest.fixture
def kept(whole: RunRecord, tmp_path: Path) -> Iterator[Kept]:
    kept = Kept(tmp_path / "kept", whole)
    yield kept
    kept.spool._files.close()


def contents(folder: Path) -> dict[str, bytes]:
    """All files below a folder but the lock."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_kept_rows_complete_the_record_also_twice(run_dir: Path, kept: Kept, whole: RunRecord) -> None:
    kept.keep()
    for _ in range(2):
        _, roles = collect(run_dir, str(kept.folder), finish_record)
        assert roles == ["controller"]
        again = load_record(run_dir)
        assert not +missing_rows(again)
        for table in whole.tables:
            assert again[table].tobytes() == whole[table].tobytes(), table
        assert [path.name for path in run_dir.parent.iterdir()] == ["run"]


def test_a_truncated_file_gives_its_complete_batches(run_dir: Path, kept: Kept) -> None:
    for rows in (kept.ticks[:50], kept.ticks[50:]):
        kept.add(CONTROLLER_STEP, rows)
    path = kept.path(CONTROLLER_STEP)
    os.truncate(path, path.stat().st_size - 1)
    collect(run_dir, str(kept.folder), finish_record)
    assert load_record(run_dir).count(CONTROLLER_STEP) == 150


def other_role(kept: Kept, whole: RunRecord) -> None:
    kept.keep()
    kept.add(PLANT_STEP, stored(whole, PLANT_STEP))


def other_process(kept: Kept, whole: RunRecord) -> None:
    """Named after a process of another host, whose secret is not known here."""
    kept.keep()
    out = SpoolWriter(kept.folder / SPOOL, WRITER["plant"])
    out.append(PLANT_STEP, 0, stored(whole, PLANT_STEP).tobytes())
    out.append("key", 0, b"guessed")
    out.close()


def unknown_process(kept: Kept, whole: RunRecord) -> None:
    kept.keep()
    kept.path(CONTROLLER_STEP).rename(kept.folder / SPOOL / f"{CONTROLLER_STEP}.stranger")


def renumbered(kept: Kept, whole: RunRecord) -> None:
    kept.keep()
    kept.ticks["input"] += 10_000
    kept.add(CONTROLLER_STEP, kept.ticks)


def other_generation(kept: Kept, whole: RunRecord) -> None:
    kept.ticks["input"] += 2**40
    kept.keep()


def changed(kept: Kept, whole: RunRecord) -> None:
    rows = stored(whole, CONTROLLER_STEP)
    rows["u"][50] += 1.0
    rows["input"][0] -= 1  # so that the batch comes before the recorded one
    kept.add(CONTROLLER_STEP, rows)
    kept.spool.keep_report(kept.report)


def fewer_reported(kept: Kept, whole: RunRecord) -> None:
    kept.report["rows"] = kept.report["rows"] | {CONTROLLER_STEP: 150}
    kept.keep()


def report_of_another(kept: Kept, whole: RunRecord) -> None:
    kept.report["instance"] = WRITER["plant"]
    kept.keep()


def link(kept: Kept, whole: RunRecord) -> None:
    kept.keep()
    secret = kept.path(CONTROLLER_STEP).rename(kept.folder / "elsewhere")
    kept.path(CONTROLLER_STEP).symlink_to(secret)


def fifo(kept: Kept, whole: RunRecord) -> None:
    kept.keep()
    os.mkfifo(kept.path("controller_setting"))


def part_of_a_row(kept: Kept, whole: RunRecord) -> None:
    kept.keep()
    kept.add(CONTROLLER_STEP, np.zeros(7, np.uint8))


def huge_batch(kept: Kept, whole: RunRecord) -> None:
    kept.keep()
    with kept.path(CONTROLLER_STEP).open("ab") as file:
        file.write((0).to_bytes(8, "little") + (2**33).to_bytes(8, "little"))
        file.truncate(2**33 + 2**20)  # sparse


@pytest.mark.parametrize(
    ("attack", "reason"),
    [
        (other_role, "the controller has no table of this name"),
        (other_process, "the plant of this run did not run there"),
        (unknown_process, "is of no process that joined this run"),
        (other_generation, "has rows of another process"),
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
    run_dir: Path, kept: Kept, whole: RunRecord, attack: Callable[..., None], reason: str
) -> None:
    attack(kept, whole)
    before = contents(run_dir.parent)
    with pytest.raises(PeerError, match=reason) as caught:
        collect(run_dir, str(kept.folder), finish_record)
    assert len(str(caught.value).splitlines()) == 1
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
    run_dir: Path, kept: Kept, error: Exception, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise error

    kept.keep()
    before = contents(run_dir.parent)
    if isinstance(error, shutil.Error):
        monkeypatch.setattr(shutil, "copytree", fail)
    with pytest.raises(NoackError, match=reason):
        collect(run_dir, str(kept.folder), fail)
    assert contents(run_dir.parent) == before


def test_a_folder_without_kept_rows_of_this_run_is_refused(run_dir: Path, kept: Kept, tmp_path: Path) -> None:
    with pytest.raises(CallerError, match="nothing was kept there"):
        collect(run_dir, str(tmp_path), finish_record)
    kept.keep()
    (kept.folder / "run_name.txt").write_text("another")
    with pytest.raises(CallerError, match="it was kept of another run"):
        collect(run_dir, str(kept.folder), finish_record)
    (kept.folder / "run_name.txt").unlink()
    os.mkfifo(kept.folder / "run_name.txt")
    with pytest.raises(NoackError, match="it was kept of another run"):
        collect(run_dir, str(kept.folder), finish_record)
