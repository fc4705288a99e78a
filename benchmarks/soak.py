"""The soak test: a real run of several hours, observed from outside.

``python -m benchmarks.soak [hour] [day] [--minutes M] [--json FILE] [--runs DIR]`` runs one hour at
speed 1 (``soak_hour.toml``), then a day of simulated time at speed 48 (``soak_day.toml``), as a
user starts them, and samples the processes every few seconds. Memory, descriptors and threads must
stay flat, every claim must hold.

The warm-up is ignored: the first fifth of a run, at most five minutes. The rest is divided into
twelve windows. Each window counts with its lower median, which ignores short allocations. The slope
is the median of the slopes between all pairs of windows (Theil and Sen), so that four of the twelve
windows may be outliers or missing. Memory

* **grows** if this slope gives a gain of more than 1 MiB, or, in a run longer than an hour, of more
  than 1 MiB per hour;
* **creeps** if, in half an hour or more, at least nine in ten pairs of windows rise and the total
  gain is at least 256 KiB: a leak is steady, the memory of a cache or an allocator is not;
* is **flat** otherwise.

A run of less than half an hour may gain 9.5 MiB, since the recorder's memory varies by 9 MiB. In
the four minutes that a run of five minutes leaves, at 500 Hz, this is 83 bytes per step, so that a
leak of one row per step is detected. A leak per event needs a longer run. With less than two
minutes after the warm-up, there is no verdict.
"""

import argparse
import contextlib
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple, TextIO

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from benchmarks.programs import FREE_PORTS, LAUNCHER, NOACK, PLAIN_TERMINAL, PROGRESS, Processes, Sample
from benchmarks.report import MeasurementError, say
from cosim.output.figures import palette
from cosim.output.figures.figure_description import (
    Axis,
    FigureDescription,
    Line,
    Panel,
    Row,
    Spans,
    time_axis,
)
from cosim.output.figures.figure_files import save_figure
from cosim.output.result_tables import ResultTable, terminal_table
from cosim.record.run_directory import LATEST, RECORD, SCENARIO_FILE, SUMMARY_FILE
from cosim.record.run_record import load_record
from noack.core.errors import NoackError
from noack.protocol.record_tables import NETEM_RELEASE
from noack.protocol.topology import LOOP_ROLES, RECORDER
from noack.runtime.spool import SPOOL
from noack.scenario.scenario_file import load

WARM_UP_SHARE, LONGEST_WARM_UP_S = 0.2, 300.0
WINDOWS, LEAST_WINDOWS = 12, 8
ALLOWED_KIB = 1024.0
"""Allowed total growth, and allowed growth per hour in runs longer than an hour."""
SHORT_S, SHORT_ALLOWED_KIB, LEAST_S = 1800.0, 9728.0, 120.0
STEADY_KIB, STEADY_SHARE, STEADY_FROM_S = 256.0, 0.9, 1800.0

Values = NDArray[np.float64]
Word = Literal["flat", "grows", "creeps", "unknown", "too short"]


class Trend(NamedTuple):
    """The trend of memory over a run."""

    at_10_kib: float
    at_50_kib: float
    at_100_kib: float
    """Memory at this percentage of the run."""
    slope_kib_per_h: float
    """NaN if there are too few samples."""
    growth_kib: float
    """Growth since the end of the warm-up, from the slope."""
    allowed_kib: float
    rising: float
    """Share of the pairs of windows that rise."""
    verdict: Word


def warm_up_s(length_s: float) -> float:
    """Return the length of the warm-up, which is not judged."""
    return min(WARM_UP_SHARE * length_s, LONGEST_WARM_UP_S)


