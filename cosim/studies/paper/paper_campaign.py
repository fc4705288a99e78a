"""The draws of the paper's page: the campaign ``paper`` and its variations, with both loops.

First come the measures of one draw: both loops, exact in continuous time, on the same plant. All
random streams of draw i have the seed i, so ``noack simulate --set seeds...`` repeats it. MB-ET and
ZOH-ET have the same plant, the same initial state and the same stream of losses.
"""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Literal, NamedTuple

import numpy as np

from cosim.shipped_files import find_shipped
from cosim.simulation.continuous import TooManyEventsError, run_continuous
from cosim.studies.campaign.campaign_file import Campaign, load
from cosim.studies.campaign.campaign_grid import grid
from cosim.studies.campaign.campaign_workers import Chunk, Runner
from cosim.studies.campaign.chunk_store import Progress
from noack.config.resolution import loop_of, resolve
from noack.config.run_sections import SeedsSection
from noack.config.scenario import Scenario
from noack.core.linear_systems import Matrix, Vector, spectral_abscissa, transition
from noack.theory.bounds.terms import Constants
from noack.theory.certificates.conditions import ideal_conditions
from noack.theory.certificates.scenario_certificates import certify
from noack.theory.paper.theorems import theorem_2

Mode = Literal["model", "zoh"]
MODES: Mapping[Mode, str] = {"model": "MB-ET", "zoh": "ZOH-ET"}
"""The paper's names of the loops."""
STEP_S = 0.01
"""Sampling period of the norms; the loops' fastest mode is slower than 5 /s."""
LEVELS = (0.05, 0.01)
"""Shares of ‖x(0)‖ below which a run counts as settled."""
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


class Certified(NamedTuple):
    """Certified constants of a draw's MB-ET loop, in the paper's setting."""

    inter_event_s: float
    """δ: a lower bound of the inter-event times."""
    delta: float
    """Δ: ‖e_c‖ ≤ Δβe^{−αt}."""
    state: float
    """X: ‖x‖ ≤ Xe^{−αt}."""


class Printed(NamedTuple):
    """Theorem 2 for a draw's MB-ET loop, with the certified Δ in place of Theorem 1's."""

    inter_event_s: float
    """δ̲ of eq:tau for every t_i."""
    first_s: float
    """eq:tau at t_i = 0."""
    late_s: float
    """eq:tau as t_i → ∞."""
    negative: float
    """1 if F̄ < 0."""


_NOT_APPLICABLE = Printed(0.0, 0.0, 0.0, 0.0)


def resolved_draw(scenario: Scenario, draw: int, mode: Mode) -> Scenario:
    """Return a resolved draw of a scenario; its number is the seed of every random stream."""
    seeds = SeedsSection(plant=draw, initial_state=draw, loss=draw)
    return resolve(scenario.model_copy(update={"mode": mode, "seeds": seeds}))


def measure_draw(scenario: Scenario, draw: int) -> Draw:
    """Simulate both loops of a draw of a variation and measure them."""
    resolved = {mode: resolved_draw(scenario, draw, mode) for mode in MODES}
    loop = loop_of(resolved["model"])
    closed = loop.A + loop.B @ loop.K
    t_s, norms = _ideal_norms(closed, loop.x0, scenario.horizon_s)
    return Draw(
        float(norms[0]),
        float(open_loop_eigenvalues(loop.A).real.max()),
        spectral_abscissa(closed),
        *_settling_times_s(t_s, norms),
        _measure(resolved["model"]),
        _measure(resolved["zoh"]),
    )


def open_loop_eigenvalues(A: Matrix) -> Vector:
    """Return the eigenvalues of A, (n,); eigenvalues that are 0 up to rounding are set to 0.

    A defective double eigenvalue splits by about the square root of the rounding error.
    """
    eigenvalues = np.linalg.eigvals(A)
    tolerance = math.sqrt(np.finfo(float).eps) * max(float(np.linalg.norm(A, 2)), 1.0)
    return np.where(np.abs(eigenvalues) < tolerance, 0.0, eigenvalues)


