"""The campaign file: axes of the grid, draws, metrics and figures.

Settings have the keys of a scenario, as in ``--set``. A key with dots, in quotes, sets one value
(``"trigger.beta" = 0.3``). A key without dots sets a whole table (``trigger = { policy = … }``).
"""

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

from pydantic import BeforeValidator, Field, FiniteFloat, JsonValue, model_validator

from cosim.simulation.exact_simulation import ROW
from cosim.studies.campaign.metrics import METRICS, Metric
from netem.core import toml_file
from netem.core.errors import CallerError
from netem.core.settings_section import FolderName, ScenarioSection, Seed
from noack.scenario.symbols import ScenarioRoot
from noack.settings.values import MatrixRows

MOST_POINTS = 10_000
MOST_SERIES = 12
MOST_DRAWS = 100_000_000
"""Largest number of curves in a figure."""

Identifier = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,31}$")]
Settings = Annotated[dict[str, JsonValue], Field(min_length=1)]


def _require_scalar(value: object) -> object:
    if isinstance(value, list | dict):
        raise ValueError(
            "expected a number, a text, true or false; for matrices and tables use variants, "
            'e.g. variants = { "small" = { "trigger.weight" = [[1, 0], [0, 1]] } }'
        )
    return value


Value = Annotated[str | int | float | bool, BeforeValidator(_require_scalar)]


def label_of(value: JsonValue) -> str:
    """Return the text of a value of an axis."""
    if isinstance(value, bool):
        return str(value).lower()
    if not isinstance(value, float):
        return str(value)
    short = f"{value:g}"
    return short if float(short) == value else repr(value)


def _repeated(names: Sequence[str]) -> int | None:
    """Return the index of the first name that an earlier entry has, too."""
    return next((i for i, name in enumerate(names) if name in names[:i]), None)


def find_replaced_key(earlier_keys: Iterable[str], later_keys: Iterable[str]) -> tuple[str, str] | None:
    """Return a key and a later key that replaces its value or its table; None if there is none."""
    pairs = itertools.product(earlier_keys, later_keys)
    return next(((old, new) for old, new in pairs if f"{old}.".startswith(f"{new}.")), None)


def _require_kept(table: str, settings: Mapping[str, JsonValue]) -> None:
    for old, new in itertools.combinations(settings, 2):
        if find_replaced_key([old], [new]):
            raise ValueError(f"{table}: {new} replaces {old}, which is given before it")


_UNITS = {"_per_s": "1/s", "_s": "s", "_ms": "ms", "_us": "µs", "_ns": "ns", "_hz": "Hz", "_bps": "bit/s"}
"""Units by the ends of keys, the longer ends first."""


class CampaignAxis(ScenarioSection):
    """An axis of the grid: a key of the scenario with its values, or variants of several keys."""

    name: Identifier
    """Name of the column of the results: small letters, digits and _."""
    title: str = ""
    """Name in figures and tables; by default the name of the axis."""
    key: str | None = None
    """A key of the scenario, e.g. network.mansd; needs values."""
    values: Annotated[tuple[Value, ...], Field(min_length=1)] | None = None
    """Values of the key."""
    variants: Annotated[dict[str, Settings], Field(min_length=1)] | None = None
    """Instead of key and values: names, each with its settings."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.variants is None) == (self.key is None and self.values is None):
            raise ValueError("key: give key and values, or variants")
        if self.variants is None and (self.key is None or self.values is None):
            missing = "key" if self.key is None else "values"
            raise ValueError(f"{missing}: missing; an axis needs both key and values")
        if self.name in (*(ROW.names or ()), *METRICS, "draw"):
            raise ValueError(f"name: {self.name} is a column already; use another name")
        for name, settings in (self.variants or {}).items():
            _require_kept(f"variants.{name}", settings)
        if (twice := _repeated(self.labels)) is not None:
            raise ValueError(f"values: {self.labels[twice]} is given twice")
        return self

    @property
    def name_in_figures(self) -> str:
        """The axis's title, or its name if it has no title."""
        return self.title or self.name.replace("_", " ")

    @property
    def heading(self) -> str:
        """What it is called, with the unit of its key in brackets: the end of the key's name."""
        ends = (unit for end, unit in _UNITS.items() if (self.key or "").endswith(end))
        unit = next(ends, "") if "[" not in self.title else ""
        return f"{self.name_in_figures} [{unit}]" if unit else self.name_in_figures

    @property
    def labels(self) -> list[str]:
        """Texts of the values or variants, in order."""
        return list(self.variants) if self.variants else [label_of(v) for v in self.values or ()]

    @property
    def settings(self) -> list[Mapping[str, JsonValue]]:
        """Settings of each value or variant."""
        if self.variants is not None:
            return list(self.variants.values())
        return [{self.key or "": value} for value in self.values or ()]

    @property
    def keys(self) -> tuple[str, ...]:
        """All keys that the axis sets."""
        return tuple({key: None for settings in self.settings for key in settings})

    @property
    def numbers(self) -> list[float] | None:
        """The values as numbers, if all are numbers."""
        values = self.values or ()
        if not values or any(isinstance(v, str | bool) for v in values):
            return None
        return [float(value) for value in values]


