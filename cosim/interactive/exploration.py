"""A scenario as the page draws it: one run with its events, errors and key numbers, or many runs.

An explored run is exact, in continuous time, where the exact simulation covers the scenario. It
takes some milliseconds. Otherwise the machines run in virtual time, which takes up to half a
second. A run that is recorded, or that is being recorded, is drawn from its record.

:class:`Ensemble` has the bands that contain most of many exact runs over time; each run has its own
plant, initial state and losses.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.summary.loop_summary import summarise_loop
from cosim.record.align import aligned_parts
from cosim.record.decimation import decimate_all
from cosim.record.run_record import RunRecord
from cosim.simulation.continuous import ContinuousRun, LoopState, TooManyEventsError, run_continuous
from cosim.simulation.exact_simulation import (
    DIVERGED,
    OK,
    Events,
    ExactSimulation,
    Population,
    Setting,
    left_out,
    run_with_events,
    setting_of,
)
from cosim.simulation.virtual_time import simulate
from cosim.studies.campaign.random_draws import box_of
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, Vector
from noack.core.number_format import number
from noack.protocol.record_tables import CONTROLLER_DELIVERY
from noack.runtime.life_cycle import HORIZON
from noack.scenario.resolution import loop_of, policy_of, resolve
from noack.scenario.scenario import Scenario
from noack.trigger_policies.trigger_rule import TriggerRule

POINTS = 400
"""Number of evenly spaced times; each event adds the times just before and after it."""
_MOST_EVENT_POINTS = 600
"""With more events, only the evenly spaced times are drawn."""
_MOST_EVENTS = 3000
"""A run with more events is drawn up to there, so that dragging stays quick."""
_ACCUMULATION_SHARE = 0.5
"""Inter-event times shrink to 0 if the second half of the events takes less than this share of the
time of the first."""
EXACT, SAMPLED, LIVE, RECORDED = "exact", "sampled", "live", "recorded"
DRAWS = 200
"""Runs of an ensemble."""
LOW, HIGH = 0.05, 0.95
"""Quantiles at the edges of a band."""
_BAND_POINTS = 121
"""Times at which the bands over the draws are computed."""
_MOST_DRAW_EVENTS = 20_000
"""A draw with more events than these is given up."""


class Fact(NamedTuple):
    """A key number, or what else is known of a run, in words."""

    label: str
    value: str


@dataclass(frozen=True)
class Exploration:
    """A run with N times, n states and k events, of which each has one update."""

    scenario: Scenario
    """The resolved scenario."""
    kind: str
    """EXACT or SAMPLED; LIVE or RECORDED for a run from its record."""
    t_s: Vector
    """Times in ascending order, (N,); an event's time occurs twice, before and after its reset."""
    x: Matrix
    """Plant, (N, n)."""
    x_s: Matrix
    """The sensor's model, (N, n)."""
    x_c: Matrix
    """The controller's model, (N, n)."""
    e_s_norm: Vector
    """‖x_s − x‖ in the trigger's norm, (N,)."""
    e_c_norm: Vector
    """‖x_c − x‖ in the trigger's norm, (N,)."""
    threshold: Vector | None
    """The trigger's threshold, (N,); None for triggers whose threshold is no function of time."""
    event_s: Vector
    """Times of the events, (k,)."""
    delivered: NDArray[np.bool_]
    """Whether each update was delivered, (k,)."""
    diverged_at_s: float | None
    cut_reason: str = ""
    """In words, why the run is drawn until its last event only; empty if it is drawn whole."""

    @cached_property
    def numbers(self) -> tuple[Fact, ...]:
        """The key numbers of the run."""
        events, lost = len(self.event_s), self.lost
        share = f" ({100 * lost / events:.0f} %)" if events else ""
        ending = self.cut_reason or "reached the horizon"
        if self.diverged_at_s is not None:
            ending = f"diverged at {number(self.diverged_at_s, 4)} s"
        elif self.kind in (LIVE, RECORDED):
            ending = f"until {number(float(self.t_s[-1]), 4)} s"
        shortest_s = number(float(np.diff(self.event_s).min()), 4) + " s" if events > 1 else "–"
        return (
            Fact("run", ending),
            Fact("transmissions", str(events)),
            Fact("delivered", str(events - lost)),
            Fact("lost", f"{lost}{share}"),
            Fact("longest loss burst", str(longest_burst(self.delivered))),
            Fact("shortest inter-event time", shortest_s),
            Fact("‖x‖ at the start", number(float(self.x_norm[0]), 4)),
            Fact("‖x‖ at the end", number(float(self.x_norm[-1]), 4)),
        )

    @property
    def lost(self) -> int:
        """Number of transmissions that were not delivered."""
        return int(np.sum(~self.delivered))

    @cached_property
    def x_norm(self) -> Vector:
        """‖x‖, (N,)."""
        norms: Vector = np.linalg.norm(self.x, axis=1)
        return norms

    @property
    def labelled_norm(self) -> tuple[str, Vector]:
        """‖x‖, (N,), at a set point ‖x − x_r‖; with its name."""
        setpoint = loop_of(self.scenario).setpoint
        if setpoint is None:
            return "‖x‖", self.x_norm
        return "‖x − x_r‖", np.linalg.norm(self.x - setpoint, axis=1)

    @cached_property
    def controller_has_state(self) -> NDArray[np.bool_]:
        """Whether the controller has a state: not before its first update, (N,)."""
        if self.scenario.network.initial_sync == "known_state":
            return np.ones(len(self.t_s), np.bool_)
        first_s = self.event_s[self.delivered].min(initial=np.inf)
        if not np.isfinite(first_s):
            return np.zeros(len(self.t_s), np.bool_)
        indices = np.flatnonzero(self.t_s == first_s)
        # If the time of the event occurs twice, it is first the time before the reset.
        start = int(indices[min(1, len(indices) - 1)]) if len(indices) else int(np.sum(self.t_s < first_s))
        known: NDArray[np.bool_] = np.arange(len(self.t_s)) >= start
        return known

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the n states."""
        return loop_of(self.scenario).state_names


def why_not_exact(scenario: Scenario) -> str | None:
    """Return why the exact simulation does not cover a scenario; None if it does."""
    try:
        scenario.coverage.require_unchanging()
        scenario.coverage.require_exact()
    except CallerError as error:
        return str(error)
    kinds = left_out(scenario.network.link)
    return f"network.impairments: {kinds}: the exact simulation has no delay" if kinds else None


def explore(scenario: Scenario) -> Exploration:
    """Run a scenario exactly, for 3000 events at most.

    Raises:
        CallerError: exact simulation does not cover the scenario.
    """
    resolved = resolve(scenario)
    try:
        return _from_exact_run(run_continuous(resolved, _MOST_EVENTS), resolved, "")
    except TooManyEventsError as error:
        if error.run is None or error.run.reached_s <= 0:
            raise
        return _from_exact_run(error.run, resolved, _cut_reason(error.run))


def _cut_reason(run: ContinuousRun) -> str:
    extent = f"{len(run.event_s)} events until {number(run.reached_s, 3)} s"
    first_s = run.event_s[len(run.event_s) // 2]
    second_s = run.reached_s - first_s
    if second_s > _ACCUMULATION_SHARE * first_s:
        return f"{extent}; the rest is not drawn"
    accumulation = f"{extent}, half of them in the last {number(second_s, 2)} s"
    return f"Zeno-like behaviour: inter-event times shrink to 0 ({accumulation})"


@np.errstate(all="ignore")  # a run may diverge
def _from_exact_run(run: ContinuousRun, resolved: Scenario, cut_reason: str) -> Exploration:
    samples = run.at(np.linspace(0.0, run.reached_s, POINTS))
    parts = [(samples.t_s, samples.x, samples.e_s, samples.e_c)]
    if 0 < len(run.before) <= _MOST_EVENT_POINTS:  # before, after, then the even times
        parts = [_stack(run.before), _stack(run.after), *parts]
    t_s, x, e_s, e_c = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(t_s, kind="stable")
    t_s, x, e_s, e_c = t_s[order], x[order], e_s[order], e_c[order]
    divergence = run.divergence(samples, resolved)
    return Exploration(
        scenario=resolved,
        kind=EXACT,
        t_s=t_s,
        x=x,
        x_s=x + e_s,
        x_c=x + e_c,
        e_s_norm=run.system.norms(e_s),
        e_c_norm=run.system.norms(e_c),
        threshold=threshold_at(resolved, t_s),
        event_s=run.event_s,
        delivered=run.delivered,
        diverged_at_s=divergence and divergence.at_s,
        cut_reason=cut_reason,
    )


def _stack(states: tuple[LoopState, ...]) -> tuple[Vector, Matrix, Matrix, Matrix]:
    t_s, x, e_s, e_c = zip(*states, strict=True)
    return np.array(t_s), np.array(x), np.array(e_s), np.array(e_c)


def threshold_at(resolved: Scenario, t_s: Vector) -> Vector | None:
    """Return the trigger's threshold at times (k,), if it is a function of time."""
    trigger = policy_of(resolved)
    if not (isinstance(trigger, TriggerRule) and trigger.is_decaying):
        return None
    level: Vector = trigger.level * np.exp(-trigger.rate_per_s * t_s)
    return np.maximum(level, trigger.floor)


