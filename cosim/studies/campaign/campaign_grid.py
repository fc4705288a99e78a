"""The grid points of a campaign file: each has a scenario and the work for its draws."""

import copy
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import blake2b
from pathlib import Path
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from cosim.shipped_files import find_shipped
from cosim.simulation.exact_simulation import ROW, Setting, left_out, run_batch, setting_of
from cosim.studies.campaign.campaign_file import Campaign, Metrics, Value
from cosim.studies.campaign.campaign_workers import Work
from cosim.studies.campaign.drawn_runs import SampledWork, SharedNetworkWork, in_virtual_time, measured_rows
from cosim.studies.campaign.metrics import METRICS, OF_THRESHOLD, certified_error
from cosim.studies.campaign.random_draws import Box, box_of
from netem.core import toml_file
from netem.core.errors import CallerError
from netem.core.settings_section import Table
from noack.core.linear_systems import Matrix
from noack.scenario.arrival_ties import with_later_updates
from noack.scenario.resolution import ResolvedRun, policy_of, resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import completed, put
from noack.settings.values import MatrixRows, require_shape

SCENARIOS = "scenarios"


@dataclass(frozen=True)
class Point:
    """A point of the grid."""

    number: int
    indices: tuple[int, ...]
    """Index of the point's value on each axis."""
    labels: Mapping[str, str]
    """Labels by axis."""
    values: Mapping[str, Value]
    """Values by axis: numbers if all values of the axis are numbers, otherwise labels."""
    scenario: Scenario
    """The scenario; its plant and initial state are not yet drawn."""
    certified_error: float | None
    """Certified bound Δβ, or None."""
    work: Work
    """Computes the draws of the point."""
    error_scale: tuple[tuple[float, object], ...] = ()
    """What ``sup_e_c_scaled`` is in units of: rate and norm of each loop's threshold."""
    tie: str = ""
    """At which of two ticks updates act, as a sentence; empty: none arrives at a tick."""


@dataclass(frozen=True)
class ContinuousWork:
    """Computes draws of a grid point in continuous time."""

    setting: Setting
    box: Box
    seed: int

    def run(self, draws: range) -> NDArray[np.void]:
        """Compute consecutive draws; one row each."""
        return run_batch(self.setting, self.box.population(self.seed, draws))


def base_of(campaign: Campaign, path: Path) -> tuple[Path, Table]:
    """Return path and content of the scenario of all runs, with the common settings.

    Raises:
        CallerError: the scenario cannot be read, or a setting does not fit.
    """
    source = f'{path}: scenario = "{campaign.scenario}"'
    scenario = path.parent / campaign.scenario
    if not scenario.is_file():
        if scenario.suffix == ".toml" or scenario.exists():
            raise CallerError(f"{source}: no such file beside the campaign file, and no shipped scenario")
        try:
            scenario = find_shipped(campaign.scenario, SCENARIOS)
        except CallerError as error:
            raise CallerError(f"{path}: scenario: {error}") from None
    content = toml_file.read(scenario)
    for key, value in campaign.settings.items():
        put(content, key, value, f"{path}: settings.{key}")
    return scenario, content


def grid(campaign: Campaign, path: Path) -> list[Point]:
    """Return all grid points of the campaign in this file; the last axis varies fastest.

    Raises:
        CallerError: one line per mistake.
    """
    scenario_path, base = base_of(campaign, path)
    points = []
    for number, indices in enumerate(campaign.selected({})):
        content, chosen = copy.deepcopy(base), list(zip(campaign.axes, indices, strict=True))
        labels = {axis.name: axis.labels[i] for axis, i in chosen}
        values = {axis.name: (axis.numbers or axis.labels)[i] for axis, i in chosen}
        source = f"{path}: at {', '.join(f'{name} = {label}' for name, label in labels.items())}"
        settings = [item for axis, i in chosen for item in axis.settings[i].items()]
        for key, value in settings:
            put(content, key, value, source)
        scenario = completed(content, scenario_path, source)
        tie = ""
        try:
            if campaign.time == "sampled":
                scenario, tie = with_later_updates(scenario)
            work, certified = _work(campaign, scenario)
        except (CallerError, ValueError) as error:
            raise CallerError(f"{source}: {error}") from None
        scale = _error_scale(scenario)
        points.append(Point(number, indices, labels, values, scenario, certified, work, scale, tie))
    if len({type(point.work) for point in points}) > 1:
        raise CallerError(f"{path}: axes: either all grid points have loops, or none has")
    _require_effects(campaign, points, path)
    _require_comparable(campaign, points, path)
    return points


def row_type(points: Sequence[Point]) -> np.dtype[np.void]:
    """Return the type of the rows of runs."""
    work = points[0].work
    return work.row_type if isinstance(work, SampledWork) else ROW