def trend(at_s: Sequence[float], kib: Sequence[float], length_s: float) -> Trend:
    """Judge memory over a run.

    Args:
        at_s: times of the samples since the run's start, ascending, (k,).
        kib: the samples, (k,).
        length_s: length of the run.
    """
    samples = np.array([at_s, kib], dtype=np.float64).T
    begin_s = warm_up_s(length_s)
    judged_s = length_s - begin_s
    hours = max(judged_s / 3600, 1.0)
    allowed_kib = SHORT_ALLOWED_KIB if length_s < SHORT_S else ALLOWED_KIB * hours
    judged = samples[(samples[:, 0] >= begin_s) & (samples[:, 0] <= length_s)]
    windows = np.minimum((judged[:, 0] - begin_s) / judged_s * WINDOWS, WINDOWS - 1).astype(int)
    medians = [_low_median(judged[windows == window]) for window in np.unique(windows)]
    at_10, at_50, at_100 = (
        float(samples[np.abs(samples[:, 0] - share * length_s).argmin(), 1]) if len(samples) else math.nan
        for share in (0.1, 0.5, 1.0)
    )
    if judged_s < LEAST_S or len(medians) < LEAST_WINDOWS:
        verdict: Word = "too short" if judged_s < LEAST_S else "unknown"
        return Trend(at_10, at_50, at_100, math.nan, math.nan, allowed_kib, math.nan, verdict)
    apart = np.array([after - before for before, after in combinations(medians, 2)])
    slope = float(_low_median(apart[:, 1] / apart[:, 0]))
    rising, growth_kib = float((apart[:, 1] > 0).mean()), slope * judged_s
    steady = (
        rising >= STEADY_SHARE
        and growth_kib > STEADY_KIB * hours
        and judged_s >= STEADY_FROM_S * (1 - WARM_UP_SHARE)
    )
    verdict = "grows" if growth_kib > allowed_kib else "creeps" if steady else "flat"
    return Trend(at_10, at_50, at_100, 3600 * slope, growth_kib, allowed_kib, rising, verdict)


def _low_median(values: Values) -> Values:
    return np.quantile(values, 0.5, axis=0, method="lower")


def constant(at_s: Sequence[float], counts: Sequence[int], length_s: float) -> tuple[int, int]:
    """Return minimum and maximum of a count after the warm-up, ignoring single outliers."""
    judged = [count for at, count in zip(at_s, counts, strict=True) if warm_up_s(length_s) <= at <= length_s]
    lasting = [a for a, b in pairwise(judged) if a == b] or judged
    return (min(lasting), max(lasting)) if lasting else (0, 0)


FOLDER = Path(__file__).parent
KINDS = ("hour", "day")
RESULT_FILE, PICTURE_FILE = "soak.json", "soak.png"
ROLES = (*LOOP_ROLES, RECORDER, LAUNCHER)
COUNTS = ("fds", "sockets", "threads")
_LEAST_MINUTES = 0.2
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


@dataclass(frozen=True)
class Watched:
    """The samples of a process over a run, with their wall times since the run's start."""

    at_s: Sequence[float]
    samples: Sequence[Sample]
    length_s: float
    """Length of the run in wall time."""

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

    def as_json(self) -> dict[str, object]:
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
    def loop(self) -> dict[str, Any]:
        """The summary of the loop; empty without a summary."""
        return dict(next(iter(self.summary.get("loops", ())), {}))

    def as_json(self) -> dict[str, object]:
        """Return everything, for ``--json``."""
        own = {key: value for key, value in vars(self).items() if key != "watched"}
        return own | {
            "run_dir": str(self.run_dir),
            "processes": {role: watched.as_json() for role, watched in self.watched.items()},
            "summary": {key: (self.summary | self.loop).get(key) for key in _KEPT},
        }


