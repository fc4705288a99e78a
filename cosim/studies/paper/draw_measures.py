"""The measures of one draw: both loops, exact in continuous time, on the same plant."""

import math
from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np

from cosim.simulation.continuous.continuous_loop import continuous_loop_of
from cosim.simulation.continuous.continuous_run import (
    ContinuousRun,
    TooManyEventsError,
    simulate_continuous,
)
from cosim.simulation.continuous.exact_flow import ExactFlow, growth_rate
from cosim.simulation.continuous.network_fates import network_fates
from noack.config.resolution import LoopMatrices, loop_of, resolve
from noack.config.scenario import Scenario
from noack.config.sections.run_sections import SeedsSection
from noack.core.linear_systems import Matrix, Vector, spectral_abscissa

Mode = Literal["model", "zoh"]
MODES: Mapping[Mode, str] = {"model": "MB-ET", "zoh": "ZOH-ET"}
"""The paper's names of the loops."""
STEP_S = 0.01
"""Sampling period of the norms; the loops' fastest mode is slower than 5 /s."""
LEVELS = (0.05, 0.01)
"""Shares of ‖x(0)‖ below which a run counts as settled."""
_MAX_EVENTS = 10_000
_NEVER = math.inf


class Measures(NamedTuple):
    """One loop of one draw. A time is infinite if its event does not happen within the horizon."""

    events: float
    """Number of transmissions; the first is at t = 0."""
    deliveries: float
    settled_5_s: float
    """The last time at which ‖x‖ > 0.05 ‖x(0)‖."""
    settled_1_s: float
    """The last time at which ‖x‖ > 0.01 ‖x(0)‖."""
    gap_min_s: float
    """Shortest inter-event time."""
    gap_median_s: float
    """Median inter-event time: the paper's broadcasting intervals."""
    reception_median_s: float
    """Median time between deliveries: the paper's receiving intervals."""
    controller_error: float
    """sup ‖e_c‖ e^{αt}/β: the controller's largest error, in thresholds."""
    final_norm: float
    """‖x‖ at the horizon."""
    peak: float
    """sup ‖x‖ / ‖x(0)‖."""
    envelope: float
    """sup ‖x‖ e^{αt}."""
    growing: float
    """Number of deliveries at which ‖x‖ is larger than at the delivery before."""


class Draw(NamedTuple):
    """Both loops of one draw, and their common quantities."""

    start_norm: float
    """‖x(0)‖."""
    fastest_open: float
    """Largest real part of A's eigenvalues, per second."""
    slowest_closed: float
    """Largest real part of the eigenvalues of A + BK, per second."""
    ideal_settled_5_s: float
    """Like ``settled_5_s``, for u = K x without a network."""
    ideal_settled_1_s: float
    model: Measures
    zoh: Measures


def resolved_draw(scenario: Scenario, draw: int, mode: Mode) -> Scenario:
    """Return a resolved draw of a scenario; its number is the seed of every random stream."""
    seeds = SeedsSection(plant=draw, initial_state=draw, loss=draw)
    return resolve(scenario.model_copy(update={"mode": mode, "seeds": seeds}))


def measure_draw(scenario: Scenario, draw: int) -> Draw:
    """Simulate both loops of a draw and measure them.

    Args:
        scenario: of a variation; its seeds and mode are replaced.
        draw: number of the draw.
    """
    resolved = {mode: resolved_draw(scenario, draw, mode) for mode in MODES}
    loop = loop_of(resolved["model"])
    closed = loop.A + loop.B @ loop.K
    ideal = _ideal_norms(closed, loop.x0, scenario.horizon_s)
    settled = [_settling_s(*ideal, level * ideal[1][0]) for level in LEVELS]
    measures = {mode: _measure(resolved[mode]) for mode in MODES}
    return Draw(
        float(np.linalg.norm(loop.x0)),
        float(open_loop_eigenvalues(loop).real.max()),
        spectral_abscissa(closed),
        settled[0],
        settled[1],
        **measures,
    )


