"""Two or more runs beside each other: key numbers, settings that differ, how far apart x is."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from cosim.analysis.run_summary import Summary
from cosim.live.finalize import reopen
from cosim.record.run_record import RunRecord, load_record
from noack.core.errors import CallerError
from noack.protocol.record_tables import PLANT_STEP

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LABELS = "ABCDEFG"
"""What the runs are called; there are as many colours."""
_LONGEST_VALUE = 40
_NAMES_ONLY = ("name", "description", "ports.", "realtime.")
"""Settings that do not change what a run computes."""


class ComparedRun(NamedTuple):
    """One of the runs."""

    label: str
    directory: Path
    summary: Summary
    record: RunRecord

    @property
    def title(self) -> str:
        """What was run, in words."""
        mode = "model-based" if self.summary["mode"] == "model" else "zero-order hold"
        kind = self.summary.get("kind", "live")
        return f"{self.summary['scenario']}, {mode}, {kind}, M − 1 = {self.summary['mansd']}"


class KeyNumber(NamedTuple):
    """A number of each run."""

    name: str
    values: tuple[float | None, ...]
    """One per run, in order; None where a run has none."""

    @property
    def differences(self) -> tuple[float | None, ...]:
        """Each minus the first run's; None where either is missing."""
        first = self.values[0]
        return tuple(
            None if first is None or value is None else value - first for value in self.values
        )

    @property
    def cells(self) -> list[str]:
        """The numbers as a person reads them, each with its difference to the first."""
        return [
            "-" if value is None else f"{value:.4g}" + (f" ({apart:+.3g})" if apart else "")
            for value, apart in zip(self.values, self.differences, strict=True)
        ]


@dataclass(frozen=True)
class RunComparison:
    """Runs of plants with the same number of states, beside each other.

    Args:
        runs: two or more; differences are to the first.
    """

    runs: tuple[ComparedRun, ...]

    @cached_property
    def numbers(self) -> list[KeyNumber]:
        """The key numbers that at least one of the runs has."""
        found = [
            KeyNumber(name, tuple(value(run.summary) for run in self.runs))
            for name, value in _NUMBERS.items()
        ]
        rms, largest = zip(*(_distance(self.runs[0].record, run.record) for run in self.runs),
                           strict=True)  # fmt: skip
        found.append(KeyNumber("distance in x to A, RMS", rms))
        found.append(KeyNumber("distance in x to A, maximum", largest))
        return [one for one in found if any(value is not None for value in one.values)]

    @cached_property
    def settings(self) -> dict[str, tuple[str, ...]]:
        """The settings that differ, by key, each with its value in every run."""
        flat = [dict(_flat(run.record.scenario.model_dump(mode="json"))) for run in self.runs]
        keys = dict.fromkeys(key for one in flat for key in one)
        found = {key: tuple(one.get(key, "-") for one in flat) for key in keys}
        return {
            key: tuple(map(_short, values))
            for key, values in found.items()
            if len(set(values)) > 1 and not key.startswith(_NAMES_ONLY)
        }

    def plot(self) -> "Figure":
        """Draw states, ‖e_s‖ with thresholds, ‖e_c‖ and transmissions of all runs overlaid."""
        from cosim.studies.comparison.overlay_figure import overlay_figure

        return overlay_figure(self.runs)

    def save(self, path: Path) -> None:
        """Write the overlay: as a page (``.html``), or the figure alone (``.svg``, ``.png``).

        Raises:
            CallerError: the name ends otherwise.
            MachineError: the file cannot be written.
        """
        from cosim.studies.comparison.overlay_figure import write_overlay

        write_overlay(self, path)

    def to_json(self) -> dict[str, Any]:
        """Everything but the figure, for programs."""
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
        """The key numbers as a table of words: name, then a cell per run."""
        return [(one.name, *one.cells) for one in self.numbers]

    @property
    def setting_rows(self) -> list[tuple[str, ...]]:
        """The settings that differ as a table of words: key, then a cell per run."""
        return [(key, *values) for key, values in self.settings.items()]

    def __repr__(self) -> str:
        from cosim.output.row_display import as_text

        legend = "\n".join(f"{run.label}  {run.title}  {run.directory}" for run in self.runs)
        return f"{legend}\n{as_text([('', *(run.label for run in self.runs)), *self.rows])}"


def compare_runs(directories: Sequence[Path]) -> RunComparison:
    """Open runs and put them beside each other.

    Args:
        directories: two to seven run directories, live or simulated.

    Raises:
        CallerError: they are too few or too many, one is no run directory, or their plants have
            different numbers of states.
    """
    if not 2 <= len(directories) <= len(LABELS):
        raise CallerError(
            f"give 2 to {len(LABELS)} run directories to compare, not {len(directories)}; "
            "`noack fidelity` compares one with the ideal loop"
        )
    runs = tuple(
        ComparedRun(label, path, reopen(path).summary, load_record(path))
        for label, path in zip(LABELS, directories, strict=False)
    )
    first = runs[0].record.loop.n
    for run in runs[1:]:
        if run.record.loop.n != first:
            raise CallerError(
                f"{run.directory}: its plant has {run.record.loop.n} states, that of "
                f"{runs[0].directory} has {first}; runs with equally many states can be compared"
            )
    return RunComparison(runs)


def _claims(verdict: str) -> Callable[[Summary], int]:
    return lambda summary: sum(one["verdict"] == verdict for one in summary.get("claims") or ())


def _missed(summary: Summary) -> int | None:
    late = summary["lateness_us"]
    return sum(one["late_steps"] for one in late.values()) if late else None


def _loss_rate(summary: Summary) -> float:
    return float(100 * summary["drops"] / max(summary["drops"] + summary["deliveries"], 1))


_NUMBERS: dict[str, Callable[[Summary], float | None]] = {
    "simulated time, s": lambda s: s["reached_s"],
    "transmissions": lambda s: s["events"],
    "ideal loop: transmissions": lambda s: (s.get("fidelity") or {}).get("events_ideal"),
    "deliveries": lambda s: s["deliveries"],
    "forced by the guarantee": lambda s: s["forced_deliveries"],
    "lost in the network": lambda s: s["drops"],
    "loss rate, %": _loss_rate,
    "longest loss burst": lambda s: s["longest_loss_burst"],
    "shortest inter-event time, s": lambda s: s["inter_event_min_s"],
    "median inter-event time, s": lambda s: s["inter_event_median_s"],
    "median time between deliveries, s": lambda s: s["inter_delivery_median_s"],
    "‖x‖ at the end": lambda s: s["final_state_norm"],
    "largest ‖e_s‖": lambda s: s["sup_e_s_norm"],
    "largest ‖e_c‖": lambda s: s["sup_e_c_norm"],
    "latency p50, µs": lambda s: (s["latency_us"] or {}).get("p50"),
    "latency p99, µs": lambda s: (s["latency_us"] or {}).get("p99"),
    "deadlines missed": _missed,
    "claims held": _claims("held"),
    "claims violated": _claims("violated"),
    "claims void": _claims("void"),
}


@np.errstate(all="ignore")  # a run may diverge
def _distance(first: RunRecord, other: RunRecord) -> tuple[float | None, float | None]:
    """RMS and maximum of ‖x − x'‖ over the times that both records have; None if not finite."""
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


def _short(text: str) -> str:
    return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 1]}…"