def soak(path: Path, settings: Sequence[str], runs: Path) -> Result:
    """Soak a scenario.

    Args:
        path: the scenario file.
        settings: values to replace, as after ``--set``.
        runs: folder in which the run directory is made, in its own subfolder.
    """
    runs.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="soak-", dir=runs))
    changes = [word for setting in settings for word in ("--set", setting)]
    command = [*NOACK, "run", str(path.resolve()), "--json", "--runs", str(folder)]
    log = folder / "stderr.log"
    with (
        (folder / "stdout.json").open("w") as stdout,
        log.open("w") as stderr,
        subprocess.Popen(
            [*command, *FREE_PORTS, *changes],
            stdin=subprocess.DEVNULL,
            stdout=stdout,
            stderr=stderr,
            env=os.environ | PLAIN_TERMINAL,
        ) as run,
    ):
        processes = Processes(run.pid)
        try:
            deadline_s, latest = time.monotonic() + _START_PATIENCE_S, folder / LATEST
            while not (latest.exists() and (latest / SPOOL).is_dir()):
                if time.monotonic() > deadline_s or run.poll() is not None:
                    lines = log.read_text(errors="replace").strip().splitlines() or ["no message"]
                    raise MeasurementError(f"the run never began: {lines[-1]}")
                time.sleep(0.05)
            with log.open() as lines_of_run:
                return _Soak(run, latest.resolve(), processes, lines_of_run).watch()
        finally:
            if run.poll() is None:
                processes.kill()


class _Soak:
    def __init__(
        self, run: "subprocess.Popen[bytes]", run_dir: Path, processes: Processes, log: TextIO
    ) -> None:
        self._run, self._run_dir, self._processes, self._log = run, run_dir, processes, log
        self._scenario = load(run_dir / SCENARIO_FILE)
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
                watched[role] = Watched([at_s for at_s, _ in looks], [look for _, look in looks], length_s)
                self._faults += watched[role].faults(role)
            else:
                self._faults.append(f"{role}: was never seen")
        result = Result(
            self._scenario.name,
            self._run_dir,
            reached_s - began_s,
            ended_s - reached_s,
            peaks,
            disk_bytes,
            watched,
            summary,
            self._faults,
        )
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
                if (match := PROGRESS.match(line)) is not None:
                    reached_s, moved_s = float(match[1]), now_s
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
                say(f"{horizon}; private memory in MiB: {memory}")
            time.sleep(min(_POLL_S, pause_s))
        return min(began_s, time.monotonic()), disk_bytes

    def _end(self, patience_s: float) -> Mapping[str, float]:
        """Wait until the launcher ends; return the peak memory meanwhile, by process."""
        deadline_s = time.monotonic() + patience_s
        say("the loop is at its horizon; the run is replayed and judged")
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


def size_bytes(folder: Path) -> int:
    """Return a folder's size on the disk; files and folders may vanish meanwhile."""
    total = 0
    for inner, _, names in os.walk(folder):  # os.walk skips folders that it cannot read
        for name in names:
            with contextlib.suppress(OSError):
                total += (Path(inner) / name).stat().st_blocks * 512
    return total


def ended_badly(summary: Mapping[str, Any], status: int, delivered_out_of_order: int = 0) -> Iterator[str]:
    """Yield descriptions of the faults in a run's summary.

    Args:
        summary: summary of the run.
        status: exit status of ``noack run``.
        delivered_out_of_order: updates that left the network after a newer one.
    """
    loop = summary["loops"][0]
    if status or summary["exit"]["status"]:
        yield f"exit status {status}: {summary['exit']['reason']}"
    stale = {"controller": {"stale": delivered_out_of_order}} if delivered_out_of_order else {}
    right = {"missing_samples": 0, "unintended_losses": 0, "rejected_datagrams": stale}
    yield from (f"{key}: {loop[key]}" for key, value in right.items() if loop[key] != value)
    if bursts := [part for part in loop["assumption_violations"] if part["cause"] == "dropouts"]:
        yield f"assumption_violations: {bursts}"
    replay = loop["replay"] or {}
    if not (replay.get("bit_exact") and replay.get("complete")):
        yield f"the replay: {replay}"
    for claim in loop["claims"]:
        if claim["verdict"] == "violated":
            yield f"claim violated since {claim['since_s']} s: {claim['what']} ({claim['source']})"
    if not loop["claims"]:
        yield "no claim was judged"


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
        warm = Spans(begin=np.zeros(1), end=np.array([warm_s]), colour=(128, 128, 128), opacity=0.14)
        panel = Panel(
            title="" if i else title,
            items=[warm, Line(x=at_s, y=kib, colour=colour)],
            x=time_axis(at_s, numbers=i == len(result.watched) - 1, label="wall time [s]"),
            y=Axis(label=f"{role} [KiB]", ends=(low - margin, high + margin)),
        )
        rows.append(Row(panels=[panel], height_in=0.95))
    return FigureDescription(name="memory", rows=rows)