class Metrics(ScenarioSection):
    """How runs are measured, and the columns of the tables."""

    shown: Annotated[tuple[Metric, ...], Field(min_length=1)] = (
        "transmissions",
        "deliveries",
        "inter_event_min_s",
        "settling_s",
        "cost",
        "certificate_used",
    )
    """Columns of the tables."""
    Q: MatrixRows | None = None
    """Weight of the state in the cost ∫ xᵀQx + uᵀRu dt, by rows; by default the identity."""
    R: MatrixRows | None = None
    """Weight of the input in the cost, by rows; by default the identity."""
    settle: Annotated[FiniteFloat, Field(gt=0, lt=1)] = 0.02
    """A run has settled when ‖x − x_r‖ stays below this share of its first value; x_r is 0 by default."""
    most_events: Annotated[int, Field(ge=1, le=10_000_000)] = 100_000
    """A run with more transmissions is stopped."""
    output: str | None = None
    """The output or state of the metric output_largest; needs time = "sampled"."""
    from_s: Annotated[FiniteFloat, Field(ge=0)] = 0.0
    """From when on output_largest counts, in s."""

    def heading(self, metric: Metric) -> str:
        """Return the heading of a column."""
        if metric == "output_largest":
            return f"largest |{self.output}| from {self.from_s:g} s on"
        return METRICS[metric].heading


class PairedComparison(ScenarioSection):
    """Differences draw by draw: the same plant, x(0) and losses at two values of an axis."""

    axis: Identifier
    """The axis."""
    reference: Value
    """The value or variant from which the differences are computed."""


class _Figure(ScenarioSection):
    spanned: ClassVar[tuple[str, ...]] = ()
    """The keys that name the axes which the figure shows as coordinates or series."""
    where: dict[str, Value] = Field({})
    """Only grid points with these values of these axes."""

    @property
    def axes_metrics(self) -> list[tuple[str, Metric]]:
        """The keys that name metrics, and these."""
        keys = ("x", "y") if isinstance(self, Pareto) else ("metric",)
        return [(key, getattr(self, key)) for key in keys]


class Pareto(_Figure):
    """Means of two metrics against each other, with the non-dominated points of each series."""

    spanned = ("series",)
    kind: Literal["pareto"] = "pareto"
    """One metric against another; smaller is better for both."""
    series: Identifier
    """The axis with one front per value."""
    x: Metric = "transmissions"
    """The horizontal axis."""
    y: Metric = "cost"
    """The vertical axis."""


class MetricCurve(_Figure):
    """The mean of a metric over an axis; one curve per combination of the other axes."""

    spanned = ("x",)
    kind: Literal["curve"] = "curve"
    """A metric over an axis."""
    x: Identifier
    """The axis."""
    metric: Metric
    """The metric."""


class HeatMap(_Figure):
    """The mean of a metric over two axes; one map per combination of the other axes."""

    spanned = ("x", "y")
    kind: Literal["heat_map"] = "heat_map"
    """A metric over two axes."""
    x: Identifier
    """The horizontal axis."""
    y: Identifier
    """The vertical axis."""
    metric: Metric
    """The metric."""


class Distribution(_Figure):
    """The cumulative distribution of a metric over the runs; one curve per grid point."""

    kind: Literal["distribution"] = "distribution"
    """A metric over all draws."""
    metric: Metric
    """The metric."""


AnyFigure = Pareto | MetricCurve | HeatMap | Distribution
Figure = Annotated[AnyFigure, Field(discriminator="kind")]


_CHUNK_DRAWS, _SAMPLED_DRAWS = 2000, 20
"""Draws per file: each file takes some seconds."""