def longest_burst(delivered: NDArray[np.bool_]) -> int:
    """Return the largest number of consecutive updates that were not delivered."""
    ends = np.flatnonzero(np.concatenate([[True], delivered, [True]]))
    return int(np.diff(ends).max()) - 1


_COLUMNS = 600
"""Width of the drawn figure; no peak is lost at this width."""


def explore_or_simulate(scenario: Scenario) -> Exploration:
    """Run a scenario exactly if the exact simulation covers it, else in virtual time.

    Raises:
        NoackError: the scenario is wrong, or has several loops.
    """
    return explore(scenario) if why_not_exact(scenario) is None else simulate_sampled(scenario)


def simulate_sampled(scenario: Scenario) -> Exploration:
    """Run a scenario in virtual time.

    Raises:
        NoackError: the scenario is wrong, or has several loops.
    """
    record = simulate(resolve(scenario))
    return from_record(record, SAMPLED, summarise_loop(record, 0, HORIZON).diverged_at_s)


@np.errstate(all="ignore")  # a run may diverge
def from_record(record: RunRecord, kind: str, diverged_at_s: float | None = None) -> Exploration:
    """Return the run of a loop's record, which may still grow; its samples are decimated."""
    resolved, parts = record.scenario, []
    columns = _COLUMNS if record.is_short else max(record.slice_columns // 10, 1)
    for part in aligned_parts(record):
        run, known = part.aligned, part.aligned.since_delivery(resolved)
        x_c = np.where(known[:, None], run.x_c, np.nan)
        norms = (run.e_s_norm, np.where(known, run.e_c_norm, np.nan), run.threshold)
        curves = np.column_stack([run.t_ns / NS_PER_S, run.x, run.x_s, x_c, *norms])
        parts.append(curves[decimate_all(curves[:, 0], curves[:, 1:], columns)])
    curves, n = np.concatenate(parts), record.loop.n
    t_s, x, x_s, x_c, sizes = np.split(curves, np.cumsum([1, n, n, n]), axis=1)
    events, is_decaying = record.events(), threshold_at(resolved, t_s[:1, 0]) is not None
    return Exploration(
        scenario=resolved,
        kind=kind,
        t_s=t_s[:, 0],
        x=x,
        x_s=x_s,
        x_c=x_c,
        e_s_norm=sizes[:, 0],
        e_c_norm=sizes[:, 1],
        threshold=sizes[:, 2] if is_decaying else None,
        event_s=np.asarray(events["t_ns"] / NS_PER_S),
        delivered=np.isin(events["event"], record.columns(CONTROLLER_DELIVERY, "sequence")["sequence"]),
        diverged_at_s=diverged_at_s,
    )


@dataclass(frozen=True)
class QuantileBand:
    """Quantiles of a quantity over the draws, at the times of the ensemble, (N,) each."""

    low: Vector
    middle: Vector
    high: Vector


@dataclass(frozen=True)
class Ensemble:
    """Bands over draws of the plant, of x(0) and of the losses, at N times."""

    t_s: Vector
    states: tuple[QuantileBand, ...]
    """Of each state."""
    x_norm: QuantileBand
    e_c_norm: QuantileBand
    draws: int
    diverged: int
    """Number of draws that diverged."""
    failed: int
    """Number of draws with too many events, or whose events accumulate; not in the bands."""
    transmissions: tuple[float, float, float]
    """Quantiles LOW, 0.5 and HIGH of the number of transmissions."""

    @property
    def numbers(self) -> tuple[Fact, ...]:
        """The key numbers of the draws."""
        low, middle, high = self.transmissions
        text = f"{low:.0f} to {high:.0f}, median {middle:.0f}" if math.isfinite(low) else "–"
        left_out = Fact("draws with Zeno-like behaviour, not in the bands", f"{self.failed}")
        return (
            Fact(f"transmissions in 90 % of {self.draws - self.failed} draws", text),
            Fact("draws that diverge", f"{self.diverged} of {self.draws}"),
            *([left_out] if self.failed else []),
        )


def explore_ensemble(scenario: Scenario, draws: int = DRAWS) -> Ensemble:
    """Run many draws of a scenario's plant, initial state and losses.

    Raises:
        CallerError: exact simulation does not cover the scenario.
    """
    setting = _ensemble_setting(scenario)
    population = box_of(scenario).population(0, range(draws))
    rows, events = run_with_events(setting, population)
    # Draws with too many events, and undecided ones, are left out.
    indices = np.flatnonzero((rows["status"] == OK) | (rows["status"] == DIVERGED))
    sample = Population(
        population.A[indices], population.B[indices], population.x0[indices], population.loss_seeds[indices]
    )
    t_s = np.linspace(0.0, setting.horizon_s, _BAND_POINTS)
    states = trajectories(setting, sample, [events[i] for i in indices], t_s)
    # Norms, weighted as the trigger weights them, as quantiles over the draws.
    x, e_c = states[:, :, 0], states[:, :, 2]
    weight = setting.trigger.weight
    with np.errstate(all="ignore"):
        weighted = e_c if weight is None else e_c @ weight.T
        x_norm, e_c_norm = (_band(np.linalg.norm(vectors, axis=2)) for vectors in (x, weighted))
    transmissions = rows["transmissions"][indices]
    low, middle, high = np.quantile(transmissions, (LOW, 0.5, HIGH)) if len(transmissions) else (np.nan,) * 3
    return Ensemble(
        t_s=t_s,
        states=tuple(_band(x[:, :, i]) for i in range(x.shape[2])),
        x_norm=x_norm,
        e_c_norm=e_c_norm,
        draws=draws,
        diverged=int((rows["status"] == DIVERGED).sum()),
        failed=draws - len(indices),
        transmissions=(float(low), float(middle), float(high)),
    )


def _ensemble_setting(scenario: Scenario) -> Setting:
    return replace(setting_of(resolve(scenario)), most_events=_MOST_DRAW_EVENTS)


def _band(values: NDArray[np.float64]) -> QuantileBand:
    """Return quantiles over the draws, (k, N) → (N,) each; a diverged draw counts as infinite."""
    if not len(values):
        no_values = np.full(values.shape[1], np.nan)
        return QuantileBand(no_values, no_values, no_values)
    # Nearest ranks: no arithmetic with infinities.
    ascending = np.sort(np.where(np.isnan(values), np.inf, values), axis=0)
    indices = np.rint(np.array([LOW, 0.5, HIGH]) * (len(values) - 1)).astype(np.intp)
    low, middle, high = ascending[indices]
    return QuantileBand(low, middle, high)


@np.errstate(all="ignore")  # draws may diverge
def trajectories(
    setting: Setting, population: Population, events: list[Events], t_s: Vector
) -> NDArray[np.float64]:
    """Return (x, e_s, e_c) of k draws at N ascending times, (k, N, 3, n).

    They are right-continuous: at an event, the state after the reset.
    """
    core = ExactSimulation(
        setting.H,
        setting.K,
        setting.trigger,
        horizon_s=setting.horizon_s,
        known_start=setting.known_start,
    )
    samples = []
    for A, B, x0, run_events in zip(*population[:3], events, strict=True):
        zero = np.zeros_like(x0)
        start = [x0, zero, zero if setting.known_start else -x0]
        resets = run_events.states.copy()
        resets[:, 1] = 0.0
        resets[run_events.delivered, 2] = 0.0
        times_s, states = np.append(0.0, run_events.event_s), np.concatenate([[start], resets])
        samples.append(core.sample(A, B, times_s, states, t_s))
    return np.array(samples).reshape(-1, len(t_s), 3, len(setting.H))
