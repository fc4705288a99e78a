"""The soak: a real run of several hours, as a user starts it, observed from outside.

The processes are sampled every few seconds. Memory, descriptors and threads must stay flat, every
claim must hold. docs/benchmarks.md says what is checked, and how.
"""

import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import theilslopes

from benchmarks.observed_runs import LAUNCHER, ObservedRun, Sample, observed_run
from benchmarks.programs import set_options
from benchmarks.report import ZERO, Goal, MeasurementError, Row, benchmark
from cosim.record.run_directory import RECORD
from cosim.record.run_record import load_record
from netem.core.file_access import create_folder, write_whole
from netem.core.packet_rows import NETEM_RELEASE
from noack.protocol.roles import LOOP_ROLES, RECORDER
from noack.runtime.spool import SPOOL
from noack.scenario.scenario_file import load

WARM_UP_SHARE, LONGEST_WARM_UP_S = 0.2, 300.0
WINDOWS, LEAST_WINDOWS = 12, 8
"""Windows of a run, and those of them that must have samples."""
ALLOWED_KIB, STEADY_KIB, SHORT_KIB = 1024.0, 256.0, 9728.0
"""Allowed growth per hour, and at least in total: in general, if it is steady, in a short run."""
SHORT_S, LEAST_S = 1800.0, 120.0
"""Length of a short run; time after the warm-up without which memory is not checked."""
STEADY_SHARE = 0.9
"""Share of the pairs of windows that rise if the growth is steady."""
KINDS: Mapping[str, Sequence[str]] = {
    "hour": (),
    # 20 Hz at speed 48 are 960 steps per second. Some updates are delayed, so that they are in flight
    # for a while, and some are delivered out of order.
    "day": (
        'name="soak_day"',
        "horizon_s=86400.0",
        "speed=48.0",
        "plant.rate_hz=20.0",
        "controller.rate_hz=20.0",
        'network.impairments=[{ kind = "delay", delay_s = 0.02, jitter_s = 0.02 }]',
    ),
}
"""The runs, with the settings in which they differ from the scenario."""
_SCENARIO = Path(__file__).parents[1] / "soak_hour.toml"
ROLES = (*LOOP_ROLES, RECORDER, LAUNCHER)
COUNTS = {"fds": "file descriptors", "sockets": "sockets", "threads": "threads"}
_LEAST_SAMPLES, _LONGEST_PAUSE_S = 150, 5.0
"""Samples of a run, so that each window has several, and the longest time between two."""


class Trend(NamedTuple):
    """The growth of memory after the warm-up, from the slope, and what is allowed."""

    growth_kib: float
    allowed_kib: float
    slope_kib_per_h: float


def warm_up_s(length_s: float) -> float:
    """Return the length of the warm-up, which is not checked."""
    return min(WARM_UP_SHARE * length_s, LONGEST_WARM_UP_S)


def memory_trend(at_s: Sequence[float], kib: Sequence[float], length_s: float) -> Trend | None:
    """Check memory over a run; return None if it is too short for that.

    The slope is that of Theil and Sen between the lower medians of windows, which ignore short
    allocations.

    Args:
        at_s: times of the samples since the run's start, ascending, (k,).
        kib: the samples, (k,).
        length_s: length of the run.

    Raises:
        MeasurementError: there are too few samples.
    """
    begin_s = warm_up_s(length_s)
    checked_s = length_s - begin_s
    if checked_s < LEAST_S:
        return None
    samples = np.array([at_s, kib], dtype=np.float64).T
    samples = samples[(samples[:, 0] >= begin_s) & (samples[:, 0] <= length_s)]
    windows = ((samples[:, 0] - begin_s) / checked_s * WINDOWS).astype(int).clip(max=WINDOWS - 1)
    medians = [
        np.quantile(samples[windows == window], 0.5, axis=0, method="lower") for window in np.unique(windows)
    ]
    if len(medians) < LEAST_WINDOWS:
        raise MeasurementError("memory was sampled too rarely to check it")
    times_s, sizes_kib = np.transpose(medians)
    slope = float(theilslopes(sizes_kib, times_s).slope)
    rising = np.mean([later > earlier for earlier, later in combinations(sizes_kib, 2)])
    hours = max(checked_s / 3600, 1.0)
    if length_s < SHORT_S:
        allowed_kib = SHORT_KIB
    else:
        allowed_kib = hours * (STEADY_KIB if rising >= STEADY_SHARE else ALLOWED_KIB)
    return Trend(slope * checked_s, allowed_kib, 3600 * slope)


def lasting_range(at_s: Sequence[float], counts: Sequence[int], length_s: float) -> tuple[int, int]:
    """Return minimum and maximum of a count after the warm-up, ignoring single outliers."""
    after_warm_up = [
        count for at, count in zip(at_s, counts, strict=True) if warm_up_s(length_s) <= at <= length_s
    ]
    repeated = [a for a, b in pairwise(after_warm_up) if a == b] or after_warm_up
    return (min(repeated), max(repeated)) if repeated else (0, 0)


def process_rows(role: str, samples: Sequence[Sample], began_s: float, length_s: float) -> Iterator[Row]:
    """Yield the rows of a process, from its samples while the loops ran."""
    if not samples:
        raise MeasurementError(f"{role}: was never seen")
    at_s = [sample.at_s - began_s for sample in samples]
    memory = memory_trend(at_s, [sample.uss_kib for sample in samples], length_s)
    name, size = f"{role}: private memory gained", f"{samples[-1].uss_kib / 1024:.1f} MiB"
    if memory is None:
        yield Row(name, None, "KiB", note=f"{size}; not checked: too short")
    else:
        note = f"{size}; {memory.slope_kib_per_h:+.0f} KiB per hour"
        yield Row(name, memory.growth_kib, "KiB", goal=Goal("<=", memory.allowed_kib), note=note)
    for count, meaning in COUNTS.items():
        low, high = lasting_range(at_s, [getattr(sample, count) for sample in samples], length_s)
        # On an overloaded machine, control-plane sessions reconnect, which adds threads.
        goal = None if count == "threads" and length_s < SHORT_S else ZERO
        yield Row(f"{role}: variation of {meaning}", high - low, "", goal=goal, note=f"{low} to {high}")


