"""The search for a gain and a hold strategy that tolerate the most losses, or the fewest updates.

The sensor is time-triggered. A *ladder* has what is asked for, from easy to hard: M = 1, 2, …; m =
0, 1, … losses in a window; or longer and longer periods. A loop *reaches* a rung if every loss
pattern of its guarantee is proven stable there.

1. The given loop is examined; regulators (LQR) over a grid of weights are the further starts.
2. A quick lower bound of the growth (``loop_growth.py``) excludes what cannot reach a rung. What is
   left is judged: the margin's certified upper bound must be below 1.
3. From the best starts, the lower bound at the next rung is minimised over K without gradients
   (Nelder and Mead). As soon as it is below 1, the loop is judged, and the search aims higher.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from cosim.analysis.margin_search import stability_document
from cosim.output.figures import palette
from cosim.output.figures.figure_description import Axis, FigureDescription, Item, Line, Marks, Panel, Rule
from cosim.studies.design.design_page import DesignOutcome, LoopResult, figure_of, gain_text
from cosim.studies.design.design_search import Bounds
from cosim.studies.design.design_space import lqr_gain
from cosim.studies.design.hold_strategies import HOLDS, Hold, given_hold
from cosim.studies.design.loop_growth import PatternGraph, QuickLoop
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, Vector, spectral_abscissa
from noack.core.number_format import NONE, at_least, at_most
from noack.impairments.constraints.at_most import AtMost
from noack.impairments.loss_guarantee import LongestBurst, LossGuarantee
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.settings.section import Rows, rows_of
from noack.theory.margins.loss_margin import (
    LossMargin,
    Stability,
    capped,
    list_bursts,
    uncapped,
    without_timeout,
)
from noack.theory.margins.time_triggered_loop import LoopTimes
from noack.trigger.periodic_trigger import PeriodicSettings

Goal = Literal["network", "transmissions"]
Progress = Callable[[float], None]
COSTS_OF_INPUT = np.geomspace(1e-3, 1e3, 13)
"""Factors of R of the regulators that the search begins with."""
_LONGER = 1.02
"""Ratio of successive periods of the ladder, where measurements are close enough."""
_RUNGS = 400
_MOST_M = 16
_MOST_POINTS = 60
_CAPTION = (
    "Growth of the worst loss pattern found, per period: a lower bound, quickly computed. Below 1 "
    "every pattern may be stable; the marks are where this is proven."
)
_SLACK = 0.002
"""The search wants log growth below −_SLACK: a loop at the limit takes long to judge."""
_STARTS = 4
_UNSTABLE = 1e3


class GainCandidate(NamedTuple):
    """A gain and what the controller does between updates."""

    hold: Hold
    K: Rows


class Rung(NamedTuple):
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


class ReachedRung(NamedTuple):
    """A loop with the highest rung that it is proven to reach."""

    candidate: GainCandidate
    rung: int
    """Its number in the ladder; −1: none."""
    stability: Stability | None
    """The certificate there; None: there is none."""
    beyond: Stability | None
    """What is known about the next rung; None: there is none, or its cost is above the limit."""
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


def ladder_of(scenario: Scenario, request: DesignRequest, margin: LossMargin) -> list[Rung]:
    """Return what a loop must tolerate, from easy to hard."""
    network, period_ns = scenario.network, margin.longest_ns
    if request.goal == "transmissions":
        return list(_periods(scenario, margin))
    if request.window is not None:
        if not 2 <= request.window <= 64:
            raise CallerError(f"--window: from 2 to 64 updates, not {request.window}")
        rungs = []
        for m in range(request.window):
            rules = (AtMost(losses=m, window=request.window),) if m else ()
            guarantee = LossGuarantee((LongestBurst(m), *(rule.rule for rule in rules)))
            settings: dict[str, object] = {"mansd": m, "constraints": rules}
            name = f"m = {m} of {request.window}"
            rungs.append(Rung(name, m, guarantee, period_ns, settings))
        return rungs
    return [
        Rung(f"M = {m}", m, capped(network.guarantee, m - 1), period_ns, {"mansd": m - 1})
        for m in range(1, examined_m(scenario, request.most or _MOST_M) + 1)
    ]


def _periods(scenario: Scenario, margin: LossMargin) -> Iterator[Rung]:
    step_ns = scenario.timing.measurement_period_ns
    longest = scenario.timing.horizon_ns // step_ns
    steps = max(margin.loop.times.delay_ns // step_ns + 1, margin.longest_ns // step_ns // 16, 1)
    for _ in range(_RUNGS):
        period_s = steps * step_ns / NS_PER_S
        yield Rung(f"{period_s:g} s", period_s, margin.guarantee, steps * step_ns, {})
        steps = max(steps + 1, round(steps * _LONGER))
        if steps > longest:
            return


class NetworkSearch:
    """All that is known about the loops of a scenario with other gains."""

    def __init__(self, scenario: Scenario, request: DesignRequest) -> None:
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
        self.ladder = ladder_of(self.scenario, request, margin)
        n, m = self.plant.n, self.plant.m
        self.weights = request.weights or (np.eye(n), np.eye(m))
        lqr_gain(self.plant.A_model, self.plant.B_model, *self.weights)  # raises if there is none
        self.holds = (
            tuple(itertools.chain(*HOLDS.values())) if request.holds is None else tuple(request.holds)
        )
        self.original = GainCandidate(given_hold(self.scenario), rows_of(self.plant.K))
        base = self.quick_loop(self.original, margin.longest_ns).cost(self.plant.x0)
        self.limit = request.cost * base
        """Largest cost; infinite if the given loop is unstable without losses."""
        self.tried = self.judged = 0
        self.highest: dict[Hold, int] = {}
        """By hold strategy: the highest rung on which a loop was tried and is not excluded."""
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

    def graph(self, rung: Rung, hold: Hold) -> PatternGraph:
        """Return the loss patterns of a rung; those that were the worst ones depend on the hold."""
        times = self.times(hold, rung.period_ns)
        key = rung.guarantee, times.slots, hold, 0 if hold.timeout_s is None else rung.period_ns
        if key not in self._graphs:
            self._graphs[key] = PatternGraph(list_bursts(rung.guarantee, times))
        return self._graphs[key]

    def growth(self, candidate: GainCandidate, rung: int) -> float:
        """Return a lower bound of the logarithm of the growth per period."""
        self.tried += 1
        setting = self.ladder[rung]
        loop = self.quick_loop(candidate, setting.period_ns)
        graph = self.graph(setting, candidate.hold)
        return graph.growth(loop.maps(graph.bursts))

    def cost(self, candidate: GainCandidate, rung: int) -> float:
        """Return the cost without losses."""
        return self.quick_loop(candidate, self.ladder[max(rung, 0)].period_ns).cost(self.plant.x0)

    def excess(self, candidate: GainCandidate, rung: int) -> float:
        """Return what is minimised: the growth, and by how much the cost exceeds its limit."""
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            plant = self.plant
            rate_per_s = spectral_abscissa(plant.A_model + plant.B_model @ np.array(candidate.K))
            if not rate_per_s < 0:
                return _UNSTABLE + min(rate_per_s, _UNSTABLE)
            cost = self.cost(candidate, rung)
            growth = self.growth(candidate, rung)
            if not math.isfinite(cost) or not math.isfinite(growth):
                return _UNSTABLE / 2 + min(max(growth, 0.0), _UNSTABLE / 4)
        if cost <= self.limit:
            if growth < -_SLACK:
                self.highest[candidate.hold] = max(rung, self.highest.get(candidate.hold, -1))
            return growth
        return max(growth, -_SLACK) + _SLACK + math.log(cost / self.limit)

    def climb(self, candidate: GainCandidate, rung: int) -> tuple[int, float]:
        """Return the highest rung that is not excluded, from one on, and the excess at the next."""
        while rung < len(self.ladder):
            if (excess := self.excess(candidate, rung)) >= -_SLACK:
                return rung - 1, excess
            rung += 1
        return rung - 1, -math.inf

    def scenario_of(self, candidate: GainCandidate, rung: int) -> Scenario:
        """Return the scenario of a loop on a rung, not resolved."""
        setting, scenario = self.ladder[max(rung, 0)], self.scenario
        trigger = scenario.trigger.model_copy(update={"period_s": setting.period_ns / NS_PER_S})
        return scenario.model_copy(
            update={
                "model": scenario.model.model_copy(update={"gain": candidate.K}),
                "trigger": trigger,
                **candidate.hold.changes(scenario, self._times._replace(period_ns=setting.period_ns)),
                "network": scenario.network.model_copy(update=setting.network),
            }
        )

    def judge(self, candidate: GainCandidate, rung: int) -> Stability:
        """Return the certified bounds of a loop on a rung."""
        self.judged += 1
        margin = LossMargin(resolve(self.scenario_of(candidate, rung)))
        stability = margin.first_bounds()
        return margin.coarse_bounds() if stability.verdict == "undecided" else stability

    def reach(self, candidate: GainCandidate, most: int, least: int = -1) -> tuple[int, Stability | None]:
        """Return the highest certified rung from ``most`` down to above ``least``."""
        for rung in range(most, least, -1):
            if (stability := self.judge(candidate, rung)).verdict == "stable":
                return rung, stability
        return least, None

    def first(self) -> ReachedRung:
        """Return what the given loop reaches; its bounds are refined until they decide."""
        start = 0
        if self.request.goal == "transmissions":
            period_ns = self._times.period_ns
            start = max(i for i, rung in enumerate(self.ladder) if rung.period_ns <= period_ns)
        top, _ = self.climb(self.original, start)
        if top < start:
            top = next((i for i in range(start, -1, -1) if self.climb(self.original, i)[0] >= i), -1)
        return self.completed(self.original, top)

    def completed(self, candidate: GainCandidate, most: int) -> ReachedRung:
        """Return a loop with refined bounds on its rung and on the next one.

        A designed loop stays on a rung beyond which its cost would exceed the limit.
        """
        rung = most
        stability = None
        while rung >= 0 and (stability := self.judge(candidate, rung)).verdict != "stable":
            rung, stability = rung - 1, None
        following, limit = None, math.inf if candidate == self.original else self.limit
        while rung + 1 < len(self.ladder) and self.cost(candidate, rung + 1) <= limit:
            following = self.judge(candidate, rung + 1)
            if following.verdict != "stable":
                break
            rung, stability, following = rung + 1, following, None
        return ReachedRung(candidate, rung, stability, following, self.cost(candidate, rung))

    def regulators(self) -> list[GainCandidate]:
        """Return LQR gains of the model with all hold strategies."""
        plant, (Q, R) = self.plant, self.weights
        gains = [lqr_gain(plant.A_model, plant.B_model, Q, c * R) for c in COSTS_OF_INPUT]
        return [_rounded(hold, K) for hold in self.holds for K in gains]

    @property
    def keeps_given_hold(self) -> bool:
        """Whether the hold strategy of the given loop may be chosen."""

        def behaviour(hold: Hold) -> tuple[str, LoopTimes]:
            return hold.mode, self.times(hold, self.period_ns)

        return self.request.holds is None or behaviour(self.original.hold) in map(behaviour, self.holds)

    def run(self, progress: Progress = lambda share: None) -> tuple[ReachedRung, ReachedRung]:
        """Return what the given loop reaches, and the best loop found."""
        original = self.first()
        self.tried, best, rung = 0, original.candidate, -1
        if self.keeps_given_hold:
            rung = original.rung
        progress(0.1)
        starts = [GainCandidate(hold, original.candidate.K) for hold in self.holds]
        starts += self.regulators()
        ranked = sorted(
            ((*self.climb(start, max(rung, 0)), start) for start in starts),
            key=lambda entry: (-entry[0], entry[1]),
        )
        for top, _, candidate in ranked[:_STARTS]:
            if top > rung:
                reached, stability = self.reach(candidate, top, rung)
                if stability is not None:
                    best, rung = candidate, reached
        progress(0.3)
        first_of_each = {candidate.hold: candidate for _, _, candidate in reversed(ranked)}
        for hold, candidate in first_of_each.items():
            if hold not in self.highest:  # it was tried from the given loop's rung on
                self.climb(candidate, 0)
        pool = [best] if rung >= 0 else []
        pool += [candidate for _, _, candidate in ranked[:_STARTS]]
        pool = list(dict.fromkeys([*pool, *first_of_each.values()]))
        share = max(self.request.effort // len(pool), 1)
        for number, start in enumerate(pool):
            candidate = start
            tries_left = share
            while tries_left > 0 and rung + 1 < len(self.ladder):
                tried_before = self.tried
                improved = self._improve(candidate, rung + 1, tries_left)
                tries_left -= max(self.tried - tried_before, 1)
                if improved is None:
                    break
                candidate = improved
                top, _ = self.climb(candidate, rung + 1)
                reached, stability = self.reach(candidate, max(top, rung + 1), rung)
                if stability is None:
                    break
                best, rung = candidate, reached
            progress(0.3 + 0.6 * (number + 1) / len(pool))
        return original, original if best == original.candidate else self.completed(best, rung)

    def by_hold(self) -> Iterator[tuple[str, str]]:
        """Yield the hold strategies with the names of their highest rungs."""
        for hold in self.holds:
            rung = self.highest.get(hold, -1)
            yield hold.text, self.ladder[rung].name if rung >= 0 else "nothing"

    def _improve(self, start: GainCandidate, rung: int, most: int) -> GainCandidate | None:
        """Return a loop near ``start`` whose lower bound is below 1 on a rung; None: none found."""
        K = np.array(start.K)
        scale = scaled_steps(K)

        def objective(steps: Vector) -> float:
            candidate = _rounded(start.hold, (K.ravel() + scale * steps).reshape(K.shape))
            excess = self.excess(candidate, rung)
            if excess < -_SLACK:
                raise _FoundError(candidate)
            return excess

        try:
            nelder_mead(objective, K.size, 0.3, most, tolerance=1e-5)
        except _FoundError as success:
            return success.candidate
        return None


def nelder_mead(
    objective: Callable[[Vector], float], size: int, first_step: float, most: int, tolerance: float = 1e-4
) -> None:
    """Minimise without gradients from 0 on.

    Args:
        objective: to be minimised.
        size: number of unknowns.
        first_step: size of the first simplex.
        most: largest number of evaluations.
        tolerance: difference of values at which the search ends.
    """
    from scipy.optimize import minimize  # slow to import

    simplex = np.vstack([np.zeros(size), first_step * np.eye(size)])
    minimize(
        objective,
        np.zeros(size),
        method="Nelder-Mead",
        options={"maxfev": most, "adaptive": True, "initial_simplex": simplex, "fatol": tolerance},
    )


def scaled_steps(K: Matrix) -> Vector:
    """Return the unit of a search's steps of each entry of a gain."""
    return np.ravel(np.maximum(np.abs(K), 0.1 * np.abs(K).max(axis=1, keepdims=True)))