def certified(scenario: Scenario, draw: int) -> Certified:
    """Return the certificate of a draw; zeros and infinities if there is none."""
    constants = _constants(resolved_draw(scenario, draw, "model"))
    if constants is None:
        return Certified(0.0, math.inf, math.inf)
    return Certified(constants.inter_event_s or 0.0, constants.delta, constants.state)


def printed(scenario: Scenario, draw: int) -> Printed:
    """Return Theorem 2 for a draw; zeros if it does not apply."""
    resolved = resolved_draw(scenario, draw, "model")
    trigger, constants = resolved.decaying, _constants(resolved)
    if constants is None:
        return _NOT_APPLICABLE
    found = theorem_2(loop_of(resolved), trigger.beta, trigger.alpha_per_s, constants.delta)
    if found is None:
        return _NOT_APPLICABLE
    start = found.a_tilde * (found.state_start - found.state_forced)  # F̄
    gap = found.alpha_bar_per_s - trigger.alpha_per_s
    forced = (gap / found.c + found.a_tilde) * found.state_forced  # F
    rate, late = found.a_hat + found.alpha_bar_per_s, forced / (found.a_hat + trigger.alpha_per_s)
    first_s, late_s = (
        math.log1p(trigger.beta / F) / rate if F > 0 else math.inf
        for F in (start / rate + late, late)
    )
    return Printed(found.inter_event_s, first_s, late_s, float(start < 0))


def _constants(resolved: Scenario) -> Constants | None:
    return certify(resolved, ideal_conditions(resolved)).constants


def _measure(resolved: Scenario) -> Measures:
    try:
        run = run_continuous(resolved)
    except TooManyEventsError:
        return Measures(*[_NEVER] * len(Measures._fields))
    loop, trigger = run.system.loop, run.system.decaying
    t_s = _grid(run.reached_s)
    samples = run.at(t_s)
    norms = np.linalg.norm(samples.x, axis=1)
    growth = np.exp(trigger.rate_per_s * t_s)
    # e_c jumps at a delivery, so its largest value may come just before. Before event 0 there is no
    # x_c.
    before = np.array([state.e_c for state in run.before[1:]]).reshape(-1, loop.n)
    at_events = run.system.norms(before) * np.exp(trigger.rate_per_s * run.event_s[1:])
    between = run.e_c_norm(samples) * growth
    gaps_s = np.diff(run.event_s)
    states = np.array([state.x for state in run.before])[run.delivered]
    arrival_norms = np.linalg.norm(states, axis=1)
    return Measures(
        len(run.event_s),
        int(run.delivered.sum()),
        *_settling_times_s(t_s, norms),
        float(gaps_s.min(initial=_NEVER)),
        _median(gaps_s),
        _median(np.diff(run.event_s[run.delivered])),
        max(between.max(), at_events.max(initial=0.0)) / trigger.level,
        float(norms[-1]) if run.diverged_at_s is None else _NEVER,
        float(norms.max() / norms[0]),
        float((norms * growth).max()),
        int((np.diff(arrival_norms) > 0).sum()),
    )


def _grid(until_s: float) -> Vector:
    return np.linspace(0.0, until_s, max(round(until_s / STEP_S), 1) + 1)


def _ideal_norms(closed: Matrix, x0: Vector, horizon_s: float) -> tuple[Vector, Vector]:
    """Return times and ‖x‖ of dx/dt = (A + BK) x."""
    t_s = _grid(horizon_s)
    step, states = transition(closed, round(float(t_s[1]) * 1e9)), np.empty((len(t_s), len(x0)))
    states[0] = x0
    for k in range(1, len(t_s)):
        states[k] = step @ states[k - 1]
    return t_s, np.linalg.norm(states, axis=1)


def _settling_times_s(t_s: Vector, norms: Vector) -> tuple[float, float]:
    five, one = (_settling_s(t_s, norms, level * norms[0]) for level in LEVELS)
    return five, one


def _settling_s(t_s: Vector, norms: Vector, level: float) -> float:
    """Return the last time with ``norms`` above ``level``; infinite if it is above at the end."""
    last = int(np.flatnonzero(norms > level)[-1])
    if last == len(norms) - 1:
        return _NEVER
    # Assumption: between two samples the norm falls exponentially.
    share = math.log(norms[last] / level) / math.log(norms[last] / norms[last + 1])
    return float(t_s[last] + share * (t_s[last + 1] - t_s[last]))


