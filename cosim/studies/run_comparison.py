"""A comparison of runs: key numbers, settings that differ, distances, and one overlaid figure."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from cosim.analysis.summary.summary_model import IdealLoopPart, LoopSummary, RunSummary
from cosim.live.finalize import reopen
from cosim.output.figures import palette
from cosim.output.figures.axes_parts import (
    draw_line,
    draw_marks,
    label_text,
    limit_decades,
    name_ticks,
    series_colour,
    set_times,
)
from cosim.output.figures.page_figure import PageFigure
from cosim.output.figures.panels import Panels
from cosim.output.run_tables import caps_text
from cosim.record.align import Reals, Times, align_tables
from cosim.record.run_directory import chosen_run, require_output
from cosim.record.run_record import RunRecord, load_record
from netem.core.clock import NS_PER_S
from netem.core.errors import CallerError, shortened
from netem.core.number_format import as_text
from netem.core.row_operations import row_norms
from netem.output.document import Block, Document, Sentence
from netem.output.result_tables import ResultTable
from noack.protocol.record_tables import CONTROLLER_DELIVERY, NO_SEQUENCE, PLANT_STEP, SENSOR_MEASUREMENT

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LABELS = "ABCDEFG"
"""Names of the runs; there is one colour for each."""
_LONGEST_VALUE = 40
_NAMES_ONLY = ("name", "description", "ports.", "realtime.")
"""Settings that do not affect the results of a run."""


class ComparedRun(NamedTuple):
    """A run of the comparison."""

    label: str
    directory: Path
    summary: RunSummary
    """Of one loop."""
    record: RunRecord

    @property
    def title(self) -> str:
        """The scenario and its kind of run, as text."""
        mode = "model-based" if self.loop.mode == "model" else "zero-order hold"
        summary = self.summary
        return f"{summary.scenario}, {mode}, {summary.kind}, {caps_text(summary)}"

    @property
    def loop(self) -> LoopSummary:
        """The summary of the loop."""
        return self.summary.loops[0]


class KeyNumber(NamedTuple):
    """A key number, with its value in each run."""

    name: str
    values: tuple[float | None, ...]
    """One value per run, in order; None if a run has no value."""

    @property
    def differences(self) -> tuple[float | None, ...]:
        """Each value minus the first run's; None if one of them is missing."""
        first = self.values[0]
        return tuple(None if first is None or value is None else value - first for value in self.values)

    @property
    def cells(self) -> list[str]:
        """The values as text, each with its difference to the first run's."""
        return [
            "-" if value is None else f"{value:.4g}" + (f" ({difference:+.3g})" if difference else "")
            for value, difference in zip(self.values, self.differences, strict=True)
        ]