def open_loop_eigenvalues(loop: LoopMatrices) -> Vector:
    """Return the eigenvalues of A, (n,); eigenvalues that are 0 up to rounding are set to 0.

    A defective double eigenvalue splits by about the square root of the rounding error.
    """
    eigenvalues = np.linalg.eigvals(loop.A)
    tolerance = math.sqrt(np.finfo(float).eps) * max(float(np.linalg.norm(loop.A, 2)), 1.0)
    return np.where(np.abs(eigenvalues) < tolerance, 0.0, eigenvalues)


def simulate_draw(resolved: Scenario, max_events: int = _MAX_EVENTS) -> ContinuousRun:
    """Simulate a resolved draw in the paper's own setting: continuous trigger, no delay.

    Raises:
        TooManyEventsError: the events accumulate.
    """
    return simulate_continuous(
        continuous_loop_of(resolved),
        horizon_s=resolved.horizon_s,
        delivered=network_fates(resolved),
        known_start=resolved.network.initial_sync == "known_state",
        max_events=max_events,
    )


def _measure(resolved: Scenario) -> Measures:
    try:
        run = simulate_draw(resolved)
    except TooManyEventsError:
        return Measures(*[_NEVER] * len(Measures._fields))
    loop, trigger = run.system.loop, run.system.decaying
    t_s = _grid(run.reached_s)
    samples = run.at(t_s)
    norms = np.linalg.norm(samples.x, axis=1)
    growth = np.exp(trigger.alpha_per_s * t_s)
    # e_c jumps at a delivery, so its largest value may come just before. Before event 0 there is no
    # x_c.
    before = np.array([state.e_c for state in run.before[1:]]).reshape(-1, loop.n)
    at_events = run.system.norms(before) * np.exp(trigger.alpha_per_s * run.event_s[1:])
    between = run.e_c_norm(samples) * growth
    largest = max(float(between.max()), float(at_events.max(initial=0.0)))
    gaps_s = np.diff(run.event_s)
    arrivals_s = run.event_s[run.delivered]
    states = np.array([state.x for state in run.before])[run.delivered]
    arrival_norms = np.linalg.norm(states, axis=1)
    finished = run.diverged_at_s is None
    return Measures(
        len(run.event_s),
        int(run.delivered.sum()),
        _settling_s(t_s, norms, LEVELS[0] * norms[0]) if finished else _NEVER,
        _settling_s(t_s, norms, LEVELS[1] * norms[0]) if finished else _NEVER,
        float(gaps_s.min(initial=_NEVER)),
        _median(gaps_s),
        _median(np.diff(arrivals_s)),
        largest / trigger.beta,
        float(norms[-1]) if finished else _NEVER,
        float(norms.max() / norms[0]),
        float((norms * growth).max()),
        int((np.diff(arrival_norms) > 0).sum()),
    )


def _grid(until_s: float) -> Vector:
    return np.linspace(0.0, until_s, max(round(until_s / STEP_S), 1) + 1)


def _ideal_norms(closed: Matrix, x0: Vector, horizon_s: float) -> tuple[Vector, Vector]:
    """Return times and ‖x‖ of dx/dt = (A + BK) x."""
    t_s = _grid(horizon_s)
    flow = ExactFlow(closed, 1.0 / growth_rate(closed))
    return t_s, np.asarray(np.linalg.norm(flow.sample(x0, t_s), axis=1))


def _settling_s(t_s: Vector, norms: Vector, level: float) -> float:
    """Return the last time with ``norms`` above ``level``; infinite if it is above at the end."""
    above = np.flatnonzero(norms > level)
    if not len(above):
        return 0.0
    last = int(above[-1])
    if last == len(norms) - 1:
        return _NEVER
    # Assumption: between two samples the norm falls exponentially.
    share = math.log(norms[last] / level) / math.log(norms[last] / norms[last + 1])
    return float(t_s[last] + share * (t_s[last + 1] - t_s[last]))


def _median(values: Vector) -> float:
    return float(np.median(values)) if len(values) else _NEVER
