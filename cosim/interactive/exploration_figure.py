"""The figure of an explored run: a state with its two models, errors, ‖x‖, and transmissions.

All items always exist, perhaps without points, so that the lab page can replace their data only.
:class:`DraftResults` computes what the figure shows, when it is first asked for.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar, cast

import numpy as np

from cosim.interactive.draft import Draft
from cosim.interactive.ensemble import Ensemble, explore_ensemble
from cosim.interactive.exploration import Exploration, run_of, why_not_exact
from cosim.interactive.scenario_guarantee import Guarantee, Margin, certify, margin_of, warning
from cosim.output.figure_description import (
    DASHED,
    DOTTED,
    Axis,
    Band,
    FigureDescription,
    Line,
    Marks,
    Panel,
    Row,
    time_axis,
)
from cosim.output.palette import CERTIFIED, CONTROLLER, FORCED, LOST, PLANT, SENSOR, THRESHOLD
from noack.config.scenario import Scenario
from noack.core.errors import CallerError
from noack.core.linear_systems import Vector

BAND, KEPT = "90 % of draws", "kept settings"
_SMALLEST = 1e-6
"""Smallest value on a logarithmic axis, as a share of the largest; an error is 0 after a reset."""
_DECADES = 7
"""Below and above the largest value on a logarithmic axis; a bound may be far above the run."""
_HEIGHTS_IN = (1.96, 1.96, 1.4, 1.68)
_NOTHING = np.empty(0)


class Shown(NamedTuple):
    """What the figure shows."""

    run: Exploration
    state: int
    """Number of the drawn state, from 0 on."""
    ensemble: Ensemble | None = None
    guarantee: Guarantee | None = None
    reference: Exploration | None = None
    """A run with other settings, for comparison."""


def exploration_figure(shown: Shown) -> FigureDescription:
    """Describe the four panels of a run with all that is known of it."""
    panels = [_state(shown), _errors(shown), _norm(shown), _events(shown)]
    return FigureDescription(
        name="exploration",
        rows=[
            Row(panels=[panel], height_in=height_in)
            for panel, height_in in zip(_with_legends(panels, shown), _HEIGHTS_IN, strict=True)
        ],
        description="; ".join(title for title, _, _ in panels),
    )


_Part = tuple[str, Sequence[Band | Line | Marks], Axis]
"""Title, items and vertical axis of a panel."""


def _with_legends(parts: Sequence[_Part], shown: Shown) -> list[Panel]:
    """Return the panels; a name that several of them show is in the legend of the first."""
    drawn = {item.label for _, items, _ in parts for item in items if _has_points(item)}
    known, panels = {"‖x‖"}, []
    horizon_s = np.array([0.0, shown.run.scenario.horizon_s])
    for i, (title, items, y) in enumerate(parts):
        names = [*dict.fromkeys(item.label for item in items)]
        legend = [name for name in names if name in drawn - known]
        known |= {*names}
        x = time_axis(horizon_s, numbers=i == len(parts) - 1)
        panels.append(Panel(title=title, items=items, x=x, y=y, legend=legend))
    return panels


def _has_points(item: Band | Line | Marks) -> bool:
    return bool(np.isfinite(item.low if isinstance(item, Band) else item.y).any())


def _state(shown: Shown) -> _Part:
    run, i, reference = shown.run, shown.state, shown.reference
    x, x_s = run.x[:, i], run.x_s[:, i]
    x_c = np.where(run.controller_knows, run.x_c[:, i], np.nan)
    band_t_s, band = _NOTHING, None
    if shown.ensemble is not None and i < len(shown.ensemble.states):
        band_t_s, band = shown.ensemble.t_s, shown.ensemble.states[i]
    kept_t_s = kept = _NOTHING
    if reference is not None and i < reference.x.shape[1]:
        kept_t_s, kept = reference.t_s, reference.x[:, i]
    items: list[Band | Line | Marks] = [
        Band(x=band_t_s, low=_NOTHING if band is None else band.low, label=BAND, colour=PLANT,
             high=_NOTHING if band is None else band.high, opacity=0.22),
        Line(x=run.t_s, y=x, label="plant x", colour=PLANT, width=2.25),
        Line(x=run.t_s, y=x_s, label="sensor x_s", colour=SENSOR),
        Line(x=run.t_s, y=x_c, label="controller x_c", colour=CONTROLLER),
        Line(x=kept_t_s, y=kept, label=KEPT, colour=FORCED, width=0.9, dash=DASHED),
    ]  # fmt: skip
    about = np.concatenate([x, x_s, x_c, kept])
    return f"{run.state_names[i]}: plant and both models", items, Axis(about=about)


def _errors(shown: Shown) -> _Part:
    run, guarantee, reference = shown.run, shown.guarantee, shown.reference
    floor, known = _floor(run), run.controller_knows
    threshold = np.full(len(run.t_s), np.nan) if run.threshold is None else run.threshold
    e_s = _positive(run.e_s_norm, floor)
    e_c = np.where(known, _positive(run.e_c_norm, floor), np.nan)
    kept = _NOTHING
    if reference is not None:
        kept = np.where(reference.controller_knows, _positive(reference.e_c_norm, floor), np.nan)
    high = _NOTHING if shown.ensemble is None else _positive(shown.ensemble.e_c_norm.high, floor)
    items = [
        Line(x=run.t_s, y=threshold, label="threshold", colour=THRESHOLD, width=0.9, dash=DASHED),
        Line(x=run.t_s, y=e_s, label="‖e_s‖", colour=SENSOR),
        Line(x=run.t_s, y=e_c, label="‖e_c‖", colour=CONTROLLER),
        _certified(guarantee, None if guarantee is None else guarantee.e_c),
        _edge(shown.ensemble, high),
        _kept(reference, kept),
    ]
    about = np.concatenate([threshold, e_s, e_c])
    y = Axis(logarithmic=True, about=about, decades=_DECADES)
    return "errors of the models (logarithmic)", items, y


def _norm(shown: Shown) -> _Part:
    run, guarantee, ensemble = shown.run, shown.guarantee, shown.ensemble
    low = _NOTHING if ensemble is None else _positive(ensemble.x_norm.low, 0.0)
    high = _NOTHING if ensemble is None else _positive(ensemble.x_norm.high, 0.0)
    norm = _positive(run.x_norm, _SMALLEST * _largest(run.x_norm))
    reference = shown.reference
    kept = _NOTHING
    if reference is not None:
        kept = _positive(reference.x_norm, _SMALLEST * _largest(reference.x_norm))
    items = [
        Line(x=run.t_s, y=norm, label="‖x‖", colour=PLANT, width=2.25),
        _certified(guarantee, None if guarantee is None else guarantee.x),
        _edge(ensemble, low),
        _edge(ensemble, high),
        _kept(reference, kept),
    ]
    return "‖x‖ (logarithmic)", items, Axis(logarithmic=True, about=norm, decades=_DECADES)


def _events(shown: Shown) -> _Part:
    run = shown.run
    since_s, delivered = np.diff(run.event_s, prepend=0.0), run.delivered
    items = [
        Marks(x=run.event_s[delivered], y=since_s[delivered], label="delivered",
              colour=CONTROLLER),
        Marks(x=run.event_s[~delivered], y=since_s[~delivered], label="lost", colour=LOST,
              marker="x", stroke=1.6),
    ]  # fmt: skip
    return "transmissions: time since the last one [s]", items, Axis(ends=(0.0, None))


def _certified(guarantee: Guarantee | None, values: Vector | None) -> Line:
    t_s = _NOTHING if guarantee is None else guarantee.t_s
    y = _NOTHING if values is None else values
    return Line(x=t_s, y=y, label="certified bound", colour=CERTIFIED)


def _edge(ensemble: Ensemble | None, values: Vector) -> Line:
    t_s = _NOTHING if ensemble is None else ensemble.t_s
    return Line(x=t_s, y=values, label=BAND, colour=PLANT, width=0.75, dash=DOTTED)


def _kept(reference: Exploration | None, values: Vector) -> Line:
    t_s = _NOTHING if reference is None else reference.t_s
    return Line(x=t_s, y=values, label=KEPT, colour=FORCED, width=0.9, dash=DASHED)


def _floor(run: Exploration) -> float:
    """Return the smallest error that is drawn: errors are 0 after a reset."""
    if run.threshold is not None and len(run.threshold):
        return 0.01 * float(np.min(run.threshold))
    return _SMALLEST * max(_largest(norm) for norm in (run.e_s_norm, run.e_c_norm))


def _largest(values: Vector) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.max(initial=0.0)) or 1.0


def _positive(values: Vector, floor: float) -> Vector:
    """Return values for a logarithmic axis: not below a floor; NaN if that is 0."""
    with np.errstate(all="ignore"):
        return np.where(values > floor, values, floor if floor > 0 else np.nan)


T = TypeVar("T")

RUN, CERTIFICATE, ENSEMBLE, MARGIN = "run", "certificate", "ensemble", "margin"


class DraftResults:
    """The draft and its results; each change of the draft begins anew.

    Raises:
        NoackError: the scenario is wrong, or has several loops.
    """

    def __init__(self, draft: Draft) -> None:
        self.listeners: list[Callable[[], None]] = []
        """Called after each change of the draft."""
        self.take(draft)

    def take(self, draft: Draft) -> None:
        """Take another draft; if it is wrong, the old one stays.

        Raises:
            NoackError: the scenario is wrong, or has several loops.
        """
        if draft.scenario.loops:
            raise CallerError("loops: only one loop can be explored; noack.simulate takes several")
        self.draft = draft
        self._found: dict[str, object] = {}
        for listener in self.listeners:
            listener()

    @property
    def known(self) -> frozenset[str]:
        """Which results are computed: RUN, CERTIFICATE, ENSEMBLE, MARGIN."""
        return frozenset(self._found)

    @property
    def run(self) -> Exploration:
        """The run."""
        return self._once(RUN, run_of)

    @property
    def certificate(self) -> Guarantee:
        """What is guaranteed."""
        return self._once(CERTIFICATE, certify)

    @property
    def ensemble(self) -> Ensemble | None:
        """Bands over many draws; None without exact simulation."""
        if why_not_exact(self.draft.scenario) is not None:
            return None
        return self._once(ENSEMBLE, explore_ensemble)

    @property
    def margin(self) -> Margin:
        """For which M the loop is stable; this may take seconds."""
        return self._once(MARGIN, margin_of)

    @property
    def warning(self) -> str:
        """In words, by what is computed: whether the loop is unstable, and why."""
        certificate = self.certificate if CERTIFICATE in self.known else None
        return warning(self.run, certificate, self.margin if MARGIN in self.known else None)

    @property
    def facts(self) -> dict[str, list[tuple[str, str]]]:
        """What is computed, in groups of labels and values."""
        bands = self.ensemble if ENSEMBLE in self.known else None
        run = [*self.run.numbers, *(() if bands is None else bands.numbers)]
        groups = {f"this run ({self.run.kind})": run}
        if CERTIFICATE in self.known:
            found = self.certificate
            groups["certificate"] = [
                ("certificate", f"{found.verdict}: {found.reason}"), *found.rows,
                *((what, f"{verdict} ({why})") for verdict, what, why in found.assumptions),
            ]  # fmt: skip
        if MARGIN in self.known:
            groups["margin"] = [
                ("margin", self.margin.verdict),
                *((f"M = {m}: growth of the worst pattern (D delivered, L lost) per event",
                   f"{growth}, {verdict}") for m, growth, verdict in self.margin.rows),
            ]  # fmt: skip
        return groups

    def shown(self, state: int) -> Shown:
        """Return what a figure shows of the results that are computed."""
        return Shown(
            self.run, state, self.ensemble if ENSEMBLE in self.known else None,
            self.certificate if CERTIFICATE in self.known else None,
        )  # fmt: skip

    def put(self, name: str, result: object) -> None:
        """Take a result that was computed elsewhere: RUN, CERTIFICATE, ENSEMBLE or MARGIN."""
        self._found[name] = result

    def _once(self, name: str, compute: Callable[[Scenario], T]) -> T:
        if name not in self._found:
            self._found[name] = compute(self.draft.scenario)
        return cast(T, self._found[name])
