"""Carries out a soak: a run as a user starts it, sampled every few seconds."""

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TextIO

from benchmarks._report import MeasurementError
from benchmarks._runs import PLAIN_TERMINAL, PROGRESS
from benchmarks.soak.figure import memory_figure
from benchmarks.soak.result import Result, Watched
from benchmarks.soak.watch import LAUNCHER, Processes, Sample, size_bytes
from cosim.output.figure_files import save_figure
from cosim.record.run_directory import LATEST, RECORD, SCENARIO_FILE, SUMMARY_FILE
from cosim.record.run_record import load_record
from noack.config.scenario import Scenario
from noack.config.scenario_file import load
from noack.protocol.record_tables import NETEM_RELEASE
from noack.protocol.topology import LOOP_ROLES, RECORDER
from noack.runtime.spool import SPOOL

RESULT_FILE, PICTURE_FILE = "soak.json", "soak.png"
FREE_PORTS = ("--set", "ports={}")
_POLL_S = 0.25
_START_PATIENCE_S = 120.0
_LEAST_LOOKS = 150
"""Minimum number of samples, so that each window has several."""
_LONGEST_PAUSE_S = 5.0
_LAST_S = 1.0
"""Time before the horizon that is ignored, since processes start to end."""
_SAY_S = 300.0
_STUCK_S = 120.0
"""A run without a new row for this wall time is stuck; far longer than a poll on a busy machine."""
_END_PATIENCE = 4.0
"""The end may take this multiple of the loop's time, plus ten minutes."""
_EXIT_PATIENCE_S = 10.0

Say = Callable[[str], None]


def soak(path: Path, settings: tuple[str, ...], runs: Path, say: Say) -> Result:
    """Soak a scenario.

    Args:
        path: the scenario file.
        settings: values to replace, as after ``--set``.
        runs: folder in which the run directory is made, in its own subfolder.
        say: called with the progress at intervals.

    Raises:
        MeasurementError: the run never started.
    """
    runs.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="soak-", dir=runs))
    command = [sys.executable, "-m", "cosim.cli", "run", str(path.resolve()), "--json"]
    command += ["--runs", str(folder), *FREE_PORTS]
    for setting in settings:
        command += ["--set", setting]
    with (
        (folder / "stdout.json").open("w") as stdout,
        (folder / "stderr.log").open("w") as stderr,
        subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=stdout, stderr=stderr,
            env=os.environ | PLAIN_TERMINAL,
        ) as run,
    ):  # fmt: skip
        processes = Processes(run.pid)
        try:
            run_dir = _started(run, folder)
            with (folder / "stderr.log").open() as log:
                return _Soak(run, run_dir, processes, log, say).watch()
        finally:
            if run.poll() is None:
                processes.kill()


def _started(run: "subprocess.Popen[bytes]", folder: Path) -> Path:
    deadline_s = time.monotonic() + _START_PATIENCE_S
    latest = folder / LATEST
    while time.monotonic() < deadline_s and run.poll() is None:
        if latest.exists() and (latest / SPOOL).is_dir():
            return latest.resolve()
        time.sleep(0.05)
    lines = (folder / "stderr.log").read_text(errors="replace").strip().splitlines()
    raise MeasurementError(f"the run never began: {lines[-1] if lines else 'no message'}")


