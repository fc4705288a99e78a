"""A step of the wall clock by an hour during a run."""

import mmap
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cosim.record.run_record import load_record
from tests.integration.conftest import AT_RATE, RATE_HZ, ROLE_MODULES, Running, settings
from tests.integration.test_faults import wait_recording

Start = Callable[..., Running]
HOUR_S = 3600
WITNESS = "import sys, time\nfor _ in sys.stdin: print(time.time(), time.monotonic(), flush=True)"


class WallClock:
    """A wall clock that can be stepped, for processes with its environment.

    Args:
        folder: the folder for its files.
    """

    def __init__(self, folder: Path) -> None:
        compiler = shutil.which("cc")
        if compiler is None or sys.platform != "linux":
            pytest.skip("needs Linux and a C compiler")
        library, offset = folder / "stepped_clock.so", folder / "offset"
        source = Path(__file__).with_name("stepped_clock.c")
        command = [compiler, "-shared", "-fPIC", "-O1", "-o", str(library), str(source), "-ldl"]
        subprocess.run(command, check=True)
        offset.write_bytes(bytes(8))
        with offset.open("r+b") as file:
            self._offset_s = mmap.mmap(file.fileno(), 8)
        self.environment = {"LD_PRELOAD": str(library), "STEPPED_CLOCK": str(offset)}

    def step_to(self, offset_s: int) -> None:
        """Set the clock's offset from the true time."""
        self._offset_s[:] = offset_s.to_bytes(8, sys.byteorder, signed=True)


class Witness:
    """A process that prints the clocks in this environment."""

    def __init__(self, environment: dict[str, str]) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", WITNESS],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            env=os.environ | environment,
        )  # fmt: skip

    def offsets_s(self) -> tuple[float, float]:
        """Return the offsets of its wall clock and its monotonic clock from this process's."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        wall_s, monotonic_s = map(float, self._process.stdout.readline().split())
        return wall_s - time.time(), monotonic_s - time.monotonic()

    def close(self) -> None:
        self._process.communicate()


def test_a_stepped_wall_clock_does_not_affect_a_run(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = WallClock(tmp_path)
    witness = Witness(clock.environment)
    for name, value in clock.environment.items():
        monkeypatch.setenv(name, value)
    running = start(*AT_RATE, *settings(speed=4.0, horizon_s=12.0))
    for name in clock.environment:
        monkeypatch.delenv(name)
    wait_recording(running)
    for role in ROLE_MODULES:
        assert "stepped_clock" in Path(f"/proc/{running.child(role).pid}/maps").read_text()
    for hours in (1, -1, 0):
        clock.step_to(hours * HOUR_S)
        wall_s, monotonic_s = witness.offsets_s()
        assert wall_s == pytest.approx(hours * HOUR_S, abs=HOUR_S / 2)
        assert abs(monotonic_s) < HOUR_S / 2
        time.sleep(0.4)
    witness.close()
    finished = running.finish()
    assert finished.status == 0, finished.stderr
    summary = finished.summary
    assert summary["exit"]["reason"] == "horizon"
    assert summary["missing_samples"] == 0
    assert summary["unintended_losses"] == 0
    assert summary["replay"]["bit_exact"]
    assert summary["replay"]["complete"]
    assert summary["identity_residual_max"] < 1e-11
    record = load_record(finished.run_dir)
    assert len(record["plant_step"]) == 12 * RATE_HZ + 1
    for table in record.tables:
        now_ns = record[table]["now_ns"]
        assert (np.diff(now_ns) >= 0).all()
        assert now_ns.max(initial=0) < HOUR_S / 2 * 1e9
    for lateness in summary["lateness_us"].values():
        assert lateness["max"] < 1e6 * HOUR_S / 2
    assert running.left_behind() == []