def _median(values: Vector) -> float:
    return float(np.median(values)) if len(values) else _NEVER


BASE, EXACT_MODEL, WIDE_BOX = "base: Bernoulli 0.8", "box × 0: exact model", "box × 5"
OTHER_EXAMPLES = ("nothing lost", WIDE_BOX, EXACT_MODEL)
"""Variations that change the paper's example. The others vary only unspecified settings."""

Table = Literal["printed", "certified", "draws"]

_CHUNK = 10
_VARIED, _PRINTED = 10, 40
"""A variation has one draw per 10 draws of the base. Table ``printed``, the slowest, has one per
40."""
_COMMON = tuple(name for name in Draw._fields if name not in MODES)


def _both_loops(scenario: Scenario, draw: int) -> tuple[float, ...]:
    found = measure_draw(scenario, draw)
    return (*(getattr(found, name) for name in _COMMON), *found.model, *found.zoh)


_ROWS: Mapping[Table, Callable[[Scenario, int], tuple[float, ...]]] = {
    "printed": printed, "certified": certified, "draws": _both_loops
}  # fmt: skip
COLUMNS: Mapping[str, tuple[str, ...]] = {
    "printed": Printed._fields,
    "certified": Certified._fields,
    "draws": (*_COMMON, *(f"{mode}.{name}" for mode in MODES for name in Measures._fields)),
}
"""The columns of each table."""


class EnsemblePart(NamedTuple):
    """A table of a variation, one row per draw, from draw 0 on."""

    table: Table
    variation: str
    draws: int


@dataclass(frozen=True)
class PaperWork:
    """Computes rows of a table for a variation."""

    table: Table
    scenario: Scenario

    def run(self, draws: range) -> Matrix:
        """Compute the rows of the given draws, (draws, columns)."""
        return np.array([_ROWS[self.table](self.scenario, draw) for draw in draws])


@cache
def load_campaign() -> tuple[Campaign, Mapping[str, Scenario]]:
    """Return the shipped campaign ``paper``, and the scenario of each of its variations."""
    path = find_shipped("paper", "campaigns")
    campaign = load(path)
    points = grid(campaign, path)
    return campaign, {point.labels["variation"]: point.scenario for point in points}


def settings_of(draw: int) -> list[str]:
    """Return the settings of a draw of the base, as after ``--set`` on the command line."""
    settings = [f"{key}={json.dumps(value)}" for key, value in load_campaign()[0].settings.items()]
    return [*settings, *(f"seeds.{name}={draw}" for name in ("plant", "initial_state", "loss"))]


def parts(draws: int, variations: tuple[str, ...]) -> list[EnsemblePart]:
    """Return the tables to compute for a base ensemble of this number of draws."""
    varied, few = max(draws // _VARIED, 1), max(draws // _PRINTED, 1)
    return [
        EnsemblePart("printed", BASE, few),
        EnsemblePart("certified", BASE, draws),
        *(EnsemblePart("draws", name, draws if name == BASE else varied) for name in variations),
    ]


def run_parts(
    draws: int, runner: Runner, progress: Progress | None = None
) -> list[tuple[EnsemblePart, Matrix]]:
    """Compute every table for a base ensemble of this number of draws."""
    scenarios = load_campaign()[1]
    wanted = parts(draws, tuple(scenarios))
    works = [PaperWork(part.table, scenarios[part.variation]) for part in wanted]
    chunks = [
        Chunk(i, start, min(start + _CHUNK, part.draws))
        for i, part in enumerate(wanted)
        for start in range(0, part.draws, _CHUNK)
    ]
    found: dict[Chunk, Matrix] = {}
    done, total = 0, sum(part.draws for part in wanted)
    for chunk, rows in runner(works, chunks):
        found[chunk] = rows
        done += len(chunk.draws)
        if progress is not None:
            progress(done, total)
    return [
        (part, np.concatenate([found[chunk] for chunk in chunks if chunk.point == i]))
        for i, part in enumerate(wanted)
    ]
