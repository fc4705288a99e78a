"""A comparison of runs: key numbers, settings that differ, and the distance between states."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from cosim.analysis.summary_model import FidelityPart, LoopSummary, RunSummary
from cosim.live.finalize import reopen
from cosim.record.run_directory import chosen_run
from cosim.record.run_record import RunRecord, load_record
from noack.core.errors import CallerError, shortened
from noack.protocol.record_tables import PLANT_STEP

if TYPE_CHECKING:
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
        one = self.summary
        mode = "model-based" if self.loop.mode == "model" else "zero-order hold"
        return f"{one.scenario}, {mode}, {one.kind}, M − 1 = {one.mansd}"

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
        return tuple(
            None if first is None or value is None else value - first for value in self.values
        )

    @property
    def cells(self) -> list[str]:
        """The values as text, each with its difference to the first run's."""
        return [
            "-" if value is None else f"{value:.4g}" + (f" ({apart:+.3g})" if apart else "")
            for value, apart in zip(self.values, self.differences, strict=True)
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
        found = {
            name: tuple(value(run.loop) for run in self.runs) for name, value in _NUMBERS.items()
        }
        apart = [_distance(self.runs[0].record, run.record) for run in self.runs]
        found["distance in x to A, RMS"] = tuple(rms for rms, _ in apart)
        found["distance in x to A, maximum"] = tuple(largest for _, largest in apart)
        return [KeyNumber(*one) for one in found.items() if any(v is not None for v in one[1])]

    @cached_property
    def settings(self) -> dict[str, tuple[str, ...]]:
        """The settings that differ, by key, with the value in every run."""
        flat = [dict(_flat(run.record.scenario.model_dump(mode="json"))) for run in self.runs]
        keys = dict.fromkeys(key for one in flat for key in one)
        found = {key: tuple(one.get(key, "-") for one in flat) for key in keys}
        return {
            key: tuple(shortened(value, _LONGEST_VALUE) for value in values)
            for key, values in found.items()
            if len(set(values)) > 1 and not key.startswith(_NAMES_ONLY)
        }

    def plot(self) -> "Figure":
        """Draw states, ‖e_s‖ with thresholds, ‖e_c‖ and transmissions of all runs overlaid."""
        from cosim.output.figure_drawing import draw
        from cosim.studies.comparison_figure import overlay_figure

        return draw(overlay_figure(self.runs))

    def save(self, path: Path, width: str | float | None = None) -> None:
        """Write the overlay as a page (``.html``), or the figure alone (``.svg``, ``.pdf``, …).

        Args:
            path: of the file.
            width: of a figure: ``column``, ``page`` or inches, see ``docs/papers.md``.

        Raises:
            CallerError: the name has another ending, or there is no such width.
            MachineError: the file cannot be written.
        """
        from cosim.studies.comparison_figure import write_overlay

        write_overlay(self, path, width)

    def to_json(self) -> dict[str, Any]:
        """Return the comparison without the figure, for programs."""
        return {
            "runs": [
                {"label": run.label, "directory": str(run.directory), "title": run.title}
                for run in self.runs
            ],
            "numbers": {one.name: list(one.values) for one in self.numbers},
            "differences": {one.name: list(one.differences) for one in self.numbers},
            "settings": {key: list(values) for key, values in self.settings.items()},
        }

    @property
    def rows(self) -> list[tuple[str, ...]]:
        """Return the key numbers as a table of text: name, then a cell per run."""
        return [(one.name, *one.cells) for one in self.numbers]

    @property
    def setting_rows(self) -> list[tuple[str, ...]]:
        """Return the settings that differ as a table of text: key, then a cell per run."""
        return [(key, *values) for key, values in self.settings.items()]

    def __repr__(self) -> str:
        from noack.core.number_format import as_text

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
        raise CallerError(
            f"give 2 to {len(LABELS)} run directories to compare, not {len(directories)}; "
            "`noack fidelity` compares one with the ideal loop"
        )
    runs = tuple(map(_compared, LABELS, directories))
    first = runs[0].record.loop.n
    for run in runs[1:]:
        if run.record.loop.n != first:
            raise CallerError(
                f"{run.directory}: its plant has {run.record.loop.n} states, that of "
                f"{runs[0].directory} has {first}; runs with equally many states can be compared"
            )
    return RunComparison(runs)


def _compared(label: str, given: Path) -> ComparedRun:
    """Open a run of one loop, or a loop of a run: ``RUN:NAME``."""
    folder, colon, name = given.name.partition(":")
    loop = name if colon and not given.exists() else None
    path = given if loop is None else given.with_name(folder)
    path = chosen_run(path, path.parent)
    outcome, record = reopen(path), load_record(path, loop)
    shown = path if loop is None else given
    return ComparedRun(label, shown, outcome.summary.of_loop(record.scenario.name), record)


def _claims(verdict: str) -> Callable[[LoopSummary], int]:
    return lambda loop: sum(one.verdict == verdict for one in loop.claims)


def _missed(loop: LoopSummary) -> int | None:
    late = loop.lateness_us
    return sum(one.late_steps for one in late.values()) if late else None


def _loss_rate(loop: LoopSummary) -> float:
    return float(100 * loop.drops / max(loop.drops + loop.deliveries, 1))


def _ideal(loop: LoopSummary) -> int | None:
    return loop.fidelity.events_ideal if isinstance(loop.fidelity, FidelityPart) else None


_NUMBERS: dict[str, Callable[[LoopSummary], float | None]] = {
    "simulated time, s": lambda s: s.reached_s,
    "transmissions": lambda s: s.events,
    "ideal loop: transmissions": lambda s: _ideal(s),
    "deliveries": lambda s: s.deliveries,
    "forced by the guarantee": lambda s: s.forced_deliveries,
    "lost in the network": lambda s: s.drops,
    "loss rate, %": _loss_rate,
    "longest loss burst": lambda s: s.longest_loss_burst,
    "shortest inter-event time, s": lambda s: s.inter_event_min_s,
    "median inter-event time, s": lambda s: s.inter_event_median_s,
    "median time between deliveries, s": lambda s: s.inter_delivery_median_s,
    "‖x‖ at the end": lambda s: s.final_state_norm,
    "largest ‖e_s‖": lambda s: s.sup_e_s_norm,
    "largest ‖e_c‖": lambda s: s.sup_e_c_norm,
    "latency p50, µs": lambda s: None if s.latency_us is None else s.latency_us.p50,
    "latency p99, µs": lambda s: None if s.latency_us is None else s.latency_us.p99,
    "deadlines missed": _missed,
    "claims held": _claims("held"),
    "claims violated": _claims("violated"),
    "claims void": _claims("void"),
}


@np.errstate(all="ignore")  # a run may diverge
def _distance(first: RunRecord, other: RunRecord) -> tuple[float | None, float | None]:
    """RMS and maximum of ‖x − x'‖ over the common times of two records; None if not finite."""
    a, b = first[PLANT_STEP], other[PLANT_STEP]
    _, at_a, at_b = np.intersect1d(a["t_ns"], b["t_ns"], return_indices=True)
    if first is other or not len(at_a):
        return None, None
    apart = np.linalg.norm(b["x"][at_b] - a["x"][at_a], axis=1)
    if not np.isfinite(apart).all():
        return None, None
    return float(np.sqrt(np.mean(apart**2))), float(apart.max())


def _flat(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    for key, value in settings.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", str(value)