@dataclass(frozen=True)
class RunComparison:
    """A comparison of runs with the same number of states.

    Args:
        runs: two or more; differences are relative to the first.
    """

    runs: tuple[ComparedRun, ...]

    @cached_property
    def numbers(self) -> list[KeyNumber]:
        """The key numbers that at least one of the runs has."""
        values = {name: tuple(value(run.loop) for run in self.runs) for name, value in _NUMBERS.items()}
        pairs = [_distance(self.runs[0].record, run.record) for run in self.runs]
        values["distance in x to A, RMS"], values["distance in x to A, maximum"] = zip(*pairs, strict=True)
        return [KeyNumber(*entry) for entry in values.items() if any(v is not None for v in entry[1])]

    @cached_property
    def settings(self) -> dict[str, tuple[str, ...]]:
        """The settings that differ, by key, with the value in every run."""
        flat = [dict(_flat(run.record.scenario.model_dump(mode="json"))) for run in self.runs]
        keys = dict.fromkeys(key for settings in flat for key in settings)
        by_key = {key: tuple(settings.get(key, "-") for settings in flat) for key in keys}
        return {
            key: tuple(shortened(value, _LONGEST_VALUE) for value in values)
            for key, values in by_key.items()
            if len(set(values)) > 1 and not key.startswith(_NAMES_ONLY)
        }

    @property
    def default_file(self) -> Path:
        """Where the page is written unless another file is named: beside the first run."""
        return Path(os.path.relpath(self.runs[0].directory.resolve().parent)) / "comparison.html"

    def plot(self) -> "Figure":
        """Draw states, ‖e_s‖ with thresholds, ‖e_c‖ and transmissions of all runs overlaid."""
        return overlay_figure(self.runs).draw()

    def save(self, path: str | PathLike[str], width: str | float | None = None) -> None:
        """Write the overlay as a page (``.html``), or the figure alone (``.svg``, ``.pdf``, …).

        Args:
            path: of the file.
            width: of a figure: ``column``, ``page`` or inches, see ``docs/papers.md``.

        Raises:
            CallerError: the name has another ending, or there is no such width.
            MachineError: the file cannot be written.
        """
        from cosim.output.figures.figure_files import FIGURE_SUFFIXES, save_figure  # they import matplotlib
        from cosim.output.page_kit import save_page

        path = Path(path)
        require_output(path)
        if path.suffix in FIGURE_SUFFIXES:
            save_figure(overlay_figure(self.runs), path, width)
            return
        if path.suffix != ".html":
            suffixes = ", ".join(FIGURE_SUFFIXES)
            raise CallerError(f"{path}: a comparison is written as .html, {suffixes}")
        if width is not None:
            raise CallerError(f"{path}: a page has its own width; --width is that of a figure")
        save_page(self.document, path)

    @property
    def document(self) -> Document:
        """Runs, their key numbers, the settings that differ, and the figure."""
        labels = [run.label for run in self.runs]
        blocks: list[Block] = [
            *(Sentence(lead=run.label, text=f" {run.title}  {run.directory}") for run in self.runs),
            overlay_figure(self.runs),
            ResultTable("numbers", "key numbers (in brackets: difference to A)", ("", *labels), self.rows),
        ]
        if self.settings:
            blocks.append(ResultTable("settings", "settings that differ", ("", *labels), self.setting_rows))
        return Document(title=f"{len(self.runs)} runs compared", data=self.to_json(), blocks=blocks)

    def to_json(self) -> dict[str, object]:
        """Return the comparison without the figure, for programs."""
        return {
            "runs": [
                {"label": run.label, "directory": str(run.directory), "title": run.title} for run in self.runs
            ],
            "numbers": {key.name: list(key.values) for key in self.numbers},
            "differences": {key.name: list(key.differences) for key in self.numbers},
            "settings": {key: list(values) for key, values in self.settings.items()},
        }

    @property
    def rows(self) -> list[tuple[str, ...]]:
        """Return the key numbers as a table of text: name, then a cell per run."""
        return [(key.name, *key.cells) for key in self.numbers]

    @property
    def setting_rows(self) -> list[tuple[str, ...]]:
        """Return the settings that differ as a table of text: key, then a cell per run."""
        return [(key, *values) for key, values in self.settings.items()]

    def __repr__(self) -> str:
        legend = "\n".join(f"{run.label}  {run.title}  {run.directory}" for run in self.runs)
        return f"{legend}\n{as_text([('', *(run.label for run in self.runs)), *self.rows])}"


def compare_runs(directories: Sequence[Path]) -> RunComparison:
    """Open runs and compare them.

    Args:
        directories: two to seven run directories, live or simulated; ``RUN:NAME`` is a loop.

    Raises:
        CallerError: there are fewer than two or more than seven, one is not a run directory, or the
            plants have different numbers of states.
    """
    if not 2 <= len(directories) <= len(LABELS):
        raise CallerError(f"give 2 to {len(LABELS)} run directories to compare, not {len(directories)}")
    runs = tuple(map(_open_run, LABELS, directories))
    first = runs[0].record.loop.n
    for run in runs[1:]:
        if run.record.loop.n != first:
            raise CallerError(
                f"{run.directory}: its plant has {run.record.loop.n} states, that of "
                f"{runs[0].directory} has {first}; runs with equally many states can be compared"
            )
    return RunComparison(runs)


