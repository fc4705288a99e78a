"""Carries out a soak: a run as a user starts it, sampled every few seconds; and its result."""

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from rich.console import Console

from benchmarks._report import MeasurementError
from benchmarks._runs import FREE_PORTS, PLAIN_TERMINAL, PROGRESS
from benchmarks.soak.flat import SHORT_S, Trend, constant, trend, warm_up_s
from benchmarks.soak.watch import LAUNCHER, Processes, Sample, size_bytes
from cosim.output import palette
from cosim.output.figure_description import (
    Axis,
    FigureDescription,
    Line,
    Panel,
    Row,
    Spans,
    time_axis,
)
from cosim.output.figure_files import save_figure
from cosim.output.result_tables import ResultTable, terminal_table
from cosim.record.run_directory import LATEST, RECORD, SCENARIO_FILE, SUMMARY_FILE
from cosim.record.run_record import load_record
from noack.config.scenario import Scenario
from noack.config.scenario_file import load
from noack.protocol.record_tables import NETEM_RELEASE
from noack.protocol.topology import LOOP_ROLES, RECORDER
from noack.runtime.spool import SPOOL

RESULT_FILE, PICTURE_FILE = "soak.json", "soak.png"
ROLES = (*LOOP_ROLES, RECORDER, LAUNCHER)
COUNTS = ("fds", "sockets", "threads")
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
_KEPT = (
    "exit", "events", "deliveries", "drops", "longest_loss_burst", "missing_samples",
    "unintended_losses", "replay", "lateness_us", "reached_s", "horizon_s", "speed",
)  # fmt: skip
"""Keys of the summary that the result has."""
Say = Callable[[str], None]


@dataclass(frozen=True)
class Watched:
    """The samples of a process over a run.

    Args:
        at_s: times of the samples, in wall time since the run's start.
        samples: the samples.
        length_s: length of the run in wall time.
    """

    at_s: Sequence[float]
    samples: Sequence[Sample]
    length_s: float

    @property
    def memory(self) -> Trend:
        """The trend of its private memory."""
        return trend(self.at_s, [sample.uss_kib for sample in self.samples], self.length_s)

    def ends(self, count: str) -> tuple[int, int]:
        """Return minimum and maximum of ``fds``, ``sockets`` or ``threads`` after the warm-up."""
        counts = [getattr(sample, count) for sample in self.samples]
        return constant(self.at_s, counts, self.length_s)

    @property
    def cpu_share(self) -> float:
        """CPU time per wall time."""
        elapsed_s = self.at_s[-1] - self.at_s[0]
        used_s = self.samples[-1].cpu_s - self.samples[0].cpu_s
        return used_s / elapsed_s if elapsed_s > 0 else 0.0

    def faults(self, role: str) -> Iterator[str]:
        """Yield descriptions of all trends that are not flat."""
        memory = self.memory
        if memory.verdict == "unknown":
            yield f"{role}: memory was sampled too rarely to judge it"
        elif memory.verdict not in ("flat", "too short"):
            yield (
                f"{role}: memory {memory.verdict}: {memory.growth_kib:.0f} KiB after the warm-up "
                f"({memory.slope_kib_per_h:.0f} KiB/h); {memory.allowed_kib:.0f} KiB are allowed"
            )
        # On an overloaded machine, control-plane sessions reconnect, which adds threads.
        for count in COUNTS if self.length_s >= SHORT_S else COUNTS[:2]:
            least, most = self.ends(count)
            if least != most:
                yield f"{role}: {count} vary from {least} to {most} after the warm-up"

    def as_json(self) -> dict[str, Any]:
        """Return everything, for ``--json``."""
        samples = zip(self.at_s, self.samples, strict=True)
        return {
            "memory": self.memory._asdict(),
            **{count: list(self.ends(count)) for count in COUNTS},
            "cpu_share": self.cpu_share,
            "samples": [{"at_s": round(at, 3), **sample._asdict()} for at, sample in samples],
        }


