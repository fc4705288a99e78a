"""The result of a soak: figures, verdicts, a table."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.soak.flat import SHORT_S, Trend, constant, trend
from benchmarks.soak.watch import Sample


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

    def range_of(self, count: str) -> tuple[int, int]:
        """Return minimum and maximum of ``fds``, ``sockets`` or ``threads`` after the warm-up."""
        counts = [getattr(sample, count) for sample in self.samples]
        return constant(self.at_s, counts, self.length_s)

    @property
    def cpu_share(self) -> float:
        """CPU time per wall time."""
        elapsed_s = self.at_s[-1] - self.at_s[0]
        used_s = self.samples[-1].cpu_s - self.samples[0].cpu_s
        return used_s / elapsed_s if elapsed_s > 0 else 0.0

    def faults(self, role: str) -> list[str]:
        """Return descriptions of all trends that are not flat."""
        memory = self.memory
        found = []
        if memory.verdict == "unknown":
            found.append(f"{role}: memory was looked at too rarely to judge it")
        elif memory.verdict not in ("flat", "too short"):
            found.append(
                f"{role}: memory {memory.verdict}: {memory.growth_kib:.0f} KiB after the warm-up "
                f"({memory.slope_kib_per_h:.0f} KiB/h); {memory.allowed_kib:.0f} KiB are allowed"
            )
        for count in ("fds", "sockets", "threads"):
            least, most = self.range_of(count)
            # On an overloaded machine, control-plane sessions reconnect, which adds threads.
            judged = count != "threads" or self.length_s >= SHORT_S
            if judged and least != most:
                found.append(f"{role}: {count} vary from {least} to {most} after the warm-up")
        return found

    @property
    def loop(self) -> Mapping[str, Any]:
        """The summary of the loop; empty without a summary."""
        found: Mapping[str, Any] = next(iter(self.summary.get("loops", ())), {})
        return found

    def as_json(self) -> dict[str, Any]:
        """Return everything, for ``--json``."""
        counts = {count: list(self.range_of(count)) for count in ("fds", "sockets", "threads")}
        return {
            "memory": self.memory._asdict(),
            **counts,
            "cpu_share": self.cpu_share,
            "samples": [
                {"at_s": round(at, 3), **sample._asdict()}
                for at, sample in zip(self.at_s, self.samples, strict=True)
            ],
        }


@dataclass(frozen=True)
class Result:
    """The result of a soak."""

    name: str
    run_dir: Path | None
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
    faults: Sequence[str] = field(default_factory=list)
    """Descriptions of all faults."""

    @property
    def loop(self) -> Mapping[str, Any]:
        """The summary of the loop; empty without a summary."""
        found: Mapping[str, Any] = next(iter(self.summary.get("loops", ())), {})
        return found

    def as_json(self) -> dict[str, Any]:
        """Return everything, for ``--json``."""
        kept = (
            "exit", "events", "deliveries", "drops", "longest_loss_burst", "missing_samples",
            "unintended_losses", "replay", "lateness_us", "reached_s", "horizon_s", "speed",
        )  # fmt: skip
        return {
            "name": self.name,
            "run_dir": None if self.run_dir is None else str(self.run_dir),
            "wall_s": self.wall_s,
            "end_s": self.end_s,
            "end_peak_kib": dict(self.end_peak_kib),
            "disk_bytes": self.disk_bytes,
            "processes": {role: watched.as_json() for role, watched in self.watched.items()},
            "summary": {key: (self.summary | self.loop).get(key) for key in kept},
            "faults": list(self.faults),
        }

    def dumps(self) -> str:
        """Return the result as JSON."""
        return json.dumps(self.as_json(), indent=2, default=float) + "\n"


def print_result(console: Console, result: Result) -> None:
    """Print tables and verdict."""
    table = Table(title=f"{result.name}: private memory", title_justify="left")
    for heading in ("process", "10 %", "50 %", "100 %", "growth", "per hour", "verdict",
                    "fds", "sockets", "threads", "CPU"):  # fmt: skip
        table.add_column(heading, justify="left" if heading in ("process", "verdict") else "right")
    for role, watched in result.watched.items():
        memory = watched.memory
        flat = memory.verdict == "flat"
        table.add_row(
            role,
            *(_mib(kib) for kib in (memory.at_10_kib, memory.at_50_kib, memory.at_100_kib)),
            f"{memory.growth_kib:+.0f} KiB",
            f"{memory.slope_kib_per_h:+.0f} KiB",
            f"[{'green' if flat else 'bold red'}]{memory.verdict}[/]",
            *(_range(*watched.range_of(count)) for count in ("fds", "sockets", "threads")),
            f"{100 * watched.cpu_share:.0f} %",
        )
    console.print(table)
    for line in _lines(result):
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    for fault in result.faults:
        console.print(f"FAULT: {fault}", highlight=False, markup=False, soft_wrap=True, style="red")
    if not result.faults:
        console.print(f"{result.name}: all flat, nothing broken", style="green", highlight=False)


def _lines(result: Result) -> list[str]:
    replay = result.loop.get("replay") or {}
    lateness = result.loop.get("lateness_us") or {}
    late = ", ".join(
        f"{role} {figures['p50']:.0f}/{figures['p99']:.0f}/{figures['max']:.0f}"
        for role, figures in lateness.items()
        if figures.get("max") is not None
    )
    peaks = ", ".join(f"{role} {kib / 1024:,.0f}" for role, kib in result.end_peak_kib.items())
    return [
        f"longest loss burst: {result.loop.get('longest_loss_burst')}",
        f"replayed at the end: {replay.get('inputs') or 0:,} inputs, bit exact: "
        f"{replay.get('bit_exact')}",
        f"lateness, p50/p99/max in µs (reported, not judged): {late or 'unknown'}",
        f"wall time: {result.wall_s:.0f} s of loop, {result.end_s:.0f} s for its end "
        f"(at most, in MiB: {peaks or 'unknown'}); {result.disk_bytes / 2**20:.0f} MiB on the disk",
        f"run directory: {result.run_dir}",
    ]


def _mib(kib: float) -> str:
    return f"{kib / 1024:.1f} MiB"


def _range(least: int, most: int) -> str:
    return str(most) if least == most else f"{least}–{most}"
