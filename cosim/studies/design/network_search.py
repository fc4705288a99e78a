"""The search for a gain that tolerates the most losses.

The sensor is time-triggered. A loop *tolerates N losses in a row* if every loss pattern with at most N
consecutive losses (and the network's further constraints) is proven stable.

1. The given loop is examined; regulators (LQR) over a grid of weights are the further starts.
2. A quick lower bound of the growth (``quick_estimate.py``) excludes loops that cannot tolerate a
   number. Of the others the margin is computed: its certified upper bound must be below 1.
3. From the best starts, the lower bound for the next number is minimised over K without gradients
   (Nelder and Mead). As soon as it is below 1, the margin of the loop is computed, and the search
   aims higher.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from cosim.studies.design.design_space import round_gain, weighed_gain
from cosim.studies.design.quick_estimate import PatternGraph, QuickLoop
from netem.core.errors import CallerError
from netem.guarantee.loss_guarantee import LossGuarantee
from noack.core.linear_systems import Matrix, Vector, spectral_abscissa
from noack.core.progress import Progress, no_progress
from noack.proof.search.growth import list_bursts
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.settings.values import MatrixRows, rows_of
from noack.theory.coverage import require_exact
from noack.theory.time_triggered.scenario_times import without_timeout
from noack.theory.witnesses.loss_margin import LossMargin, Stability
from noack.trigger_policies.periodic_trigger import PeriodicSettings

COSTS_OF_INPUT = np.geomspace(1e-3, 1e3, 13)
"""Factors of R of the regulators that the search begins with."""
MOST_MANSD = 15
"""Largest number of losses in a row that is examined by default."""
_SLACK = 0.002
"""The search wants log growth below −_SLACK: the margin of a loop at the limit takes long."""
_STARTS = 4
"""Best candidates from which the search descends."""
_FIRST_STEP, _TOLERANCE = 0.3, 1e-5
"""Size of the first simplex, in shares of the gain's entries; difference of values at which it ends."""
_UNSTABLE = 1e3
"""Scale of the objective of loops that are not stable; those of others are smaller."""


@dataclass(frozen=True)
class DesignRequest:
    """What a design is asked for."""

    most: int = MOST_MANSD
    """Largest number of losses in a row to examine."""
    period_s: float | None = None
    """Time between updates; None: the scenario's."""
    cost: float = 1.2
    """Largest cost without losses, as a multiple of that of the given loop."""
    weights: tuple[Matrix, Matrix] | None = None
    """Q and R of the cost; None: identities."""
    effort: int = 1500
    """Number of loops that the search without gradients may try."""


class CertifiedLoop(NamedTuple):
    """A gain with the most losses in a row that the loop is proven to tolerate."""

    K: MatrixRows
    mansd: int
    """At most this number of packets is lost in a row; −1: nothing is proven, even without losses."""
    stability: Stability | None
    """The certificate for it; None: there is none."""
    beyond: Stability | None
    """What is known with one more loss in a row; None: it was not examined."""
    cost: float
    """Without losses; infinite: the loop is unstable then."""


def time_triggered(scenario: Scenario, period_s: float | None) -> Scenario:
    """Return a scenario with an update every period.

    Raises:
        CallerError: no period is given, neither here nor in the scenario.
    """
    present = scenario.trigger
    if period_s is None:
        if isinstance(present, PeriodicSettings):
            return scenario
        raise CallerError(
            f'--period: trigger.policy = "{present.policy}" has no period; give the time between '
            "two updates in seconds, e.g. --period 0.5"
        )
    trigger = PeriodicSettings(policy="periodic", period_s=period_s, weight=present.weight)
    return scenario.model_copy(update={"trigger": trigger})


def _require_possible(scenario: Scenario, request: DesignRequest) -> None:
    """Raise CallerError unless a scenario can be searched with this request."""
    if not scenario.coverage.is_linear:
        raise CallerError(
            f'plant.system.kind = "{scenario.plant.system.kind}": the plant is not given by matrices A and '
            "B; --set 'plant.system={kind=\"linear\"}' designs for its model"
        )
    require_exact(without_timeout(scenario))
    scenario.coverage.require_unchanging()
    if not request.cost >= 1:
        raise CallerError(f"--cost: 1 or more times that of the given loop, not {request.cost:g}")


