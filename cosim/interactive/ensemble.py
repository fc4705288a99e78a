"""Many runs of one scenario: bands that contain most of them, over time.

The events are those of exact runs. Between them the state z = (x, e_s, e_c) follows
dz/dt = G z (:mod:`cosim.simulation.continuous`), with a matrix G for each draw,
because each draw has its own plant. All draws advance together on a grid of times.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cosim.simulation.batch import (
    Events,
    Population,
    Setting,
    run_with_events,
    setting_of,
)
from cosim.simulation.exact_simulation import DIVERGED, OK
from cosim.studies.campaign.random_draws import box_of
from noack.config.resolution import resolve
from noack.config.scenario import Scenario
from noack.core.linear_systems import Matrix, Vector

DRAWS = 200
LOW, HIGH = 0.05, 0.95
"""Quantiles at the edges of a band."""
_POINTS = 121
_DEGREE = 14
"""Of the Taylor polynomial; with ‖G‖ dt ≤ 1 it leaves out less than 1e-12."""
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
        left_out = (("draws whose events accumulate, not in the bands", f"{self.failed}"),)
        return (
            (f"transmissions in 90 % of {self.draws} draws", sent),
            ("draws that diverge", f"{self.diverged} of {self.draws}"),
            *(left_out if self.failed else ()),
        )


def explore_ensemble(scenario: Scenario, draws: int = DRAWS, seed: int = 0) -> Ensemble:
    """Run many draws of a scenario's plant, initial state and losses.

    Raises:
        CallerError: exact simulation does not cover the scenario.
    """
    setting = _setting(scenario)
    population = box_of(scenario).population(seed, range(draws))
    rows, events = run_with_events(setting, population)
    used = np.flatnonzero((rows["status"] == OK) | (rows["status"] == DIVERGED))
    chosen = Population(
        population.A[used], population.B[used], population.x0[used], population.loss_seeds[used]
    )
    t_s = np.linspace(0.0, setting.horizon_s, _POINTS)
    z = trajectories(setting, chosen, [events[i] for i in used], t_s)
    x, _, e_c = np.split(z, 3, axis=2)
    weight = setting.trigger.weight
    with np.errstate(all="ignore"):
        weighted = e_c if weight is None else e_c @ weight.T
        x_norm, e_c_norm = (_band(np.linalg.norm(one, axis=2)) for one in (x, weighted))
    sent = rows["transmissions"][used]
    low, middle, high = np.quantile(sent, (LOW, 0.5, HIGH)) if len(sent) else (np.nan,) * 3
    return Ensemble(
        t_s, tuple(_band(x[:, :, i]) for i in range(x.shape[2])), x_norm, e_c_norm, draws,
        int((rows["status"] == DIVERGED).sum()), draws - len(used),
        (float(low), float(middle), float(high)),
    )  # fmt: skip


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
    """Return z = (x, e_s, e_c) of k draws at N evenly spaced times from 0 on, (k, N, 3n).

    They are right-continuous: at an event, the state after the reset.
    """
    k, n = population.x0.shape
    z = np.zeros((k, 3 * n))
    z[:, :n] = population.x0
    if not setting.known_start:
        z[:, 2 * n :] = -population.x0
    result = np.empty((k, len(t_s), 3 * n))
    flows = _Flows(generators(setting, population), float(t_s[1] - t_s[0]))
    queue = _Queue(events, n)
    result[:, 0] = z = queue.pass_events(flows, z, 0.0, 0.0)
    for j in range(1, len(t_s)):
        due = queue.due(float(t_s[j]))
        ahead = np.einsum("kij,kj->ki", flows.step, z)
        if len(due):
            ahead[due] = queue.pass_events(flows, z, float(t_s[j - 1]), float(t_s[j]))[due]
        result[:, j] = z = ahead
    return result


class _Flows:
    """The flow e^{G t} of each draw, for times up to the width of the grid.

    e^{G t} = T(s) S^j with S = e^{G d}, t = j d + s, ‖G‖ d ≤ 1; S^j from the binary powers of S.
    """

    def __init__(self, G: NDArray[np.float64], width_s: float) -> None:
        self._G = G
        rate_per_s = max((_growth_rate(one) for one in G), default=0.0)
        parts = max(1, math.ceil(width_s * rate_per_s))
        self._cell_s = width_s / parts
        self._powers = [_transitions(G, self._cell_s)]
        while 2 ** len(self._powers) <= parts:
            self._powers.append(self._powers[-1] @ self._powers[-1])
        self.step: NDArray[np.float64] = np.linalg.matrix_power(self._powers[0], parts)
        """e^{G t} at the width of the grid, (k, 3n, 3n)."""

    def advance(self, draws: NDArray[np.intp], z: Matrix, dt_s: Vector) -> Matrix:
        """Return e^{G dt} z of some draws, with a dt for each."""
        cells = (dt_s / self._cell_s).astype(np.int64)
        share, term, total = (dt_s - cells * self._cell_s)[:, None], z, z
        for degree in range(1, _DEGREE + 1):
            term = np.einsum("kij,kj->ki", self._G[draws], term) * (share / degree)
            total = total + term
        for bit, power in enumerate(self._powers):
            with_bit = np.flatnonzero(cells >> bit & 1)
            if len(with_bit):
                total[with_bit] = np.einsum("kij,kj->ki", power[draws[with_bit]], total[with_bit])
        return total


class _Queue:
    """The next event of each draw."""

    def __init__(self, events: list[Events], n: int) -> None:
        most = max((len(one.event_s) for one in events), default=0)
        self._n = n
        self._times = np.full((len(events), most + 1), np.inf)
        self._delivered = np.zeros((len(events), most + 1), np.bool_)
        for row, one in enumerate(events):
            self._times[row, : len(one.event_s)] = one.event_s
            self._delivered[row, : len(one.event_s)] = one.delivered
        self._next = np.zeros(len(events), np.intp)
        self._all = np.arange(len(events))

    def due(self, until_s: float) -> NDArray[np.intp]:
        """Return the draws whose next event is at or before a time."""
        return np.flatnonzero(self._times[self._all, self._next] <= until_s)

    def pass_events(self, flows: _Flows, z: Matrix, from_s: float, until_s: float) -> Matrix:
        """Return the states at ``until_s`` of the draws with events until then; others as given."""
        z, at_s, n = z.copy(), np.full(len(z), from_s), self._n
        moved = due = self.due(until_s)
        while len(due):
            event_s = self._times[due, self._next[due]]
            after = flows.advance(due, z[due], event_s - at_s[due])
            after[:, n : 2 * n] = 0.0
            after[self._delivered[due, self._next[due]], 2 * n :] = 0.0
            z[due], at_s[due] = after, event_s
            self._next[due] += 1
            due = self.due(until_s)
        z[moved] = flows.advance(moved, z[moved], until_s - at_s[moved])
        return z


def generators(setting: Setting, population: Population) -> NDArray[np.float64]:
    """Return G of each draw, (k, 3n, 3n), per second."""
    A, B, H = population.A, population.B, setting.H
    BK = B @ setting.K
    closed, none = A + BK, np.zeros_like(A)
    E, model = closed - H, np.broadcast_to(H, A.shape)
    rows = ([closed, none, BK], [-E, model, -BK], [-E, none, H - BK])
    return np.concatenate([np.concatenate(row, axis=2) for row in rows], axis=1)


def _growth_rate(generator: Matrix) -> float:
    """Return η with ‖G^k‖₂ ≤ η^k for all k ≥ 12, per second (Al-Mohy & Higham, 2009)."""
    fourth = np.linalg.matrix_power(generator, 4)
    # The Frobenius norm bounds the 2-norm from above.
    return float(max(np.linalg.norm(fourth) ** 0.25, np.linalg.norm(fourth @ generator) ** 0.2))


def _transitions(G: NDArray[np.float64], dt_s: float) -> NDArray[np.float64]:
    """Return e^{G dt} of each draw."""
    term = np.broadcast_to(np.eye(G.shape[1]), G.shape)
    total = term.copy()
    for degree in range(1, _DEGREE + 1):
        term = term @ G * (dt_s / degree)
        total += term
    return total
