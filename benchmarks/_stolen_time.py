"""Lateness in those seconds of a live run in which the hypervisor took no CPU time."""

import time
from datetime import datetime
from pathlib import Path

import numpy as np
import psutil
from numpy.typing import NDArray

from cosim.analysis.timing_statistics import lateness_us
from cosim.record.run_directory import ENVIRONMENT_FILE, SUMMARY_FILE, read_object
from cosim.record.run_record import load_run

NOTHING = 0.005
"""A smaller share of all cores is not counted as taken; the kernel counts in steps of 10 ms."""
AROUND_S = 2.0
"""Nothing may be taken in this time before a second, whose effects last, and after it: the start of
a run is recorded in whole seconds."""


class StolenTime:
    """The time taken by the hypervisor, sampled during a run at speed 1."""

    def __init__(self) -> None:
        self._samples: list[tuple[float, float]] = []

    def sample(self) -> None:
        """Read the kernel's counter."""
        taken_s = getattr(psutil.cpu_times(), "steal", 0.0) / (psutil.cpu_count() or 1)
        self._samples.append((time.time(), taken_s))

    def quiet_seconds(self, began_s: float, horizon_s: float) -> NDArray[np.int_]:
        """Return the seconds since ``began_s`` (wall time) in which nothing was taken."""
        seconds = np.arange(int(horizon_s))
        if not self._samples:
            return seconds[:0]
        wall_s, taken_s = np.array(self._samples).T
        edges_s = began_s + seconds[:, None] + [-AROUND_S, 1 + AROUND_S]
        before = np.maximum(wall_s.searchsorted(edges_s[:, 0], "right") - 1, 0)
        after = np.minimum(wall_s.searchsorted(edges_s[:, 1]), len(wall_s) - 1)
        passed_s = np.maximum(wall_s[after] - wall_s[before], 1e-9)
        return seconds[taken_s[after] - taken_s[before] < NOTHING * passed_s]


def began_s(run_dir: Path) -> float:
    """Return the wall time at which a run's loops began, to about a second."""
    started = read_object(run_dir / ENVIRONMENT_FILE)["started"]
    startup_s: float = read_object(run_dir / SUMMARY_FILE)["startup_s"]
    return datetime.fromisoformat(started).timestamp() + startup_s


def worst_p99_us(run_dir: Path, role: str, seconds: NDArray[np.int64]) -> float:
    """Return the lateness p99 of a process in these seconds of the run: that of the worst loop.

    It is NaN if there are no such seconds.
    """
    found = []
    for record in load_run(run_dir).loops:
        table = {"plant": "plant_step", "controller": "controller_step"}[role]
        second = record.columns(table, "t_ns")["t_ns"] // 10**9
        late_us = lateness_us(record, role)[np.isin(second, seconds)]
        found.append(np.percentile(late_us, 99) if len(late_us) else np.nan)
    return float(np.max(found))
