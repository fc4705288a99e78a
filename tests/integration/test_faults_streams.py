"""The launcher's streams are closed or full, or their reader ends."""

import contextlib
import fcntl
import os
import subprocess
from pathlib import Path

import numpy as np
import psutil
import pytest

import cosim.live.launcher
from cosim.record.run_directory import new_run_dir
from cosim.record.run_record import load_record
from cosim.shipped_files import find_shipped
from noack.core.errors import MachineError
from noack.protocol.topology import ROLES
from noack.scenario.scenario_file import load
from tests.integration import conftest as live

HORIZON_S = 8.0
SHORT = [*live.AT_RATE, *live.settings(speed=4.0, horizon_s=HORIZON_S)]
F_SETPIPE_SZ = 1031
AS_A_TERMINAL = os.environ | {"FORCE_COLOR": "1", "TERM": "dumb"}
"""A terminal that cannot redraw a line: progress is printed line by line, also to a pipe."""


def run(runs: Path) -> list[str]:
    return live.noack_command("run", "lane_following", "--runs", str(runs), *live.BARE, *SHORT)


def is_whole(run_dir: Path) -> bool:
    steps = load_record(run_dir)["plant_step"]
    return np.array_equal(steps["sequence"], np.arange(HORIZON_S * live.RATE_HZ + 1))


def test_a_run_with_closed_streams_is_complete(tmp_path: Path) -> None:
    """Closed by a shell's ``<&- >&- 2>&-``: files opened next get the descriptors 0 to 2."""
    shell = ["/bin/sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", *run(tmp_path)]
    assert subprocess.run(shell, timeout=live.PATIENCE_S, check=False).returncode == 0
    run_dir = (tmp_path / "latest").resolve()
    assert is_whole(run_dir)
    assert {log.read_text() for log in (run_dir / "logs").iterdir()} == {""}


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="sets the size of a pipe")
def test_a_full_and_then_closed_pipe_does_not_disturb_the_run(tmp_path: Path) -> None:
    """The launcher is blocked until the reader of its progress closes the pipe."""
    reading, writing = os.pipe()
    fcntl.fcntl(writing, F_SETPIPE_SZ, 4096)
    process = subprocess.Popen(
        run(tmp_path), stdout=subprocess.DEVNULL, stderr=writing, env=AS_A_TERMINAL
    )
    os.close(writing)
    try:
        rows = tmp_path / "latest" / "spool" / "plant_step.recorder"  # from the start on
        live.wait_for(lambda: rows.exists() or process.poll() is not None)
        filling = os.open(f"/proc/self/fd/{reading}", os.O_WRONLY | os.O_NONBLOCK)
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(filling, b"x")
        os.close(filling)

        def has_ended() -> bool:
            """Whether the loop and the recorder have: none runs, reaped by the launcher or not."""
            return all(live.child_of(process, role) is None for role in ROLES)

        live.wait_for(has_ended)  # although the pipe is not read
    finally:
        os.close(reading)
        status = process.wait(live.PATIENCE_S)
    assert status == 0
    assert is_whole((tmp_path / "latest").resolve())


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
