"""The launcher's streams are closed or full, or their reader ends."""

import fcntl
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import psutil
import pytest

import cosim.live.launcher
from cosim.record.run_directory import new_run_dir
from cosim.record.run_record import load_record
from cosim.shipped_files import find_shipped
from noack.config.scenario_file import load
from noack.core.errors import MachineError
from noack.runtime.spool import SpoolWriter
from tests.integration.conftest import (
    AT_RATE,
    BARE,
    PATIENCE_S,
    RATE_HZ,
    is_over,
    noack_command,
    settings,
    wait_for,
)

HORIZON_S = 8.0
SHORT = [*AT_RATE, *settings(speed=4.0, horizon_s=HORIZON_S)]
F_SETPIPE_SZ = 1031
AS_A_TERMINAL = os.environ | {"FORCE_COLOR": "1", "TERM": "dumb"}
"""A terminal that cannot redraw a line: progress is printed line by line, also to a pipe."""
EVENTS, VOID = " s  events ", "void (assumption violated) from "


def run(runs: Path) -> list[str]:
    return noack_command("run", "lane_following", "--runs", str(runs), *BARE, *SHORT)


def is_whole(run_dir: Path) -> bool:
    steps = load_record(run_dir)["plant_step"]
    return np.array_equal(steps["sequence"], np.arange(HORIZON_S * RATE_HZ + 1))


def test_a_run_with_closed_streams_is_complete(tmp_path: Path) -> None:
    """Closed by a shell's ``<&- >&- 2>&-``: files opened next get the descriptors 0 to 2."""
    shell = ["/bin/sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", *run(tmp_path), "--report"]
    assert subprocess.run(shell, timeout=PATIENCE_S, check=False).returncode == 0
    run_dir = (tmp_path / "latest").resolve()
    assert is_whole(run_dir)
    assert (run_dir / "report.html").exists()
    assert {log.read_text() for log in (run_dir / "logs").iterdir()} == {""}


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="sets the size of a pipe")
def test_a_full_pipe_blocks_the_launcher_but_not_the_loop(tmp_path: Path) -> None:
    reading, writing = os.pipe()
    room = fcntl.fcntl(writing, F_SETPIPE_SZ, 4096)
    os.write(writing, b"x" * (room - 10))
    process = subprocess.Popen(
        run(tmp_path), stdout=subprocess.DEVNULL, stderr=writing, env=AS_A_TERMINAL
    )
    os.close(writing)
    try:
        latest = tmp_path / "latest"
        wait_for(lambda: latest.exists() or process.poll() is not None)
        loop = psutil.Process(process.pid).children()
        # The loop and the recorder end although the pipe is not read.
        wait_for(lambda: all(is_over(child) for child in loop))
        assert process.poll() is None
        assert any(child.is_running() for child in loop)  # not reaped yet
    finally:
        with os.fdopen(reading, "rb") as pipe:
            said = pipe.read()[room - 10 :].decode()
    assert process.wait(PATIENCE_S) == 0
    # The blocked output is complete. On a slow machine, claims can be void before the first
    # progress line, and no progress line follows.
    assert said.endswith("\n")
    assert all(EVENTS in line or VOID in line for line in said.splitlines())
    assert said
    assert is_whole(latest.resolve())


@pytest.fixture(scope="module")
def unheard(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run; the reader of its progress closed the pipe after the first line."""
    runs = tmp_path_factory.mktemp("runs")
    with subprocess.Popen(
        run(runs), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=AS_A_TERMINAL
    ) as process:
        assert process.stderr is not None
        assert process.stderr.readline()
        process.stderr.close()
        assert process.wait(PATIENCE_S) == 0
    return (runs / "latest").resolve()


def test_a_closed_pipe_does_not_end_the_run(unheard: Path) -> None:
    assert is_whole(unheard)


def test_rows_spooled_after_the_end_are_merged(unheard: Path, tmp_path: Path) -> None:
    run_dir = shutil.copytree(unheard, tmp_path / "run")
    record = load_record(run_dir)
    writer = SpoolWriter(run_dir / "spool", "plant")
    late = record["plant_step"][-30:].copy()
    late["input"] += 30
    writer.append("plant_step", 0, record["plant_step"][-60:].tobytes())
    writer.append("plant_step", 60, late.tobytes())
    writer.close()
    done = subprocess.run(
        noack_command("summary", str(run_dir), "--json"),
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    merged = load_record(run_dir)
    assert len(merged["plant_step"]) > len(record["plant_step"])
    for table in ("sensor_measurement", "controller_step", "netem_packet"):
        assert np.array_equal(merged[table], record[table])
    assert not (run_dir / "spool").exists()


def test_a_log_that_cannot_be_written_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def with_a_folder_in_the_way(runs: Path, name: str) -> Path:
        run_dir = new_run_dir(runs, name)
        (run_dir / "logs" / "sensor.log").mkdir()
        return run_dir

    monkeypatch.setattr(cosim.live.launcher, "new_run_dir", with_a_folder_in_the_way)
    scenario = load(find_shipped("lane_following", "scenarios"), ["ports={}"])
    before = psutil.Process().children()
    with pytest.raises(MachineError, match=r"^sensor cannot be started: .*logs/sensor\.log"):
        cosim.live.launcher.launch(scenario, tmp_path)
    assert psutil.Process().children() == before