def print_result(console: Console, result: Result) -> None:
    """Print table and verdict."""
    rows = []
    for role, watched in result.watched.items():
        memory = watched.memory
        ends = (watched.ends(count) for count in COUNTS)
        kib = (memory.at_10_kib, memory.at_50_kib, memory.at_100_kib)
        rows.append(
            (
                role,
                *(f"{size_kib / 1024:.1f} MiB" for size_kib in kib),
                f"{memory.growth_kib:+.0f} KiB",
                f"{memory.slope_kib_per_h:+.0f} KiB",
                *(str(most) if least == most else f"{least}–{most}" for least, most in ends),
                f"{100 * watched.cpu_share:.0f} %",
                memory.verdict,
            )
        )
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
    for line in (
        f"longest loss burst: {result.loop.get('longest_loss_burst')}",
        f"replayed at the end: {replay.get('inputs') or 0:,} inputs, bit exact: {replay.get('bit_exact')}",
        f"lateness, p50/p99/max in µs (reported, not judged): {late or 'unknown'}",
        f"wall time: {result.wall_s:.0f} s of loop, {result.end_s:.0f} s for its end "
        f"(at most, in MiB: {peaks or 'unknown'}); {result.disk_bytes / 2**20:.0f} MiB on the disk",
        f"run directory: {result.run_dir}, with {PICTURE_FILE}",
        *(f"FAULT: {fault}" for fault in result.faults),
    ):
        style = "red" if line.startswith("FAULT") else None
        console.print(line, highlight=False, markup=False, soft_wrap=True, style=style)
    if not result.faults:
        console.print(f"{result.name}: all flat, nothing broken", style="green", highlight=False)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the soak; return 0 if all memory was flat and no claim was violated."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.soak",
        description="Run the loop for an hour at speed 1, then for a day of simulated time in half "
        "an hour, and watch it: memory, descriptors and threads must stay flat, every claim must "
        "hold.",
    )
    add = parser.add_argument
    add("kinds", nargs="*", metavar="KIND", choices=[[], *KINDS], help=f"of {', '.join(KINDS)}")
    add("--minutes", type=_minutes, metavar="M", help="a shorter one; of the first kind only")
    add("--json", type=Path, metavar="FILE", help="write all figures to FILE")
    add("--runs", type=Path, default=Path("runs"), help="where runs are kept")
    add("--set", action="append", default=[], metavar="KEY=VALUE", help="replace a value")
    options = parser.parse_args(arguments)
    console = Console()
    if not console.is_terminal:
        console.width = 130
    results, status = [], 0
    for kind in options.kinds or (KINDS if options.minutes is None else KINDS[:1]):
        path = FOLDER / f"soak_{kind}.toml"
        settings = list(options.set)
        try:
            if options.minutes is not None:
                speed = load(path, settings).speed
                settings.append(f"horizon_s={60 * options.minutes * speed!r}")
            result = soak(path, settings, options.runs)
        except (MeasurementError, NoackError) as error:
            print(f"soak: {error}", file=sys.stderr)
            return 2
        print_result(console, result)
        results.append(result.as_json())
        status |= bool(result.faults)
    if options.json is not None:
        options.json.write_text(json.dumps(results, indent=2, default=float) + "\n")
    return status


def _minutes(text: str) -> float:
    minutes = float(text)
    if not _LEAST_MINUTES <= minutes <= 1e4:
        raise argparse.ArgumentTypeError(f"must be a number of at least {_LEAST_MINUTES}")
    return minutes


if __name__ == "__main__":
    sys.exit(main())
