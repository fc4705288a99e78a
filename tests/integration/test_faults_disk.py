"""A full or removed disk gives one error line, and all stored rows stay readable."""

import json
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from cosim.cli import app
from cosim.live.finalize import reopen
from cosim.record.run_record import load_record
from noack.core.errors import MachineError
from tests.integration import conftest as live

Start = Callable[..., live.Running]


class Disk:
    """A separate small disk."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._filler = path / "filler"

    def fill(self, *, but_bytes: int = 0) -> None:
        """Fill the disk; leave at most ``but_bytes`` free."""
        self.empty()
        room = shutil.disk_usage(self.path).free - but_bytes
        with self._filler.open("wb", buffering=0) as file:
            while room > 0:  # other processes may write at the same time
                try:
                    room -= file.write(bytes(min(room, 1 << 16)))
                except OSError:
                    break

    def empty(self) -> None:
        """Free the space again."""
        self._filler.unlink(missing_ok=True)


def mounted(path: Path, *options: str) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root may mount a disk")
    done = subprocess.run(
        ["mount", *options, str(path)], capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        pytest.skip(f"no disk can be mounted here: {done.stderr.strip()}")


@pytest.fixture
def small(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Disk]:
    """A disk of the given size in MiB that contains the runs of ``start``."""
    path = tmp_path / "runs"
    path.mkdir()
    mounted(path, "-t", "tmpfs", "-o", f"size={request.param}m", "noack-test")
    try:
        yield Disk(path)
    finally:
        subprocess.run(["umount", "--lazy", str(path)], check=True)


def noack(*arguments: str) -> Result:
    return CliRunner().invoke(app, arguments)


@pytest.mark.parametrize("small", [64], indirect=True)
def test_a_run_on_a_disk_that_fills_up_can_be_finalised_later(
    start: Start, small: Disk, capsys: pytest.CaptureFixture[str]
) -> None:
    running = start(*live.AT_RATE, *live.settings(speed=4.0, horizon_s=240.0))
    running.wait_recording()
    run_dir = (running.runs / "latest").resolve()
    small.fill()
    stdout, stderr = running.process.communicate(timeout=live.PATIENCE_S)
    lines = [line for line in stderr.splitlines() if line.startswith("noack")]
    assert running.process.returncode == 1
    # Whoever writes first on the full disk: the recorder, or a process for which it is too slow.
    # "ended early": a recorder that needs more than 5 s to exit is not waited for.
    reason = f": {run_dir / 'spool'}: the record cannot be written: No space left on device"
    assert lines[0].startswith("noack: the run failed: ")
    assert lines[0].replace(" ended early", "").endswith(reason)
    assert lines[1].startswith(f"noack: {run_dir / 'record'}: the record cannot be written: No spa")
    assert f"kept in {run_dir / 'spool'}" in lines[1]
    assert len(lines) == 2, stderr
    assert "No space left on device" in stdout  # as JSON
    assert running.left_behind() == []
    spooled = {path.name: path.stat().st_size for path in (run_dir / "spool").iterdir()}

    with pytest.raises(MachineError) as refused:
        reopen(run_dir)
    assert str(refused.value).splitlines() == [line.removeprefix("noack: ") for line in lines]
    assert {path.name: path.stat().st_size for path in (run_dir / "spool").iterdir()} == spooled

    small.empty()
    assert noack("summary", str(run_dir)).exit_code == 0
    record = load_record(run_dir)
    for table in ("plant_step", "sensor_measurement", "controller_step"):
        rows = record[table]
        bytes_on_disk = sum(size for name, size in spooled.items() if name.startswith(table))
        batches_at_most, row_bytes = len(rows) / 4 + 2, rows.itemsize + 2  # and the loop
        assert len(rows) * row_bytes >= bytes_on_disk - 16 * batches_at_most - row_bytes
        assert np.array_equal(rows["sequence"], np.arange(len(rows)))
    assert not (run_dir / "spool").exists()
    assert (run_dir / "report.html").stat().st_size > 100_000

    summary = json.loads((run_dir / "summary.json").read_text())
    assert summary["exit"]["status"] == 1
    failed = summary["exit"]["reason"]
    assert lines[0] == f"noack: the run failed: {failed}"
    assert failed in (run_dir / "report.html").read_text()
    missing = summary["loops"][0]["missing_samples"]
    # Fill the disk before the summary is written, then before the report is written.
    for path in (run_dir / "summary.json", run_dir / "report.html"):
        path.unlink()
    small.fill()
    line = f"\n{run_dir / 'summary.json'}: cannot be written: No space left on device;[^\n]*$"
    with pytest.raises(MachineError, match=line):
        reopen(run_dir)
    small.fill(but_bytes=1 << 16)
    again = reopen(run_dir)
    assert (again.reason, again.summary.loops[0].missing_samples) == (failed, missing)
    warning = capsys.readouterr().err
    assert warning.startswith(f"noack: warning: no report.html: {run_dir}")
    assert warning.endswith("No space left on device\n")
    assert not list(run_dir.rglob("*.partial"))


@pytest.mark.parametrize("small", [8], indirect=True)
def test_a_run_does_not_begin_on_a_full_disk(small: Disk) -> None:
    done = noack("run", "lane_following", "--runs", str(small.path), *live.EPHEMERAL)
    assert done.exit_code == 1
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith(f"noack: {small.path}: only ")
    assert list(small.path.iterdir()) == []


def test_a_removed_run_directory_ends_the_run_with_clear_lines(start: Start) -> None:
    running = start(*live.AT_RATE, *live.settings(speed=4.0, horizon_s=400.0))
    running.wait_recording()
    run_dir = (running.runs / "latest").resolve()
    run_dir.rename(running.runs.parent / "removed")  # at once; rmtree would race with new files
    _, stderr = running.process.communicate(timeout=live.PATIENCE_S)
    assert running.process.returncode == 1
    lines = [line for line in stderr.splitlines() if line.startswith("noack")]
    assert len(lines) == 2, stderr
    assert lines[0].startswith(f"noack: the run failed: recorder: {run_dir}")
    assert lines[0].endswith(": was deleted or moved during the run")
    assert lines[1].startswith(f"noack: {run_dir}: the run cannot be written: No such file")
    assert "Traceback" not in stderr
    assert running.left_behind() == []
    assert not run_dir.exists()
