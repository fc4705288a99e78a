"""The search for a gain and a hold strategy that tolerate the most losses, or the fewest updates.

The sensor is time-triggered. The *requirements* are listed from easy to hard: M = 1, 2, …; m = 0, 1,
… losses in a window; or longer and longer periods. A *level* is the index of a requirement in this
list. A loop meets a requirement if every loss pattern of its guarantee is proven stable.

1. The given loop is examined; regulators (LQR) over a grid of weights are the further starts.
2. A quick lower bound of the growth (``quick_estimate.py``) excludes loops that cannot meet a
   requirement. Of the others the margin is computed: its certified upper bound must be below 1.
3. From the best starts, the lower bound at the next level is minimised over K without gradients
   (Nelder and Mead). As soon as it is below 1, the margin of the loop is computed, and the search
   aims higher.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from cosim.studies.design.design_search import Bounds
from cosim.studies.design.design_space import lqr_gain, round_gain
from cosim.studies.design.hold_strategies import HOLDS, Hold, given_hold
from cosim.studies.design.quick_estimate import PatternGraph, QuickLoop
from cosim.studies.design.simplex_search import nelder_mead, step_sizes
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, Vector, spectral_abscissa
from noack.guarantee.loss_guarantee import LongestBurst, LossGuarantee
from noack.impairments.constraints.at_most import AtMost
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.settings.section import MatrixRows, rows_of
from noack.theory.margins.loss_margin import LossMargin, Stability, capped, list_bursts, uncapped
from noack.theory.margins.scenario_times import without_timeout
from noack.theory.margins.time_triggered_loop import LoopTimes
from noack.trigger_policies.periodic_trigger import PeriodicSettings

Goal = Literal["network", "transmissions"]
Progress = Callable[[float], None]
COSTS_OF_INPUT = np.geomspace(1e-3, 1e3, 13)
"""Factors of R of the regulators that the search begins with."""
_LONGER = 1.02
"""Ratio of successive required periods, where measurements are close enough."""
_MOST_PERIODS = 400
"""Most periods that are tried."""
_MOST_M = 16
"""Largest M that is examined by default."""
_SLACK = 0.002
"""The search wants log growth below −_SLACK: the margin of a loop at the limit takes long."""
_STARTS = 4
"""Best candidates from which the search descends."""
_UNSTABLE = 1e3
"""Scale of the objective of loops that are not stable; those of others are smaller."""


class GainCandidate(NamedTuple):
    """A gain and what the controller does between updates."""

    hold: Hold
    K: MatrixRows


class Requirement(NamedTuple):
    """What a loop must tolerate."""

    name: str
    number: float
    """M, m or the period in seconds."""
    guarantee: LossGuarantee
    period_ns: int
    network: dict[str, object]
    """Settings of the network with this guarantee; empty: the scenario's."""


@dataclass(frozen=True)
class DesignRequest:
    """What a design is asked for."""

    goal: Goal = "network"
    window: int | None = None
    """K of (m, K): maximise m; None: maximise M."""
    most: int | None = None
    """Largest M to examine; None: 16 with periodic updates, else 1,000."""
    period_s: float | None = None
    """Time between updates; None: the scenario's."""
    cost: float = 1.2
    """Largest cost, as a multiple of that of the given loop."""
    transmissions: float = 1.0
    """Most transmissions of a loop with events, as a multiple of those of the given loop."""
    weights: tuple[Matrix, Matrix] | None = None
    """Q and R of the cost; None: identities."""
    bounds: Bounds = field(default_factory=dict)
    """Upper limits of the certified bounds of a loop with events."""
    holds: Sequence[Hold] | None = None
    """Hold strategies; None: all of :data:`HOLDS`, and that of the given loop."""
    effort: int = 1500
    """Number of loops that the search without gradients may try."""


class CertifiedLoop(NamedTuple):
    """A loop with the highest requirement that it is proven to meet."""

    candidate: GainCandidate
    level: int
    """Index of this requirement; −1: none is met."""
    stability: Stability | None
    """The certificate for it; None: there is none."""
    beyond: Stability | None
    """What is known about the next requirement; None: there is none, or its cost is above the limit."""
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


def examined_m(scenario: Scenario, most: int) -> int:
    """Return the largest M to examine; above the bursts that the constraints allow, M means nothing."""
    burst = uncapped(scenario.network.guarantee).longest_burst
    return most if burst is None else min(most, burst + 1)