@dataclass(frozen=True)
class Result:
    """The result of a soak."""

    name: str
    run_dir: Path
    wall_s: float
    """Wall time of the loop, until its horizon."""
    end_s: float
    """Wall time from then until the launcher ended."""
    end_peak_kib: Mapping[str, float]
    """Peak resident memory of launcher and recorder during that time."""
    disk_bytes: int
    """Size of the run directory at the end of the loop."""
    watched: Mapping[str, Watched]
    summary: dict[str, Any]
    faults: Sequence[str]
    """Descriptions of all faults."""

    @property
    def loop(self) -> Mapping[str, Any]:
        """The summary of the loop; empty without a summary."""
        loops: Sequence[Mapping[str, Any]] = self.summary.get("loops", ())
        return loops[0] if loops else {}

    def as_json(self) -> dict[str, Any]:
        """Return everything, for ``--json``."""
        own = {key: value for key, value in vars(self).items() if key != "watched"}
        return own | {
            "run_dir": str(self.run_dir),
            "processes": {role: watched.as_json() for role, watched in self.watched.items()},
            "summary": {key: (self.summary | self.loop).get(key) for key in _KEPT},
        }


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
        self._run, self._run_dir, self._processes, self._log = run, run_dir, processes, log
        self._say = say
        self._scenario: Scenario = load(run_dir / SCENARIO_FILE)
        self._length_s = self._scenario.horizon_s / self._scenario.speed
        self._looks: dict[str, list[tuple[float, Sample]]] = {}
        self._faults: list[str] = []

    def watch(self) -> Result:
        """Sample the run until it has ended, and judge it."""
        began_s, disk_bytes = self._loop()
        reached_s = time.monotonic()
        peaks = self._end(_END_PATIENCE * self._length_s + 600.0)
        ended_s = time.monotonic()
        summary = self._judge_end()
        # The samples between the run's first and last second.
        length_s = min(self._length_s, reached_s - began_s) - _LAST_S
        watched = {}
        for role in ROLES:
            looks = [(at_s - began_s, sample) for at_s, sample in self._looks.get(role, ())]
            looks = [look for look in looks if 0 <= look[0] <= length_s]
            if looks:
                watched[role] = Watched(*zip(*looks, strict=True), length_s)
                self._faults += watched[role].faults(role)
            else:
                self._faults.append(f"{role}: was never seen")
        result = Result(
            self._scenario.name, self._run_dir, reached_s - began_s, ended_s - reached_s, peaks,
            disk_bytes, watched, summary, self._faults,
        )  # fmt: skip
        text = json.dumps(result.as_json(), indent=2, default=float)
        (self._run_dir / RESULT_FILE).write_text(text + "\n", encoding="utf-8")
        if watched:
            save_figure(memory_figure(result), self._run_dir / PICTURE_FILE)
        return result

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
            for line in self._log:
                if (found := PROGRESS.match(line)) is not None:
                    reached_s, moved_s = float(found[1]), now_s
                    began_s = min(began_s, now_s - reached_s / self._scenario.speed)
            if reached_s and now_s >= look_s:
                for role, sample in self._processes.sample().items():
                    self._looks.setdefault(role, []).append((now_s, sample))
                disk_bytes = size_bytes(self._run_dir)
                look_s = max(look_s + pause_s, now_s)
            if now_s - moved_s > _STUCK_S:
                self._faults.append(f"no progress for {_STUCK_S:g} s; the run was ended")
                self._run.terminate()
                break
            share = reached_s / self._scenario.horizon_s
            if int(10 * share) > tenths or now_s - reported_s > _SAY_S:
                tenths, reported_s = int(10 * share), now_s
                latest = {role: looks[-1][1].uss_kib / 1024 for role, looks in self._looks.items()}
                memory = ", ".join(f"{role} {mib:.1f}" for role, mib in latest.items())
                horizon = f"{100 * share:.0f} % of {self._scenario.horizon_s:g} s"
                self._say(f"{horizon}; private memory in MiB: {memory}")
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
    faults, loop = [], summary["loops"][0]
    if status or summary["exit"]["status"]:
        faults.append(f"exit status {status}: {summary['exit']['reason']}")
    stale = {"controller": {"stale": delivered_out_of_order}} if delivered_out_of_order else {}
    right = {"missing_samples": 0, "unintended_losses": 0, "rejected_datagrams": stale}
    faults += [f"{key}: {loop[key]}" for key, value in right.items() if loop[key] != value]
    bursts = [one for one in loop["assumption_violations"] if one["cause"] == "dropouts"]
    if bursts:
        faults.append(f"assumption_violations: {bursts}")
    replay = loop["replay"] or {}
    if not (replay.get("bit_exact") and replay.get("complete")):
        faults.append(f"the replay: {replay}")
    faults += [
        f"claim violated since {claim['since_s']} s: {claim['what']} ({claim['source']})"
        for claim in loop["claims"]
        if claim["verdict"] == "violated"
    ]
    if not loop["claims"]:
        faults.append("no claim was judged")
    return faults