class Campaign(ScenarioRoot):
    """Many runs over a grid of settings."""

    name: FolderName
    """Name of the campaign's folder: letters, digits, _ and -."""
    description: str = ""
    """The question that the campaign answers."""
    scenario: Annotated[str, Field(min_length=1)]
    """The scenario of all runs: a file in the folder of this file, or the name of a shipped
    scenario."""
    settings: dict[str, JsonValue] = Field({})
    """Settings of all runs, which replace the scenario's."""
    time: Literal["continuous", "sampled"] = "continuous"
    """continuous: continuous trigger, network without delay; exact and compiled. sampled: the
    machines of a live run in virtual time, with the schedule's sampling, delays and
    acknowledgements; about a thousand times slower."""
    draws: Annotated[int, Field(ge=1, le=MOST_DRAWS)]
    """Runs at each grid point, with different plants from the box, initial states and losses."""
    seed: Seed = 0
    """Seed of the draws. Draw i has the same plant, x(0) and losses at every grid point."""
    chunk: Annotated[int, Field(ge=1, le=1_000_000)] = Field(
        default_factory=lambda values: _SAMPLED_DRAWS if values.get("time") == "sampled" else _CHUNK_DRAWS
    )
    """Draws per file of the results; by default 2000, or 20 with sampled time. A worker computes one
    file at a time."""
    axes: Annotated[tuple[CampaignAxis, ...], Field(min_length=1)]
    """The axes; the grid has all combinations of their values."""
    metrics: Metrics = Metrics()
    compare: PairedComparison | None = None
    figures: tuple[Figure, ...] = ()
    """The figures of the page."""

    @cached_property
    def by_name(self) -> Mapping[str, CampaignAxis]:
        """The axes by name."""
        return {axis.name: axis for axis in self.axes}

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (twice := _repeated([axis.name for axis in self.axes])) is not None:
            raise ValueError(f"axes.{twice}.name: another axis has this name")
        for i, axis in enumerate(self.axes):
            for earlier_axis in self.axes[:i]:
                if (lost := find_replaced_key(earlier_axis.keys, axis.keys)) is not None:
                    raise ValueError(
                        f"axes.{i}.name: {lost[1]} would replace {lost[0]} of axis {earlier_axis.name}; "
                        "an axis that sets a whole table comes first, "
                        "and two axes cannot set the same key"
                    )
        _require_kept("settings", self.settings)
        if self.metrics.output is None and "output_largest" in self._used_metrics():
            raise ValueError("metrics.output: missing; output_largest needs the name of an output or state")
        if self.metrics.output is not None and self.time != "sampled":
            raise ValueError(
                'metrics.output: is measured at steps of the plant, so it needs time = "sampled"'
            )
        size = math.prod(len(axis.labels) for axis in self.axes)
        if size > MOST_POINTS:
            raise ValueError(f"axes: the grid has {size} points; at most {MOST_POINTS} are allowed")
        if self.compare is not None:
            self._require_axis("compare.axis", self.compare.axis)
            self._require_value("compare.reference", self.compare.axis, self.compare.reference)
        for i, figure in enumerate(self.figures):
            self._check_figure(f"figures.{i}", figure)
        return self

    def _used_metrics(self) -> set[Metric]:
        return {
            *self.metrics.shown,
            *(metric for figure in self.figures for _, metric in figure.axes_metrics),
        }

    def _check_figure(self, path: str, figure: AnyFigure) -> None:
        axis_names = [getattr(figure, key) for key in figure.spanned]
        for key, name in zip(figure.spanned, axis_names, strict=True):
            self._require_axis(f"{path}.{key}", name)
        self._require_values(f"{path}.where", figure.where.items())
        if len(set(axis_names)) < len(axis_names):
            raise ValueError(f"{path}.y: a map needs two different axes")
        if isinstance(figure, Pareto):
            series = [self.by_name[figure.series]]
        else:
            series = [axis for axis in self.axes if axis.name not in {*axis_names, *figure.where}]
        count = math.prod(len(axis.labels) for axis in series)
        if count > MOST_SERIES:
            raise ValueError(
                f"{path}: {count} series are too many, at most {MOST_SERIES}; "
                "select values of other axes with where = { axis = value }"
            )

    def _require_axis(self, path: str, name: str) -> None:
        if name not in self.by_name:
            raise ValueError(f"{path}: no such axis; the axes are {', '.join(self.by_name)}")

    def _require_values(self, path: str, values: Iterable[tuple[str, Value]]) -> None:
        for axis, value in values:
            self._require_axis(f"{path}.{axis}", axis)
            self._require_value(f"{path}.{axis}", axis, value)

    def _require_value(self, path: str, axis: str, value: Value) -> None:
        labels = self.by_name[axis].labels
        if label_of(value) not in labels:
            raise ValueError(f"{path}: no such value; {axis} has {', '.join(labels)}")

    def selected(self, conditions: Mapping[str, Value]) -> Iterator[tuple[int, ...]]:
        """Return the indices, one per axis, of the points of the grid with these values."""
        ranges = [
            [
                i
                for i, label in enumerate(axis.labels)
                if axis.name not in conditions or label == label_of(conditions[axis.name])
            ]
            for axis in self.axes
        ]
        return itertools.product(*ranges)


def load(path: Path) -> Campaign:
    """Read and validate a campaign file.

    Raises:
        CallerError: one line per mistake, each with file, key, value and remedy.
    """
    content = toml_file.read(path, Campaign)
    if "model" in content and "axes" not in content:
        raise CallerError(f"{path}: a scenario, not a campaign; a campaign names one by scenario = FILE")
    if content.keys().isdisjoint(("axes", "draws", "scenario")):
        raise CallerError(f"{path}: not a campaign: scenario, draws and axes are missing")
    return toml_file.validated(Campaign, content, str(path))


def json_schema() -> dict[str, object]:
    """Return the JSON Schema of campaign files, for editors."""
    return toml_file.json_schema(Campaign)