def _error_scale(scenario: Scenario) -> tuple[tuple[float, object], ...]:
    """Return rate and norm of the threshold of each loop, which ``sup_e_c_scaled`` depends on."""
    policies = [policy_of(resolve(entry.scenario)) for entry in ResolvedRun(scenario).entries]
    weights = [getattr(policy, "weight", None) for policy in policies]
    return tuple(
        (policy.fading_per_s, None if weight is None else tuple(map(tuple, np.asarray(weight).tolist())))
        for policy, weight in zip(policies, weights, strict=True)
    )


def _require_comparable(campaign: Campaign, points: Sequence[Point], path: Path) -> None:
    """Refuse a figure of ``sup_e_c_scaled`` at points whose thresholds decay otherwise or have other norms.

    Raises:
        CallerError: a figure compares what is not comparable.
    """
    for i, figure in enumerate(campaign.figures):
        for key, metric in figure.axes_metrics:
            shown = {*campaign.selected(figure.where)}
            scales = {point.error_scale for point in points if point.indices in shown}
            if metric == OF_THRESHOLD and len(scales) > 1:
                raise CallerError(
                    f"{path}: figures.{i}.{key} = {metric}: is not comparable: it is "
                    f"{METRICS[metric].title}, and α or the trigger's norm differs between the points; "
                    "choose points with where, or another metric"
                )


def _require_effects(campaign: Campaign, points: Sequence[Point], path: Path) -> None:
    """Refuse an axis with two values that give the same runs.

    Raises:
        CallerError: an axis has no effect on the runs.
    """
    runs = {point.indices: blake2b(pickle.dumps(point.work)).digest() for point in points}
    for i, axis in enumerate(campaign.axes):
        contents: dict[bytes, str] = {}
        for value, label in enumerate(axis.labels):
            value_runs = b"".join(content for indices, content in runs.items() if indices[i] == value)
            if (other_label := contents.setdefault(value_runs, label)) != label:
                raise CallerError(
                    f"{path}: axes.{i}: {axis.name} = {other_label} and {axis.name} = {label} are the "
                    f"same runs: {', '.join(axis.keys)} has no effect on them"
                )


class _Measured(TypedDict):
    """The settings of the metrics that all kinds of work have."""

    Q: Matrix | None
    R: Matrix | None
    settle: float
    most_events: int


def _work(campaign: Campaign, scenario: Scenario) -> tuple[Work, float | None]:
    """Return the work, and the certified bound Δβ or None."""
    metrics = campaign.metrics
    n, m = scenario.model.dimensions
    Q = _weight(metrics.Q, "metrics.Q", n, "one row per state")
    R = _weight(metrics.R, "metrics.R", m, "one row per input")
    measured: _Measured = {"Q": Q, "R": R, "settle": metrics.settle, "most_events": metrics.most_events}
    if scenario.loops and campaign.time != "sampled":
        raise CallerError('loops: a network that loops share needs time = "sampled"')
    if campaign.time == "sampled":
        _require_output(metrics, scenario)
        kind = SharedNetworkWork if scenario.loops else SampledWork
        work = kind(
            in_virtual_time(scenario), campaign.seed, **measured, output=metrics.output, from_s=metrics.from_s
        )
        return work, None
    resolved = resolve(scenario)
    if resolved.protocol.acknowledges:
        raise CallerError(
            'network.protocol: continuous time needs the loop without acknowledgements, "none"; '
            'time = "sampled" takes both'
        )
    if kinds := left_out(resolved.network.link):
        raise CallerError(
            f"network.impairments: {kinds}: in continuous time the "
            'network has no delay; leave it out, e.g. settings = { "network.impairments" = [] }, '
            'or use time = "sampled"'
        )
    try:
        setting = replace(setting_of(resolved), **measured)
    except CallerError as error:
        raise CallerError(f'{error}; time = "sampled" runs it as `noack simulate` does') from None
    return ContinuousWork(setting, box_of(scenario), campaign.seed), certified_error(resolved)


def _require_output(metrics: Metrics, scenario: Scenario) -> None:
    """Raise CallerError unless each loop has the output that is measured, before the horizon."""
    if metrics.output is None:
        return
    for entry in ResolvedRun(scenario).entries:
        names = measured_rows(entry.scenario)
        if metrics.output not in names:
            raise CallerError(
                f"metrics.output = {metrics.output}: no such output; it is one of {', '.join(names)}"
            )
    if metrics.from_s >= scenario.horizon_s:
        raise CallerError(f"metrics.from_s = {metrics.from_s:g}: the runs end at {scenario.horizon_s:g} s")


def _weight(rows: MatrixRows | None, key: str, size: int, reason: str) -> Matrix | None:
    require_shape(rows, key, (size, size), reason)
    if rows is None:
        return None
    weight = np.array(rows)
    if not np.array_equal(weight, weight.T):
        raise ValueError(f"{key}: must be symmetric")
    return weight