def _open_run(label: str, named_path: Path) -> ComparedRun:
    """Open a run of one loop, or a loop of a run: ``RUN:NAME``."""
    folder, _, name = named_path.name.partition(":")
    loop = name if folder and name and not named_path.exists() else None
    path = named_path if loop is None else named_path.with_name(folder)
    path = chosen_run(path, path.parent)
    outcome, record = reopen(path), load_record(path, loop)
    shown_path = path if loop is None else named_path
    return ComparedRun(label, shown_path, outcome.summary.of_loop(record.scenario.name), record)


def _claims(verdict: str) -> Callable[[LoopSummary], int]:
    return lambda loop: sum(claim.verdict == verdict for claim in loop.claims)


def _count_late_steps(loop: LoopSummary) -> int | None:
    late = loop.lateness_us
    return sum(role.late_steps for role in late.values()) if late else None


def _ideal(loop: LoopSummary) -> int | None:
    return loop.ideal_loop.events if isinstance(loop.ideal_loop, IdealLoopPart) else None


_NUMBERS: dict[str, Callable[[LoopSummary], float | None]] = {
    "simulated time, s": lambda s: s.reached_s,
    "transmissions": lambda s: s.events,
    "ideal loop: transmissions": _ideal,
    "deliveries": lambda s: s.deliveries,
    "forced by the guarantee": lambda s: s.forced_deliveries,
    "lost in the network": lambda s: s.drops,
    "loss rate, %": lambda s: 100 * s.drops / max(s.drops + s.deliveries, 1),
    "longest loss burst": lambda s: s.longest_loss_burst,
    "shortest inter-event time, s": lambda s: s.inter_event_min_s,
    "median inter-event time, s": lambda s: s.inter_event_median_s,
    "median time between deliveries, s": lambda s: s.inter_delivery_median_s,
    "‖x‖ at the end": lambda s: s.final_state_norm,
    "largest ‖e_s‖": lambda s: s.sup_e_s_norm,
    "largest ‖e_c‖": lambda s: s.sup_e_c_norm,
    "latency p50, µs": lambda s: None if s.latency_us is None else s.latency_us.p50,
    "latency p99, µs": lambda s: None if s.latency_us is None else s.latency_us.p99,
    "deadlines missed": _count_late_steps,
    "claims held": _claims("held"),
    "claims violated": _claims("violated"),
    "claims ended": _claims("ended"),
    "claims unchecked": _claims("unchecked"),
}


@np.errstate(all="ignore")  # a run may diverge
def _distance(first: RunRecord, second: RunRecord) -> tuple[float | None, float | None]:
    """RMS and maximum of ‖x − x'‖ over the common times of two records; None if not finite."""
    a, b = first[PLANT_STEP], second[PLANT_STEP]
    a_ns: Times = a["t_ns"]
    b_ns: Times = b["t_ns"]
    _, at_a, at_b = np.intersect1d(a_ns, b_ns, return_indices=True)
    if first is second or not len(at_a):
        return None, None
    difference: Reals = b["x"][at_b] - a["x"][at_a]
    distances = row_norms(difference)
    if not np.isfinite(distances).all():
        return None, None
    return float(np.sqrt(np.mean(distances**2))), float(distances.max())


def _flat(settings: Mapping[str, object], prefix: str = "") -> Iterator[tuple[str, str]]:
    for key, value in settings.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", str(value)


_MOST_STATES = 6
_STATE_IN, _NORM_IN, _EVENTS_IN = 1.25, 1.8, 0.35
_DECADES = 5
_WIDEST_LINE, _WIDTH_RATIO, _NORM_LINE = 3.4, 0.75, 1.2
"""Widths of lines: of the first run's states, the ratio from run to run, and of norms."""


def overlay_figure(runs: Sequence[ComparedRun]) -> PageFigure:
    """Return states, ‖e_s‖ with thresholds, ‖e_c‖ and transmissions, one colour per run.

    Args:
        runs: runs with the same number of states; the first 6 states are drawn.
    """
    return PageFigure(
        name="runs",
        draw_panels=lambda figure: _draw_overlay(figure, runs),
        caption="One colour per run. Dashed: threshold. Bar: transmission delivered; cross: "
        "transmission lost.",
        description="States, error norms and transmissions of the runs over time, overlaid.",
    )