def list_requirements(scenario: Scenario, request: DesignRequest, margin: LossMargin) -> list[Requirement]:
    """Return what a loop must tolerate, from easy to hard."""
    network, period_ns = scenario.network, margin.longest_ns
    if request.goal == "transmissions":
        return list(_periods(scenario, margin))
    if request.window is not None:
        if not 2 <= request.window <= 64:
            raise CallerError(f"--window: from 2 to 64 updates, not {request.window}")
        requirements = []
        for m in range(request.window):
            rules = (AtMost(losses=m, window=request.window),) if m else ()
            guarantee = LossGuarantee((LongestBurst(m), *(rule.rule for rule in rules)))
            settings: dict[str, object] = {"mansd": m, "constraints": rules}
            name = f"m = {m} of {request.window}"
            requirements.append(Requirement(name, m, guarantee, period_ns, settings))
        return requirements
    return [
        Requirement(f"M = {m}", m, capped(network.guarantee, m - 1), period_ns, {"mansd": m - 1})
        for m in range(1, examined_m(scenario, request.most or _MOST_M) + 1)
    ]


def _periods(scenario: Scenario, margin: LossMargin) -> Iterator[Requirement]:
    step_ns = scenario.timing.measurement_period_ns
    longest = scenario.timing.horizon_ns // step_ns
    steps = max(margin.loop.times.delay_ns // step_ns + 1, margin.longest_ns // step_ns // 16, 1)
    for _ in range(_MOST_PERIODS):
        period_s = steps * step_ns / NS_PER_S
        yield Requirement(f"{period_s:g} s", period_s, margin.guarantee, steps * step_ns, {})
        steps = max(steps + 1, round(steps * _LONGER))
        if steps > longest:
            return


def _require_possible(scenario: Scenario, request: DesignRequest) -> None:
    """Raise CallerError unless a scenario can be searched with this request."""
    if not scenario.coverage.is_linear:
        raise CallerError(
            f'plant.system.kind = "{scenario.plant.system.kind}": the plant is not linear; '
            "--set 'plant.system={kind=\"linear\"}' designs for its model"
        )
    without_timeout(scenario).coverage.require_exact()
    scenario.coverage.require_unchanging()
    if request.bounds:
        raise CallerError("--bound: is for a loop with events, not for periodic updates")
    if request.most is not None and (request.goal == "transmissions" or request.window is not None):
        raise CallerError("--most: is for --for network without --window")
    if not request.cost >= 1:
        raise CallerError(f"--cost: 1 or more times that of the given loop, not {request.cost:g}")


class NetworkSearch:
    """All that is known about the loops of a scenario with other gains."""

    def __init__(self, scenario: Scenario, request: DesignRequest) -> None:
        _require_possible(scenario, request)
        self.request, self.scenario = request, time_triggered(scenario, request.period_s)
        resolved = resolve(self.scenario)
        self.plant, margin = loop_of(resolved), LossMargin(resolved)
        self._times, self._resolved = margin.loop.times, resolved
        self.period_ns = margin.longest_ns
        if margin.shortest_ns < margin.longest_ns:
            raise CallerError(
                f'trigger.policy = "{scenario.trigger.policy}": the search is for periodic '
                "updates; give their --period"
            )
        self.requirements = list_requirements(self.scenario, request, margin)
        n, m = self.plant.n, self.plant.m
        self.weights = request.weights or (np.eye(n), np.eye(m))
        lqr_gain(self.plant.A_model, self.plant.B_model, *self.weights)  # raises if there is none
        self.holds = (
            tuple(itertools.chain(*HOLDS.values())) if request.holds is None else tuple(request.holds)
        )
        self.original = GainCandidate(given_hold(self.scenario), rows_of(self.plant.K))
        base = self.quick_loop(self.original, margin.longest_ns).cost(self.plant.x0)
        self.cost_limit = request.cost * base
        """Largest cost; infinite if the given loop is unstable without losses."""
        self.tried = self.examined = 0
        self.highest_level: dict[Hold, int] = {}
        """By hold strategy: the highest level at which a loop was tried and not excluded."""
        self._graphs: dict[tuple[LossGuarantee, int, Hold, int], PatternGraph] = {}

    def quick_loop(self, candidate: GainCandidate, period_ns: int) -> QuickLoop:
        """Return the loop of a candidate in double precision."""
        plant, K = self.plant, np.array(candidate.K)
        H = plant.A_model + plant.B_model @ K
        if candidate.hold.mode == "zoh":
            H = np.zeros_like(H)
        return QuickLoop((plant.A, plant.B, K, H), self.times(candidate.hold, period_ns), self.weights)

    def times(self, hold: Hold, period_ns: int) -> LoopTimes:
        """Return the times of a loop with another hold strategy and period."""
        times = self._times._replace(period_ns=period_ns)
        return times._replace(timeout_ns=hold.timeout_ns(times), holds_input=hold.timeout_input == "hold")

    def graph(self, requirement: Requirement, hold: Hold) -> PatternGraph:
        """Return the loss patterns of a requirement; those that were the worst depend on the hold."""
        times = self.times(hold, requirement.period_ns)
        period_ns = 0 if hold.timeout_s is None else requirement.period_ns
        key = requirement.guarantee, times.slots, hold, period_ns
        if key not in self._graphs:
            self._graphs[key] = PatternGraph(list_bursts(requirement.guarantee, times))
        return self._graphs[key]

    def growth(self, candidate: GainCandidate, level: int) -> float:
        """Return a lower bound of the logarithm of the growth per period."""
        self.tried += 1
        requirement = self.requirements[level]
        loop = self.quick_loop(candidate, requirement.period_ns)
        graph = self.graph(requirement, candidate.hold)
        return graph.growth(loop.maps(graph.bursts))

    def cost(self, candidate: GainCandidate, level: int) -> float:
        """Return the cost without losses."""
        return self.quick_loop(candidate, self.requirements[max(level, 0)].period_ns).cost(self.plant.x0)

    def excess(self, candidate: GainCandidate, level: int) -> float:
        """Return what is minimised: the growth, and by how much the cost exceeds its limit."""
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            plant = self.plant
            rate_per_s = spectral_abscissa(plant.A_model + plant.B_model @ np.array(candidate.K))
            if not rate_per_s < 0:
                return _UNSTABLE + min(rate_per_s, _UNSTABLE)
            cost = self.cost(candidate, level)
            growth = self.growth(candidate, level)
            if not math.isfinite(cost) or not math.isfinite(growth):
                return _UNSTABLE / 2 + min(max(growth, 0.0), _UNSTABLE / 4)
        if cost <= self.cost_limit:
            if growth < -_SLACK:
                self.highest_level[candidate.hold] = max(level, self.highest_level.get(candidate.hold, -1))
            return growth
        return max(growth, -_SLACK) + _SLACK + math.log(cost / self.cost_limit)

    def highest_possible(self, candidate: GainCandidate, level: int) -> tuple[int, float]:
        """Return the highest level from the given one on that is not excluded, and the next one's excess."""
        while level < len(self.requirements):
            if (excess := self.excess(candidate, level)) >= -_SLACK:
                return level - 1, excess
            level += 1
        return level - 1, -math.inf

    def scenario_of(self, candidate: GainCandidate, level: int) -> Scenario:
        """Return the scenario of a loop at a level, not resolved."""
        requirement, scenario = self.requirements[max(level, 0)], self.scenario
        trigger = scenario.trigger.model_copy(update={"period_s": requirement.period_ns / NS_PER_S})
        return scenario.model_copy(
            update={
                "model": scenario.model.model_copy(update={"gain": candidate.K}),
                "trigger": trigger,
                **candidate.hold.changes(scenario, self._times._replace(period_ns=requirement.period_ns)),
                "network": scenario.network.model_copy(update=requirement.network),
            }
        )

    def stability(self, candidate: GainCandidate, level: int) -> Stability:
        """Return the certified bounds of a loop at a level."""
        self.examined += 1
        margin = LossMargin(resolve(self.scenario_of(candidate, level)))
        stability = margin.first_bounds()
        return margin.coarse_bounds() if stability.verdict == "undecided" else stability

    def highest_certified(
        self, candidate: GainCandidate, most: int, least: int = -1
    ) -> tuple[int, Stability | None]:
        """Return the highest certified level from ``most`` down to above ``least``."""
        for level in range(most, least, -1):
            if (stability := self.stability(candidate, level)).verdict == "stable":
                return level, stability
        return least, None

    def certify_given(self) -> CertifiedLoop:
        """Return what the given loop is proven to meet; its bounds are refined until they decide."""
        start = 0
        if self.request.goal == "transmissions":
            period_ns = self._times.period_ns
            start = max(i for i, required in enumerate(self.requirements) if required.period_ns <= period_ns)
        top, _ = self.highest_possible(self.original, start)
        if top < start:
            top = next(
                (i for i in range(start, -1, -1) if self.highest_possible(self.original, i)[0] >= i), -1
            )
        return self.certify(self.original, top)

    def certify(self, candidate: GainCandidate, most: int) -> CertifiedLoop:
        """Return a loop with refined bounds at the highest certified level and at the next one.

        A designed loop stays at a level beyond which its cost would exceed the limit.
        """
        level = most
        stability = None
        while level >= 0 and (stability := self.stability(candidate, level)).verdict != "stable":
            level, stability = level - 1, None
        next_stability, limit = None, math.inf if candidate == self.original else self.cost_limit
        while level + 1 < len(self.requirements) and self.cost(candidate, level + 1) <= limit:
            next_stability = self.stability(candidate, level + 1)
            if next_stability.verdict != "stable":
                break
            level, stability, next_stability = level + 1, next_stability, None
        return CertifiedLoop(candidate, level, stability, next_stability, self.cost(candidate, level))

    def regulators(self) -> list[GainCandidate]:
        """Return LQR gains of the model with all hold strategies."""
        plant, (Q, R) = self.plant, self.weights
        gains = [lqr_gain(plant.A_model, plant.B_model, Q, c * R) for c in COSTS_OF_INPUT]
        return [GainCandidate(hold, round_gain(K)) for hold in self.holds for K in gains]

    @property
    def keeps_given_hold(self) -> bool:
        """Whether the hold strategy of the given loop may be chosen."""

        def behaviour(hold: Hold) -> tuple[str, LoopTimes]:
            return hold.mode, self.times(hold, self.period_ns)

        return self.request.holds is None or behaviour(self.original.hold) in map(behaviour, self.holds)

    def run(self, progress: Progress = lambda share: None) -> tuple[CertifiedLoop, CertifiedLoop]:
        """Return what the given loop is proven to meet, and the best loop found."""
        # The given loop, which the others must exceed.
        original = self.certify_given()
        self.tried, best, level = 0, original.candidate, -1
        if self.keeps_given_hold:
            level = original.level
        progress(0.1)
        # Rank the starts by the level that is not excluded, then by the excess at the next level.
        starts = [GainCandidate(hold, original.candidate.K) for hold in self.holds]
        starts += self.regulators()
        ranked = sorted(
            ((*self.highest_possible(start, max(level, 0)), start) for start in starts),
            key=lambda entry: (-entry[0], entry[1]),
        )
        # Certify the best starts.
        for top, _, candidate in ranked[:_STARTS]:
            if top > level:
                new_level, stability = self.highest_certified(candidate, top, level)
                if stability is not None:
                    best, level = candidate, new_level
        progress(0.3)
        # The best start of each hold strategy, which is part of the answer even if it is not the best.
        first_of_each = {candidate.hold: candidate for _, _, candidate in reversed(ranked)}
        for hold, candidate in first_of_each.items():
            if hold not in self.highest_level:  # it was tried from the given loop's level on only
                self.highest_possible(candidate, 0)
        # The candidates that are improved, each with an equal share of the effort.
        pool = [best] if level >= 0 else []
        pool += [candidate for _, _, candidate in ranked[:_STARTS]]
        pool = list(dict.fromkeys([*pool, *first_of_each.values()]))
        share = max(self.request.effort // len(pool), 1)
        for number, start in enumerate(pool):
            # Improve until the next level is not excluded and certified, then aim at the one after it.
            candidate = start
            tries_left = share
            while tries_left > 0 and level + 1 < len(self.requirements):
                tried_before = self.tried
                better = self._improve(candidate, level + 1, tries_left)
                tries_left -= max(self.tried - tried_before, 1)
                if better is None:
                    break
                candidate = better
                top, _ = self.highest_possible(candidate, level + 1)
                new_level, stability = self.highest_certified(candidate, max(top, level + 1), level)
                if stability is None:
                    break
                best, level = candidate, new_level
            progress(0.3 + 0.6 * (number + 1) / len(pool))
        return original, original if best == original.candidate else self.certify(best, level)

    def by_hold(self) -> Iterator[tuple[str, str]]:
        """Yield the hold strategies with the names of their highest requirements."""
        for hold in self.holds:
            level = self.highest_level.get(hold, -1)
            yield hold.text, self.requirements[level].name if level >= 0 else "nothing"

    def _improve(self, start: GainCandidate, level: int, most_tries: int) -> GainCandidate | None:
        """Return a loop near ``start`` whose lower bound at a level is below 1; None: none found."""
        K = np.array(start.K)
        scale = step_sizes(K)

        def candidate_at(steps: Vector) -> GainCandidate:
            return GainCandidate(start.hold, round_gain((K.ravel() + scale * steps).reshape(K.shape)))

        def objective(steps: Vector) -> float:
            return self.excess(candidate_at(steps), level)

        steps = nelder_mead(objective, K.size, 0.3, most_tries, tolerance=1e-5, enough=-_SLACK)
        return None if steps is None else candidate_at(steps)
