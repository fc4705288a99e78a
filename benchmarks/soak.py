"""The soak test: a real run of several hours, observed from outside.

``python -m benchmarks.soak [hour] [day] [--minutes M] [--runs DIR]`` runs one hour at speed 1
(``soak_hour.toml``), then a day of simulated time at speed 48, as a user starts them, and samples
the processes every few seconds. Memory, descriptors and threads must stay flat, every claim must
hold.

The warm-up is ignored: the first fifth of a run, at most five minutes. The rest is divided into
twelve windows. Each window counts with its lower median, which ignores short allocations. The slope
is the median of the slopes between all pairs of windows (Theil and Sen), so that four of the twelve
windows may be outliers or missing. Memory may gain

* 1 MiB in total, or, in a run longer than an hour, per hour;
* a quarter of this if, in half an hour or more, at least nine in ten pairs of windows rise: a leak
  is steady, the memory of a cache or an allocator is not;
* 9.5 MiB in a run of less than half an hour, since the recorder's memory varies by 9 MiB. In the
  four minutes that a run of five minutes leaves, at 500 Hz, this is 83 bytes per step, so that a
  leak of one row per step is detected. A leak per event needs a longer run. With less than two
  minutes after the warm-up, memory is not checked.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import theilslopes

from benchmarks.programs import LAUNCHER, ObservedRun, Sample, observed_run
from benchmarks.report import ZERO, Goal, MeasurementError, Row, print_table
from cosim.output.figures import palette
from cosim.output.figures.figure_description import Axis, FigureDescription, Line, Panel, PanelRow, time_axis
from cosim.output.figures.figure_files import save_figure
from cosim.record.run_directory import RECORD
from cosim.record.run_record import load_record
from noack.core.errors import NoackError
from noack.protocol.record_tables import NETEM_RELEASE
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
_SCENARIO = Path(__file__).with_name("soak_hour.toml")
ROLES = (*LOOP_ROLES, RECORDER, LAUNCHER)
COUNTS = {"fds": "file descriptors", "sockets": "sockets", "threads": "threads"}
_LEAST_MINUTES = 0.2
_LEAST_SAMPLES, _LONGEST_PAUSE_S = 150, 5.0
"""Samples of a run, so that each window has several, and the longest time between two."""


class Trend(NamedTuple):
    """The growth of memory after the warm-up, from the slope, and what is allowed, KiB."""

    growth_kib: float
    allowed_kib: float
    slope_kib_per_h: float


def warm_up_s(length_s: float) -> float:
    """Return the length of the warm-up, which is not checked."""
    return min(WARM_UP_SHARE * length_s, LONGEST_WARM_UP_S)


def memory_trend(at_s: Sequence[float], kib: Sequence[float], length_s: float) -> Trend | None:
    """Check memory over a run; return None if it is too short for that.

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
    """Yield the rows of the run's end, from its summary.

    Args:
        summary: summary of the run.
        delivered_out_of_order: updates that left the network after a newer one.
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
    bursts = [part for part in loop["assumption_violations"] if part["cause"] == "dropouts"]
    yield Row("exit status", ending["status"], "", goal=ZERO, note=ending["reason"])
    yield Row("missing samples", loop["missing_samples"], "", goal=ZERO)
    yield Row("unintended losses", loop["unintended_losses"], "", goal=ZERO)
    yield Row("rejected datagrams", sum(rejected.values()), "", goal=ZERO, note=f"{rejected}")
    yield Row("rejected as stale, without those delivered out of order", stale - delivered_out_of_order, "",
              goal=ZERO)  # fmt: skip
    yield Row("loss bursts beyond the guarantee", len(bursts), "", goal=ZERO)
    yield Row("longest loss burst", loop["longest_loss_burst"], "")
    yield Row("replayed bit for bit and completely", bool(replay.get("bit_exact") and replay.get("complete")),
              "", goal=Goal("==", 1), note=f"{replay.get('inputs') or 0:,} inputs")  # fmt: skip
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


def memory_figure(run: ObservedRun) -> FigureDescription:
    """Describe each process's private memory minus its first value, in KiB, over the run."""
    rows = []
    for i, role in enumerate(ROLES):
        samples = run.in_loops(role)
        at_s, kib = np.array([(sample.at_s - run.began_s, sample.uss_kib) for sample in samples]).T
        line = Line(x=at_s, y=kib - kib[0], colour=palette.PROCESSES.get(role, palette.SERIES[i]))
        x = time_axis(at_s, numbers=i == len(ROLES) - 1, label="wall time [s]")
        title = "" if i else "private memory since the start"
        panel = Panel(title=title, items=[line], x=x, y=Axis(label=f"{role} [KiB]"))
        rows.append(PanelRow(panels=[panel], height_in=0.95))
    return FigureDescription(name="memory", rows=rows)


def soak(path: Path, settings: Sequence[str], runs: Path) -> list[Row]:
    """Soak a scenario; write ``soak.json`` and ``soak.png`` into its run directory.

    Args:
        path: the scenario file.
        settings: values to replace, as after ``--set``.
        runs: folder in which the run directory is made, in its own subfolder.
    """
    scenario = load(path, settings)
    length_s = scenario.horizon_s / scenario.speed
    runs.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="soak-", dir=runs))
    changes = [word for setting in settings for word in ("--set", setting)]
    pause_s = min(length_s / _LEAST_SAMPLES, _LONGEST_PAUSE_S)
    run = observed_run([str(path), "--report", *changes], folder, length_s, pause_s)
    rows = [*run_rows(run)]
    content = {
        "rows": [row.to_json() for row in rows],
        "samples": {role: [sample._asdict() for sample in run.in_loops(role)] for role in ROLES},
    }
    (run.run_dir / "soak.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    save_figure(memory_figure(run), run.run_dir / "soak.png")
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the soak; return 0 if everything was as it should be."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.soak",
        description="Run the loop for an hour at speed 1, then for a day of simulated time in half "
        "an hour, and watch it: memory, descriptors and threads must stay flat, every claim must "
        "hold.",
    )
    add = parser.add_argument
    add("kinds", nargs="*", metavar="KIND", choices=[[], *KINDS], help=f"of {', '.join(KINDS)}")
    add("--minutes", type=_minutes, metavar="M", help="a shorter one; of the first kind only")
    add("--runs", type=Path, default=Path("runs"), help="where runs are kept")
    add("--set", action="append", default=[], metavar="KEY=VALUE", help="replace a value")
    options = parser.parse_args(arguments)
    status = 0
    for kind in options.kinds or (KINDS if options.minutes is None else ["hour"]):
        settings = [*KINDS[kind], *options.set]
        try:
            if options.minutes is not None:
                settings.append(f"horizon_s={60 * options.minutes * load(_SCENARIO, settings).speed!r}")
            rows = soak(_SCENARIO, settings, options.runs)
        except (MeasurementError, NoackError, AssertionError) as error:  # of the tests' helpers
            print(f"soak: {error}", file=sys.stderr)
            return 2
        print_table(f"soak_{kind}", rows)
        status |= any(row.holds is False for row in rows)
    return status


def _minutes(text: str) -> float:
    minutes = float(text)
    if not _LEAST_MINUTES <= minutes <= 1e4:
        raise argparse.ArgumentTypeError(f"must be a number of at least {_LEAST_MINUTES}")
    return minutes


if __name__ == "__main__":
    sys.exit(main())