def memory_figure(result: Result) -> FigureDescription:
    """Describe private memory minus its value at the end of the warm-up, in KiB, over the run."""
    rows = []
    for i, (role, watched) in enumerate(result.watched.items()):
        at_s = np.array(watched.at_s)
        kib = np.array([sample.uss_kib for sample in watched.samples])
        warm_s = warm_up_s(watched.length_s)
        began = min(int(np.searchsorted(at_s, warm_s)), len(kib) - 1)
        kib -= kib[began]
        low, high = min(float(kib[began:].min()), -128.0), max(float(kib[began:].max()), 1024.0)
        margin = 0.05 * (high - low)
        title = f"{result.name}: private memory since the warm-up (grey); 1 MiB is allowed"
        colour = palette.PROCESSES.get(role, palette.SERIES[5 if role == RECORDER else 4])
        panel = Panel(
            title="" if i else title,
            items=[
                Spans(begin=np.zeros(1), end=np.array([warm_s]), colour=(128, 128, 128),
                      opacity=0.14),
                Line(x=at_s, y=kib, colour=colour),
            ],
            x=time_axis(at_s, numbers=i == len(result.watched) - 1, label="wall time [s]"),
            y=Axis(label=f"{role} [KiB]", ends=(low - margin, high + margin)),
        )  # fmt: skip
        rows.append(Row(panels=[panel], height_in=0.95))
    return FigureDescription(name="memory", rows=rows)


def print_result(console: Console, result: Result) -> None:
    """Print table and verdict."""
    rows = []
    for role, watched in result.watched.items():
        memory = watched.memory
        ends = (watched.ends(count) for count in COUNTS)
        kib = (memory.at_10_kib, memory.at_50_kib, memory.at_100_kib)
        rows.append((
            role, *(f"{one / 1024:.1f} MiB" for one in kib), f"{memory.growth_kib:+.0f} KiB",
            f"{memory.slope_kib_per_h:+.0f} KiB",
            *(str(most) if least == most else f"{least}–{most}" for least, most in ends),
            f"{100 * watched.cpu_share:.0f} %", memory.verdict,
        ))  # fmt: skip
    headings = ("process", "10 %", "50 %", "100 %", "growth", "per hour", *COUNTS, "CPU", "verdict")
    table = ResultTable("soak", f"{result.name}: private memory", headings, rows)
    styles = {"flat": "green", "": "bold red"}
    console.print(terminal_table(table, left=(0, len(headings) - 1), styles=styles))
    replay = result.loop.get("replay") or {}
    late = ", ".join(
        f"{role} {figures['p50']:.0f}/{figures['p99']:.0f}/{figures['max']:.0f}"
        for role, figures in (result.loop.get("lateness_us") or {}).items()
        if figures.get("max") is not None
    )
    peaks = ", ".join(f"{role} {kib / 1024:,.0f}" for role, kib in result.end_peak_kib.items())
    lines = [
        f"longest loss burst: {result.loop.get('longest_loss_burst')}",
        f"replayed at the end: {replay.get('inputs') or 0:,} inputs, bit exact: "
        f"{replay.get('bit_exact')}",
        f"lateness, p50/p99/max in µs (reported, not judged): {late or 'unknown'}",
        f"wall time: {result.wall_s:.0f} s of loop, {result.end_s:.0f} s for its end "
        f"(at most, in MiB: {peaks or 'unknown'}); {result.disk_bytes / 2**20:.0f} MiB on the disk",
        f"run directory: {result.run_dir}, with {PICTURE_FILE}",
        *(f"FAULT: {fault}" for fault in result.faults),
    ]
    for line in lines:
        style = "red" if line.startswith("FAULT") else None
        console.print(line, highlight=False, markup=False, soft_wrap=True, style=style)
    if not result.faults:
        console.print(f"{result.name}: all flat, nothing broken", style="green", highlight=False)