class _Soak:
    def __init__(
        self, run: "subprocess.Popen[bytes]", run_dir: Path, processes: Processes, log: TextIO,
        say: Say,
    ) -> None:  # fmt: skip
        self._run = run
        self._run_dir = run_dir
        self._processes = processes
        self._log = log
        self._say = say
        self._scenario: Scenario = load(run_dir / SCENARIO_FILE)
        self._length_s = self._scenario.horizon_s / self._scenario.speed
        self._looks: dict[str, list[tuple[float, Sample]]] = {}
        self._faults: list[str] = []

    def watch(self) -> Result:
        began_s, disk_bytes = self._loop()
        end_began_s = time.monotonic()
        peaks = self._end(_END_PATIENCE * self._length_s + 600.0)
        ended_s = time.monotonic()
        summary = self._judge_end()
        watched = self._watched(began_s, min(self._length_s, end_began_s - began_s) - _LAST_S)
        for role in (*LOOP_ROLES, RECORDER, LAUNCHER):
            if role not in watched:
                self._faults.append(f"{role}: was never seen")
            else:
                self._faults += watched[role].faults(role)
        result = Result(
            self._scenario.name, self._run_dir, end_began_s - began_s, ended_s - end_began_s, peaks,
            disk_bytes, watched, summary, self._faults,
        )  # fmt: skip
        (self._run_dir / RESULT_FILE).write_text(result.dumps(), encoding="utf-8")
        if watched:
            save_figure(memory_figure(result), self._run_dir / PICTURE_FILE)
        return result

    def _watched(self, began_s: float, length_s: float) -> dict[str, Watched]:
        """Return the samples between the run's first and last second."""
        found = {}
        for role in (*LOOP_ROLES, RECORDER, LAUNCHER):
            looks = [
                (at_s - began_s, sample)
                for at_s, sample in self._looks.get(role, ())
                if 0 <= at_s - began_s <= length_s
            ]
            if looks:
                at_s, samples = zip(*looks, strict=True)
                found[role] = Watched(at_s, samples, length_s)
        return found

    def _loop(self) -> tuple[float, int]:
        """Sample the run until its horizon.

        Returns:
            The time of t = 0 on our clock (the minimum over all progress lines, since each is read
            after it was printed), and the final size of the run directory.
        """
        pause_s = min(self._length_s / _LEAST_LOOKS, _LONGEST_PAUSE_S)
        look_s = reported_s = moved_s = time.monotonic()
        began_s, tenths, reached_s, disk_bytes = math.inf, 0, 0.0, 0
        while self._run.poll() is None and (now_s := time.monotonic()) < began_s + self._length_s:
            for t_s in self._progress_lines():
                reached_s, moved_s = t_s, now_s
                began_s = min(began_s, now_s - t_s / self._scenario.speed)
            if reached_s and now_s >= look_s:
                self._look(now_s)
                disk_bytes = size_bytes(self._run_dir)
                look_s = max(look_s + pause_s, now_s)
            if now_s - moved_s > _STUCK_S:
                self._faults.append(f"no progress for {_STUCK_S:g} s; the run was ended")
                self._run.terminate()
                break
            share = reached_s / self._scenario.horizon_s
            if int(10 * share) > tenths or now_s - reported_s > _SAY_S:
                tenths, reported_s = int(10 * share), now_s
                self._say(self._progress(share))
            time.sleep(min(_POLL_S, pause_s))
        return min(began_s, time.monotonic()), disk_bytes

    def _end(self, patience_s: float) -> Mapping[str, float]:
        """Wait until the launcher ends; return the peak memory meanwhile, by process."""
        deadline_s = time.monotonic() + patience_s
        self._say("the loop is at its horizon; the run is replayed and judged")
        peaks: dict[str, float] = {}
        while self._run.poll() is None:
            for role, sample in self._processes.sample().items():
                if role in (LAUNCHER, RECORDER):
                    peaks[role] = max(peaks.get(role, 0.0), sample.rss_kib)
            if time.monotonic() > deadline_s:
                self._faults.append(f"the end of the run took more than {patience_s:.0f} s")
                self._processes.kill()
            time.sleep(_POLL_S)
        return peaks

    def _look(self, at_s: float) -> None:
        for role, sample in self._processes.sample().items():
            self._looks.setdefault(role, []).append((at_s, sample))

    def _progress_lines(self) -> Iterator[float]:
        """Yield the times in the run of the new progress lines."""
        for line in self._log:
            if (found := PROGRESS.match(line)) is not None:
                yield float(found[1])

    def _progress(self, share: float) -> str:
        memory = ", ".join(
            f"{role} {looks[-1][1].uss_kib / 1024:.1f}" for role, looks in self._looks.items()
        )
        return (
            f"{100 * share:.0f} % of {self._scenario.horizon_s:g} s; "
            f"private memory in MiB: {memory}"
        )

    def _judge_end(self) -> dict[str, Any]:
        """Check the run's summary, and that no process is left."""
        faults = self._faults
        if alive := self._processes.left_behind(_EXIT_PATIENCE_S):
            faults.append(f"left behind: {', '.join(alive)}")
            self._processes.kill()
        if not (self._run_dir / RECORD).is_dir() or (self._run_dir / SPOOL).exists():
            faults.append("the record was not finished")
        status = self._run.wait()
        try:
            summary: dict[str, Any] = json.loads((self._run_dir / SUMMARY_FILE).read_text())
        except (OSError, ValueError) as error:
            faults.append(f"no summary: {error}; exit status {status}")
            return {}
        stale = int(load_record(self._run_dir)[NETEM_RELEASE]["stale"].sum())
        faults += ended_badly(summary, status, stale)
        return summary


def ended_badly(
    summary: Mapping[str, Any], status: int, delivered_out_of_order: int = 0
) -> list[str]:
    """Return descriptions of the faults in a run's summary.

    Args:
        summary: summary of the run.
        status: exit status of ``noack run``.
        delivered_out_of_order: updates that left the network after a newer one.
    """
    faults = []
    if status or summary["exit"]["status"]:
        faults.append(f"exit status {status}: {summary['exit']['reason']}")
    for key, right in (
        ("missing_samples", 0),
        ("unintended_losses", 0),
        (
            "rejected_datagrams",
            {"controller": {"stale": delivered_out_of_order}} if delivered_out_of_order else {},
        ),
    ):
        if (value := summary["loops"][0][key]) != right:
            faults.append(f"{key}: {value}")
    bursts = [
        one for one in summary["loops"][0]["assumption_violations"] if one["cause"] == "dropouts"
    ]
    if bursts:
        faults.append(f"assumption_violations: {bursts}")
    replay = summary["loops"][0]["replay"] or {}
    if not (replay.get("bit_exact") and replay.get("complete")):
        faults.append(f"the replay: {replay}")
    faults += [
        f"claim violated since {claim['since_s']} s: {claim['what']} ({claim['source']})"
        for claim in summary["loops"][0]["claims"]
        if claim["verdict"] == "violated"
    ]
    if not summary["loops"][0]["claims"]:
        faults.append("no claim was judged")
    return faults