def _draw_overlay(figure: "Figure", runs: Sequence[ComparedRun]) -> list[Panels]:
    with np.errstate(all="ignore"):  # a run may diverge
        aligned = [align_tables(run.record) for run in runs]
    times = [np.asarray(samples.t_ns / NS_PER_S, dtype=np.float64) for samples in aligned]
    longest = max(times, key=lambda t_s: t_s.max(initial=0.0))
    rows = []
    for i, name in enumerate(runs[0].record.loop.state_names[:_MOST_STATES]):
        axes = figure.add_axes((0, 0, 1, 1))
        for k, (run, t_s, samples) in enumerate(zip(runs, times, aligned, strict=True)):
            # Each run's line is thinner than the line below it.
            width = max(_WIDEST_LINE * _WIDTH_RATIO**k, 0.8)
            label = "" if i else f"{run.label}: {label_text(run.title, 60)}"
            draw_line(axes, t_s, samples.x[:, i], series_colour(k), label=label, linewidth=width)
        axes.set(ylabel=label_text(name), title="" if i else f"{len(runs)} runs")
        rows.append(Panels([axes], _STATE_IN))
    errors, received = figure.add_axes((0, 0, 1, 1)), figure.add_axes((0, 0, 1, 1))
    for axes in (errors, received):
        axes.set(yscale="log", ylabel="norm")
        rows.append(Panels([axes], _NORM_IN))
    for k, (t_s, samples) in enumerate(zip(times, aligned, strict=True)):  # the first run is on top
        style: dict[str, Any] = {"linewidth": _NORM_LINE, "zorder": 3 - 0.1 * k}
        draw_line(errors, t_s, samples.e_s_norm, series_colour(k), **style)
        draw_line(errors, t_s, samples.threshold, series_colour(k), (5, 2), **style)
        draw_line(received, t_s, samples.e_c_norm, series_colour(k), **style)
    errors.set_title(r"Sensor's error $\|e_s\|$ and threshold (dashed)")
    limit_decades(errors, np.concatenate([samples.e_s_norm for samples in aligned]), _DECADES)
    received.set_title(r"Controller's error $\|e_c\|$")
    limit_decades(received, np.concatenate([samples.e_c_norm for samples in aligned]), _DECADES)
    rows.append(Panels([_draw_events(figure, runs)], _EVENTS_IN * (len(runs) + 1)))
    for row in rows:
        set_times(row.axes[0], longest, labelled=row is rows[-1])
    return rows


def _draw_events(figure: "Figure", runs: Sequence[ComparedRun]) -> "Axes":
    """Draw a row of marks per run: a bar for a delivered transmission, a cross for a lost one."""
    axes, heights = figure.add_axes((0, 0, 1, 1)), range(len(runs) - 1, -1, -1)
    for number, (run, height) in enumerate(zip(runs, heights, strict=True)):
        sensor = run.record[SENSOR_MEASUREMENT]
        sent = sensor[sensor["event"] != NO_SEQUENCE]
        delivered = np.isin(sent["event"], run.record[CONTROLLER_DELIVERY]["sequence"])
        t_s, y = sent["t_ns"] / NS_PER_S, np.full(len(sent), float(height))
        draw_marks(
            axes, t_s[delivered], y[delivered], series_colour(number),
            marker="|", markersize=13.0, markeredgewidth=1.6,
        )  # fmt: skip
        draw_marks(axes, t_s[~delivered], y[~delivered], palette.LOST, marker="x", markersize=4.5)
    name_ticks(axes, "y", {float(height): run.label for height, run in zip(heights, runs, strict=True)})
    axes.set(title="Transmissions (bar: delivered, cross: lost)", ylim=(-0.6, len(runs) - 0.4))
    axes.grid(visible=False, axis="y")
    return axes
