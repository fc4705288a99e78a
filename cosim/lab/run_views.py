"""What the page shows of a run: the verdict, and what distinguishes it from another one.

The views of live and recorded runs at the end are computed by the worker process.
"""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cosim.analysis.summary.summary_model import ExitPart
from cosim.interactive.draft import differences, leaf, value_text
from cosim.interactive.exploration import LIVE, RECORDED, Exploration, of_record
from cosim.interactive.scenario_guarantee import CERTIFIED, VOID, Guarantee
from cosim.lazy_modules import lazy_modules
from cosim.output.run_verdict import (
    BAD,
    DOUBTFUL,
    GOOD,
    NEUTRAL,
    VerdictLine,
    ending_line,
    remarks,
    state_text,
    transmission_line,
    verdict,
)
from cosim.record.record_source import concatenate_rows, rows_by_loop
from cosim.record.run_directory import SCENARIO_FILE
from cosim.record.run_record import RunRecord, load_run
from cosim.record.spool_conversion import merged, spool_segments
from noack.core.errors import ExitStatus
from noack.core.linear_systems import Vector
from noack.core.number_format import number, percent
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_SETTING,
    CONTROLLER_STEP,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)
from noack.runtime.life_cycle import HORIZON
from noack.runtime.spool import SPOOL
from noack.scenario.resolution import resolved_loops, run_tables, tables_of
from noack.scenario.scenario import phases_ns
from noack.scenario.scenario_file import MOST_RECORDED_BYTES, load

with lazy_modules():  # the worker alone needs them
    from cosim.api import runs
    from cosim.live import finalize
    from cosim.output.figures import run_figures

_READ = (SENSOR_MEASUREMENT, CONTROLLER_STEP, CONTROLLER_DELIVERY, CONTROLLER_SETTING, PLANT_STEP)
_MOST_SETTINGS, _LONGEST = 4, 28
_NEARLY = 1.001
_END = "‖x‖ at the end"
_NOT_COMPARED = ("name", "ports", "recovery", "realtime")
"""Tables and keys that do not change what the loop does."""


class Reference(NamedTuple):
    """A run that others are compared with."""

    name: str
    """What it is, in words."""
    run: Exploration


class Comparison(NamedTuple):
    """What distinguishes a run from a reference."""

    title: str
    settings: str
    """The settings that differ, with both values."""
    rows: tuple[tuple[str, str, str, str], ...]
    """Quantity, its value in the reference and in the run, and the difference in words."""


def compare(reference: Reference, run: Exploration) -> Comparison:
    """Compare a run with a reference."""
    last_s = [float(shown.t_s[-1]) for shown in (reference.run, run)]
    until_s = min(last_s)
    until = f", until {number(until_s, 3)} s" if max(last_s) > until_s * _NEARLY else ""
    before, after = (_measured(shown, until_s) for shown in (reference.run, run))
    rows = (
        *(_counts(name, before[name], after[name]) for name in ("transmissions", "lost")),
        *(_sizes(name, before[name], after[name]) for name in (_END, "largest ‖e_c‖")),
    )
    return Comparison(f"compared with {reference.name}{until}", _settings(reference.run, run), rows)


def _measured(run: Exploration, until_s: float) -> dict[str, float]:
    """Return the numbers of a run up to a time."""
    sent, drawn = run.event_s <= until_s, run.t_s <= until_s
    errors = run.e_c_norm[drawn & run.controller_knows & np.isfinite(run.e_c_norm)]
    return {
        "transmissions": int(sent.sum()),
        "lost": int((sent & ~run.delivered).sum()),
        _END: float(np.interp(until_s, run.t_s, run.x_norm)),
        "largest ‖e_c‖": float(errors.max(initial=0.0)) if len(errors) else math.nan,
    }


def _settings(other: Exploration, run: Exploration) -> str:
    """Return which settings differ; matrices by their names only."""
    before, after = (shown.scenario.model_dump(mode="json", exclude_none=True) for shown in (other, run))
    changed = []
    for key, _ in differences(before, after):
        old, new = (leaf(content, key) for content in (before, after))
        if key.partition(".")[0] in _NOT_COMPARED:
            continue
        is_long = any(len(_text(value)) > _LONGEST for value in (old, new))
        changed.append(key if is_long else f"{key} {_text(old)} → {_text(new)}")
    if not changed:
        return "The settings are the same."
    more = f" and {len(changed) - _MOST_SETTINGS} more" if len(changed) > _MOST_SETTINGS else ""
    return f"Settings that differ: {', '.join(changed[:_MOST_SETTINGS])}{more}."


def _text(value: object) -> str:
    return value_text(value) if isinstance(value, str | int | float | list | dict) else "–"


def _counts(name: str, before: float, after: float) -> tuple[str, str, str, str]:
    change = after - before
    words = f"{abs(change):g} {'more' if change > 0 else 'fewer'}" if change else "the same"
    return name, f"{before:g}", f"{after:g}", words


def _sizes(name: str, before: float, after: float) -> tuple[str, str, str, str]:
    texts = [number(value, 3) if math.isfinite(value) else "–" for value in (before, after)]
    words = "–"
    if texts[0] == texts[1]:
        words = "the same" if math.isfinite(before) else "–"
    elif math.isfinite(before) and math.isfinite(after) and before > 0:
        ratio = number(after / before, 3)
        words = "nearly the same" if ratio == "1" else f"{ratio} times as large"
    return name, texts[0], texts[1], words