def _rounded(hold: Hold, K: Matrix) -> GainCandidate:
    """Return a candidate with six digits: what is judged is what is printed."""
    return GainCandidate(hold, tuple(tuple(float(f"{entry:.6g}") for entry in row) for row in K))


class _FoundError(Exception):
    """Ends a minimisation."""

    def __init__(self, candidate: GainCandidate) -> None:
        super().__init__()
        self.candidate = candidate


def periodic_outcome(search: NetworkSearch, original: ReachedRung, best: ReachedRung) -> DesignOutcome:
    """Return what is shown of a search."""
    return DesignOutcome(
        search.scenario.name,
        "proven stable for every loss pattern",
        _loop_result(search, original, is_excluded=not search.keeps_given_hold),
        _loop_result(search, best),
        list(_notes(search, original, best)),
        search.scenario_of(best.candidate, best.rung),
        best.rung >= 0,
        best.candidate != original.candidate,
        {
            "goal": search.request.goal,
            "window": search.request.window,
            "cost_limit": search.limit,
            "tried": search.tried,
            "judged": search.judged,
            "highest_by_hold": dict(search.by_hold()),
        },
        _figure(search, original, best),
        tuple(search.by_hold()),
    )


def _loop_result(search: NetworkSearch, reached: ReachedRung, *, is_excluded: bool = False) -> LoopResult:
    ladder, (hold, K), proven = search.ladder, reached.candidate, reached.stability
    rung = ladder[max(reached.rung, 0)]
    sent = search.scenario.timing.measurement_period_ns / rung.period_ns
    reach = rung.name + (", the most examined" * (reached.rung == len(ladder) - 1))
    if reached.rung < 0:
        reach = "nothing proven"
    growth = (
        f"{at_least(proven.lower, decimals=5)} to {at_most(proven.upper, decimals=5)}" if proven else NONE
    )
    cells = {
        "proven stable for": reach,
        "growth per period there": growth,
        "the next one": _next_rung_text(ladder, reached),
        "cost without losses": f"{reached.cost:.4g}",
        "share of measurements sent": f"{100 * sent:.3g} %",
        "between updates": hold.text + " (not in --holds)" * is_excluded,
        "K": gain_text(K),
    }
    certified = None if reached.rung < 0 else rung.number
    document: dict[str, object] = {"certified": certified, "cost": reached.cost, "transmitted": sent}
    document |= {"mode": hold.mode, "hold": hold.text, "K": K}
    for name, stability in (("stability", proven), ("beyond", reached.beyond)):
        document[name] = stability and stability_document(stability)
    return LoopResult(reach, cells, document)