def end_rows(summary: Mapping[str, Any], delivered_out_of_order: int) -> Iterator[Row]:
    """Yield the rows of the run's end.

    ``delivered_out_of_order`` is the number of updates that left the network after a newer one.
    """
    (loop,) = summary["loops"]
    ending, replay, claims = summary["exit"], loop["replay"] or {}, loop["claims"]
    rejected = {
        (role, reason): number
        for role, reasons in loop["rejected_datagrams"].items()
        for reason, number in reasons.items()
    }
    stale = rejected.pop(("controller", "stale"), 0)
    violated = [f"{claim['what']} ({claim['source']})" for claim in claims if claim["verdict"] == "violated"]
    bursts = [part for part in loop["violations"] if part["cause"] == "dropouts"]
    yield Row("exit status", ending["status"], "", goal=ZERO, note=ending["reason"])
    yield Row("missing samples", loop["missing_samples"], "", goal=ZERO)
    yield Row("unintended losses", loop["unintended_losses"], "", goal=ZERO)
    yield Row("rejected datagrams", sum(rejected.values()), "", goal=ZERO, note=f"{rejected}")
    name = "rejected as stale, without those delivered out of order"
    yield Row(name, stale - delivered_out_of_order, "", goal=ZERO)
    yield Row("loss bursts beyond the guarantee", len(bursts), "", goal=ZERO)
    yield Row("longest loss burst", loop["longest_loss_burst"], "")
    exact, note = replay.get("bit_exact") and replay.get("complete"), f"{replay.get('inputs') or 0:,} inputs"
    yield Row("replayed bit for bit and completely", bool(exact), "", goal=Goal("==", 1), note=note)
    yield Row("claims checked", len(claims), "", goal=Goal(">=", 1))
    yield Row("claims violated", len(violated), "", goal=ZERO, note="; ".join(violated))


def run_rows(run: ObservedRun) -> Iterator[Row]:
    """Yield the rows of a finished run."""
    length_s = run.horizon_s - run.began_s - 2
    for role in ROLES:
        yield from process_rows(role, run.in_loops(role), run.began_s, length_s)
    stale = int(load_record(run.run_dir)[NETEM_RELEASE]["stale"].sum())
    yield from end_rows(run.summary, stale)
    for role, late in run.summary["loops"][0]["lateness_us"].items():
        if late["max"] is not None:
            yield Row(f"{role}: lateness, p99", late["p99"], "µs", note=f"at most {late['max']:.0f} µs")
    for role in (LAUNCHER, RECORDER):
        at_end = [sample.rss_kib / 1024 for sample in run.samples[role] if sample.at_s > run.ended_s]
        yield Row(f"{role}: memory at the end, at most", max(at_end, default=None), "MiB")
    yield Row("wall time of the end", run.closed_s - run.ended_s, "s")
    unfinished = not (run.run_dir / RECORD).is_dir() or (run.run_dir / SPOOL).exists()
    yield Row("unfinished records", unfinished, "", goal=ZERO)
    yield Row("processes left behind", len(run.left_behind), "", goal=ZERO, note=", ".join(run.left_behind))


def soaked(settings: Sequence[str], runs: Path) -> list[Row]:
    """Run the soak's scenario with changed settings; write ``soak.json`` into its run directory."""
    scenario = load(_SCENARIO, settings)
    length_s = scenario.horizon_s / scenario.speed
    create_folder(runs)
    folder = Path(tempfile.mkdtemp(prefix="soak-", dir=runs))
    pause_s = min(length_s / _LEAST_SAMPLES, _LONGEST_PAUSE_S)
    run = observed_run([str(_SCENARIO), "--report", *set_options(*settings)], folder, length_s, pause_s)
    rows = [*run_rows(run)]
    content = {
        "rows": [row.to_json() for row in rows],
        "samples": {role: [sample._asdict() for sample in run.in_loops(role)] for role in ROLES},
    }
    write_whole(run.run_dir / "soak.json", json.dumps(content, indent=2) + "\n")
    return rows


@benchmark("soak", "An hour at speed 1, then a day of simulated time at speed 48")
def soak(kind: str = "", minutes: float = 0.0, runs: str = "runs") -> Iterator[Row]:
    """Soak the loop; fail if a row does not hold.

    Args:
        kind: only this one of :data:`KINDS`.
        minutes: length of a shorter soak, of the first kind by default.
        runs: folder in which the run directories are made, in subfolders of their own.
    """
    if kind not in ("", *KINDS):
        raise MeasurementError(f"no kind {kind}: {', '.join(KINDS)}")
    faults = 0
    for name in (kind,) if kind else ("hour",) if minutes else KINDS:
        settings = [*KINDS[name]]
        if minutes:
            settings.append(f"horizon_s={60 * minutes * load(_SCENARIO, settings).speed!r}")
        rows = soaked(settings, Path(runs))
        yield from (replace(row, name=f"{name}: {row.name}") for row in rows)
        faults += sum(row.holds is False for row in rows)
    if faults:
        raise MeasurementError(f"{faults} rows do not hold")