def verdict_of(run: Exploration, guarantee: Guarantee | None) -> tuple[VerdictLine, ...]:
    """Return the verdict of an explored run, in the three lines that a live run ends with.

    Without ``guarantee`` the certificate is still being computed.
    """
    horizon_s, reached_s = run.scenario.horizon_s, float(run.t_s[-1])
    status, reason = ExitStatus.OK, HORIZON
    if run.diverged_at_s is not None:
        status, reason = ExitStatus.FAILED, f"diverged at {number(run.diverged_at_s, 4)} s"
    elif run.cut:
        status, reason = ExitStatus.INTERRUPTED, run.cut
    first, largest, last = run.x_norm[0], float(np.nanmax(run.x_norm)), float(run.x_norm[-1])
    state = state_text(float(first), largest, last, None) if run.diverged_at_s is None else ""
    events = len(run.event_s)
    return (
        ending_line(ExitPart(status=status, reason=reason), reached_s, horizon_s, state),
        _guarantee_line(run, guarantee),
        transmission_line(events, events - run.lost),
    )


def _guarantee_line(run: Exploration, guarantee: Guarantee | None) -> VerdictLine:
    if guarantee is None:
        return VerdictLine("guarantee: being computed", NEUTRAL)
    if guarantee.verdict != CERTIFIED:
        why = guarantee.reason if guarantee.verdict != VOID else f"{VOID}: {guarantee.reason}"
        return VerdictLine(f"guarantee not checkable: {why}", DOUBTFUL)
    with np.errstate(all="ignore"):
        used = [
            values / np.exp(np.interp(run.t_s, guarantee.t_s, np.log(bound)))
            for values, bound in (
                (np.where(run.controller_knows, run.e_c_norm, 0.0), guarantee.e_c),
                (run.x_norm, guarantee.x),
            )
        ]
    above = np.nanmax(np.stack([*used, np.zeros_like(run.t_s)]), axis=0) > 1
    if above.any():
        return VerdictLine(f"guarantee broken since {run.t_s[above][0]:.3f} s", BAD)
    share = percent(float(np.nanmax(np.append(used[0], 0.0))))
    return VerdictLine(f"guarantee kept: ‖e_c‖ was at most {share} of its bound", GOOD)


class RunView(NamedTuple):
    """What the page shows of a recorded loop."""

    run: Exploration
    verdict: tuple[VerdictLine, ...]
    remarks: tuple[str, ...]
    bounds: Guarantee | None
    """Its certified bounds; None without any."""
    loops: tuple[str, ...]
    """Names of the loops of the run."""


def live_view(run_dir: Path) -> Exploration | None:
    """Return what is recorded so far of a run's first loop; None if that is nothing yet."""
    scenario = load(run_dir / SCENARIO_FILE, most_bytes=MOST_RECORDED_BYTES)
    loop = resolved_loops(scenario)[0]
    types, own, tables = run_tables(scenario), tables_of(loop), dict[str, np.ndarray]()
    for table, dtype in own.items():
        rows = np.zeros(0, dtype)
        if table in _READ:
            batches = merged(spool_segments(run_dir / SPOOL, table, types[table]), types[table])
            recorded = concatenate_rows([*batches], types[table])
            rows = dict(rows_by_loop(table, recorded, phases_ns(scenario), [own])).get(0, rows)
        tables[table] = rows
    record = RunRecord(loop, tables, [], {})
    return of_record(record, LIVE) if len(record[CONTROLLER_STEP]) else None


def recorded_view(directory: Path, loop: str | None) -> RunView:
    """Return the view of a loop of a recorded run, by default of its first.

    Raises:
        NoackError: the run is still under way, or its record is damaged.
    """
    summary, run = finalize.reopen(directory).summary, load_run(directory)
    names = tuple(run.names)
    number = run.number_of(loop if loop in names else names[0])
    record = run.loops[number]
    loop_summary = summary.loops[number]
    shown = of_record(record, RECORDED, loop_summary.diverged_at_s)
    texts = tuple(remark.text for remark in remarks(summary.model_copy(update={"loops": [loop_summary]})))
    return RunView(shown, verdict(summary), texts, _bounds(record), names)


def _bounds(record: RunRecord) -> Guarantee | None:
    """Return the certified bounds of ‖e_c‖ and ‖x‖ of a recorded loop."""
    bounds: dict[str, tuple[Vector, Vector]] = {}
    for _, quantity, t_s, values, kind in run_figures.envelopes(record):
        if kind == "certified" and len(t_s):
            bounds.setdefault(quantity, (t_s, values))
    if "e_c" not in bounds:
        return None
    t_s, e_c = bounds["e_c"]
    unknown = np.full(len(t_s), np.nan)
    x = np.asarray(np.interp(t_s, *bounds["x"])) if "x" in bounds else unknown
    return Guarantee(CERTIFIED, "", (), (), t_s, unknown, e_c, x)


def replayed(directory: Path) -> str:
    """Replay a run, and say whether it is bit-exact."""
    result = runs.open_run(directory).replay()
    return (
        "replay: bit-exact, the same numbers again"
        if result.bit_exact
        else f"replay: differs: {result.first_difference}"
    )


def compared(directory: Path) -> str:
    """Compare a run with the ideal loop."""
    return f"ideal loop: {runs.open_run(directory).fidelity().verdict}"


def report_page(directory: Path) -> bytes:
    """Return the report of a run, which is written if missing."""
    return finalize.run_report(directory).read_bytes()