def _notes(search: NetworkSearch, original: ReachedRung, best: ReachedRung) -> Iterator[str]:
    """Yield what the reader should know of a search."""
    limit = f"{search.limit:.4g}" if math.isfinite(search.limit) else "any size"
    yield (
        f"the best of {search.tried:,} loops tried, with a cost of at most {limit}; what it "
        "tolerates is proven, that it is the best is not"
    )
    if best.rung < original.rung:
        hold = original.candidate.hold.text
        yield f"the given loop tolerates more than the designed one; --holds excludes its strategy, {hold}"
    period_s = search.period_ns / NS_PER_S
    if search.request.period_s is not None and round(search.request.period_s * NS_PER_S) != search.period_ns:
        yield f"--period {search.request.period_s:g}: updates are sent at measurements, every {period_s:g} s"


def _next_rung_text(ladder: Sequence[Rung], reached: ReachedRung) -> str:
    if reached.rung + 1 == len(ladder):
        return "not examined"
    if reached.beyond is None:
        return f"{ladder[reached.rung + 1].name}: costs too much"
    destabilised = reached.beyond.verdict == "destabilised"
    result = f"{reached.beyond.text} destabilises" if destabilised else "undecided"
    return f"{ladder[reached.rung + 1].name}: {result}"


def _figure(search: NetworkSearch, original: ReachedRung, best: ReachedRung) -> FigureDescription:
    """Describe the growth of both loops over the ladder."""
    ladder, request = search.ladder, search.request
    top = min(max(best.rung, original.rung) + 4, len(ladder))
    rungs = np.unique(np.linspace(0, top - 1, min(top, _MOST_POINTS)).astype(int))
    numbers = np.array([rung.number for rung in ladder])
    items: list[Item] = [Rule(at=1.0, colour=palette.CERTIFIED, label="stable below")]
    for reached, label, colour in ((original, "given", palette.NETWORK), (best, "designed", palette.LOST)):
        growth = np.exp(np.minimum([search.growth(reached.candidate, int(i)) for i in rungs], 1.1))
        items.append(Line(x=numbers[rungs], y=growth, colour=colour, label=label, marker="o"))
        if reached.stability is not None:
            x, y = numbers[[reached.rung]], np.array([reached.stability.upper])
            mark_label = f"{label}: proven"
            items.append(Marks(x=x, y=y, colour=colour, marker="*", size=12, label=mark_label))
    x_label = "M" if request.window is None else f"losses in {request.window} updates"
    if request.goal == "transmissions":
        x_label = "time between updates [s]"
    x_axis = Axis(label=x_label, whole=request.goal == "network")
    panel = Panel(items=items, x=x_axis, y=Axis(label="growth per period"))
    return figure_of("growth", panel, _CAPTION)