class NetworkSearch:
    """All that is known about the loops of a scenario with other gains."""

    def __init__(self, scenario: Scenario, request: DesignRequest) -> None:
        _require_possible(scenario, request)
        self.request, self.scenario = request, time_triggered(scenario, request.period_s)
        resolved = resolve(self.scenario)
        self.plant, margin = loop_of(resolved), LossMargin(resolved)
        self.measurements, self._loop = margin.longest, margin.bursts_loop
        """From an update to the next one."""
        self._times = self._loop.times
        self._latest = [max(self._loop.times.arrivals(slot)) for slot in range(self._times.slots)]
        self.period_s = margin.seconds(margin.longest)
        if margin.shortest < margin.longest:
            raise CallerError(
                f'trigger.policy = "{scenario.trigger.policy}": the search is for periodic '
                "updates; give their --period"
            )
        # More losses in a row than the constraints allow mean nothing.
        burst = resolved.network.guarantee.uncapped.longest_burst
        self.most = request.most if burst is None else min(request.most, burst)
        n, m = self.plant.n, self.plant.m
        self.weights = request.weights or (np.eye(n), np.eye(m))
        weighed_gain(self.plant.A_model, self.plant.B_model, *self.weights)  # raises if there is none
        self.given_gain = rows_of(self.plant.K)
        self.cost_limit = request.cost * self.cost(self.given_gain)
        """Largest cost; infinite if the given loop is unstable without losses."""
        self.tried = self.examined = 0
        self._graph = cache(self._new_graph)

    def guarantee(self, mansd: int) -> LossGuarantee:
        """Return the guarantee with another limit, and the network's further constraints."""
        return self.scenario.network.guarantee.capped(mansd)

    def quick_loop(self, K: MatrixRows) -> QuickLoop:
        """Return the loop of a gain in double precision."""
        plant, gain = self.plant, np.array(K)
        H = plant.A_model + plant.B_model @ gain
        if self.scenario.mode == "zoh":
            H = np.zeros_like(H)
        return QuickLoop((plant.A, plant.B, gain, H), self._times, self.weights, self._latest)

    def _new_graph(self, mansd: int) -> PatternGraph:
        """Return the loss patterns of a limit; the graph keeps the worst patterns that it has met."""
        return PatternGraph(list_bursts(self.guarantee(mansd), self._loop.times, self._loop.between))

    def growth(self, K: MatrixRows, mansd: int) -> float:
        """Return a lower bound of the logarithm of the growth per period."""
        self.tried += 1
        graph = self._graph(mansd)
        return graph.growth(self.quick_loop(K).maps(graph.bursts))

    def cost(self, K: MatrixRows) -> float:
        """Return the cost without losses."""
        return self.quick_loop(K).cost(self.plant.x0)

    def excess(self, K: MatrixRows, mansd: int) -> float:
        """Return what is minimised: the growth, and by how much the cost exceeds its limit."""
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            plant = self.plant
            rate_per_s = spectral_abscissa(plant.A_model + plant.B_model @ np.array(K))
            if not rate_per_s < 0:
                return _UNSTABLE + min(rate_per_s, _UNSTABLE)
            cost, growth = self.cost(K), self.growth(K, mansd)
            if not math.isfinite(cost) or not math.isfinite(growth):
                return _UNSTABLE / 2 + min(max(growth, 0.0), _UNSTABLE / 4)
        if cost <= self.cost_limit:
            return growth
        return max(growth, -_SLACK) + _SLACK + math.log(cost / self.cost_limit)

    def largest_possible(self, K: MatrixRows, mansd: int) -> tuple[int, float]:
        """Return the largest limit from the given one on that is not excluded, and the excess of the next."""
        while mansd <= self.most:
            if (excess := self.excess(K, mansd)) >= -_SLACK:
                return mansd - 1, excess
            mansd += 1
        return self.most, -math.inf

    def scenario_of(self, K: MatrixRows, mansd: int) -> Scenario:
        """Return the scenario of a gain with a limit of the losses in a row, not resolved."""
        scenario = self.scenario
        model = scenario.model.model_copy(update={"gain": K})
        network = scenario.network.model_copy(update={"mansd": max(mansd, 0)})
        return scenario.model_copy(update={"model": model, "network": network})

    def stability(self, K: MatrixRows, mansd: int) -> Stability:
        """Return the certified bounds of a loop with a limit of the losses in a row."""
        self.examined += 1
        margin = LossMargin(resolve(self.scenario_of(K, mansd)))
        stability = margin.first_bounds()
        return margin.coarse_bounds() if stability.verdict == "undecided" else stability

    def largest_certified(self, K: MatrixRows, most: int, least: int) -> int:
        """Return the largest certified limit from ``most`` down to above ``least``; else ``least``."""
        limits = range(most, least, -1)
        return next((mansd for mansd in limits if self.stability(K, mansd).verdict == "stable"), least)

    def certify(self, K: MatrixRows, most: int) -> CertifiedLoop:
        """Return a loop with refined bounds for the largest certified limit and for the next one."""
        mansd, stability, beyond = most, None, None
        while mansd >= 0 and (stability := self.stability(K, mansd)).verdict != "stable":
            mansd, stability = mansd - 1, None
        while mansd < self.most:
            beyond = self.stability(K, mansd + 1)
            if beyond.verdict != "stable":
                break
            mansd, stability, beyond = mansd + 1, beyond, None
        return CertifiedLoop(K, mansd, stability, beyond, self.cost(K))

    def run(self, progress: Progress = no_progress) -> tuple[CertifiedLoop, CertifiedLoop]:
        """Return what the given loop is proven to tolerate, and the best loop found."""
        # The given loop, which the others must exceed.
        given = self.certify(self.given_gain, self.largest_possible(self.given_gain, 0)[0])
        self.tried, best, best_mansd = 0, given.K, given.mansd
        progress(0.1)
        # Rank the starts by the limit that is not excluded, then by the excess of the next one.
        plant, (Q, R) = self.plant, self.weights
        starts = [round_gain(weighed_gain(plant.A_model, plant.B_model, Q, c * R)) for c in COSTS_OF_INPUT]
        ranked = sorted(
            ((*self.largest_possible(K, max(best_mansd, 0)), K) for K in [given.K, *starts]),
            key=lambda entry: (-entry[0], entry[1]),
        )[:_STARTS]
        for most, _, K in ranked:
            if (mansd := self.largest_certified(K, most, best_mansd)) > best_mansd:
                best, best_mansd = K, mansd
        progress(0.3)
        # The gains that are improved, each with an equal share of the effort.
        pool = list(dict.fromkeys([best, *(K for _, _, K in ranked)]))
        share = max(self.request.effort // len(pool), 1)
        for number, K in enumerate(pool):
            # Improve until the next limit is not excluded and certified, then aim at the one after it.
            tries_left = share
            while tries_left > 0 and best_mansd < self.most:
                tried_before = self.tried
                better = self._improve(K, best_mansd + 1, tries_left)
                tries_left -= max(self.tried - tried_before, 1)
                if better is None:
                    break
                K = better
                most, _ = self.largest_possible(K, best_mansd + 1)
                mansd = self.largest_certified(K, max(most, best_mansd + 1), best_mansd)
                if mansd == best_mansd:
                    break
                best, best_mansd = K, mansd
            progress(0.3 + 0.6 * (number + 1) / len(pool))
        return given, given if best == given.K else self.certify(best, best_mansd)

    def _improve(self, start: MatrixRows, mansd: int, most_tries: int) -> MatrixRows | None:
        """Return a gain near ``start`` whose lower bound with a limit is below 1; None: none found.

        It is searched by the method of Nelder and Mead, Computer Journal 7(4), 1965.
        """
        from scipy.optimize import OptimizeResult, minimize  # slow to import

        K = np.array(start)
        units = np.maximum(np.abs(K), 0.1 * np.abs(K).max(axis=1, keepdims=True))

        def gain_at(steps: Vector) -> MatrixRows:
            return round_gain(K + units * steps.reshape(K.shape))

        def excess(steps: Vector) -> float:
            return self.excess(gain_at(steps), mansd)

        def stop_early(intermediate_result: OptimizeResult) -> None:
            if intermediate_result.fun < -_SLACK:
                raise StopIteration  # scipy then returns this point

        simplex = np.vstack([np.zeros(K.size), _FIRST_STEP * np.eye(K.size)])
        result = minimize(
            excess,
            np.zeros(K.size),
            method="Nelder-Mead",
            callback=stop_early,
            options={
                "maxfev": most_tries,
                "adaptive": True,
                "initial_simplex": simplex,
                "fatol": _TOLERANCE,
            },
        )
        return gain_at(result.x) if result.fun < -_SLACK else None
