"""Many runs of one scenario: bands that contain most of them, over time.

All runs are exact; each has its own plant, initial state and losses.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cosim.simulation.exact_simulation import (
    DIVERGED,
    OK,
    Events,
    ExactSimulation,
    Population,
    Setting,
    run_with_events,
    setting_of,
)
from cosim.studies.campaign.random_draws import box_of
from noack.core.linear_systems import Vector
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario

DRAWS = 200
LOW, HIGH = 0.05, 0.95
"""Quantiles at the edges of a band."""
_POINTS = 121
_MOST_EVENTS = 20_000


@dataclass(frozen=True)
class Band:
    """Quantiles of a quantity over the draws, at the times of the ensemble, (N,) each."""

    low: Vector
    middle: Vector
    high: Vector


@dataclass(frozen=True)
class Ensemble:
    """Bands over draws of the plant, of x(0) and of the losses, at N times."""

    t_s: Vector
    states: tuple[Band, ...]
    """Of each state."""
    x_norm: Band
    e_c_norm: Band
    draws: int
    diverged: int
    """Number of draws that diverged."""
    failed: int
    """Number of draws with too many events, or whose events accumulate; not in the bands."""
    transmissions: tuple[float, float, float]
    """Quantiles LOW, 0.5 and HIGH of the number of transmissions."""

    @property
    def numbers(self) -> tuple[tuple[str, str], ...]:
        """Key numbers: label and value."""
        low, middle, high = self.transmissions
        sent = f"{low:.0f} to {high:.0f}, median {middle:.0f}" if math.isfinite(low) else "–"
        left_out = (("draws with Zeno-like behaviour, not in the bands", f"{self.failed}"),)
        return (
            (f"transmissions in 90 % of {self.draws} draws", sent),
            ("draws that diverge", f"{self.diverged} of {self.draws}"),
            *(left_out if self.failed else ()),
        )


def explore_ensemble(scenario: Scenario, draws: int = DRAWS) -> Ensemble:
    """Run many draws of a scenario's plant, initial state and losses.

    Raises:
        CallerError: exact simulation does not cover the scenario.
    """
    setting = _setting(scenario)
    population = box_of(scenario).population(0, range(draws))
    rows, events = run_with_events(setting, population)
    used = np.flatnonzero((rows["status"] == OK) | (rows["status"] == DIVERGED))
    chosen = Population(
        population.A[used], population.B[used], population.x0[used], population.loss_seeds[used]
    )
    t_s = np.linspace(0.0, setting.horizon_s, _POINTS)
    states = trajectories(setting, chosen, [events[i] for i in used], t_s)
    x, e_c = states[:, :, 0], states[:, :, 2]
    weight = setting.trigger.weight
    with np.errstate(all="ignore"):
        weighted = e_c if weight is None else e_c @ weight.T
        x_norm, e_c_norm = (_band(np.linalg.norm(one, axis=2)) for one in (x, weighted))
    sent = rows["transmissions"][used]
    low, middle, high = np.quantile(sent, (LOW, 0.5, HIGH)) if len(sent) else (np.nan,) * 3
    return Ensemble(
        t_s,
        tuple(_band(x[:, :, i]) for i in range(x.shape[2])),
        x_norm,
        e_c_norm,
        draws,
        int((rows["status"] == DIVERGED).sum()),
        draws - len(used),
        (float(low), float(middle), float(high)),
    )


def _setting(scenario: Scenario) -> Setting:
    return replace(setting_of(resolve(scenario)), most_events=_MOST_EVENTS)


def _band(values: NDArray[np.float64]) -> Band:
    """Return quantiles over the draws, (k, N) → (N,) each; a diverged draw counts as infinite."""
    if not len(values):
        nothing = np.full(values.shape[1], np.nan)
        return Band(nothing, nothing, nothing)
    # Nearest ranks: no arithmetic with infinities.
    ordered = np.sort(np.where(np.isnan(values), np.inf, values), axis=0)
    places = np.rint(np.array([LOW, 0.5, HIGH]) * (len(values) - 1)).astype(np.intp)
    low, middle, high = ordered[places]
    return Band(low, middle, high)


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
    found = []
    for A, B, x0, own in zip(*population[:3], events, strict=True):
        rest = np.zeros_like(x0)
        start = [x0, rest, rest if setting.known_start else -x0]
        after = own.states.copy()
        after[:, 1] = 0.0
        after[own.delivered, 2] = 0.0
        times_s, states = np.append(0.0, own.event_s), np.concatenate([[start], after])
        found.append(core.sample(A, B, times_s, states, t_s))
    return np.array(found).reshape(-1, len(t_s), 3, len(setting.H))
