"""The worst admissible loss pattern of a scenario, compared with the certificate.

The search first evaluates regular and random patterns, improves each by changes of single
decisions, and runs a beam search. Then it searches all patterns, depth first, up to a number of
nodes. If this covers all patterns and the reference simulator confirms the value, the result is
exact: no admissible pattern is worse, within the resolution of
:mod:`cosim.analysis.adversary.segment_objective`.
"""

import math
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from cosim.analysis.adversary.beam_search import search_beam
from cosim.analysis.adversary.cost_bound import cost_ceiling
from cosim.analysis.adversary.loss_patterns import Pattern, candidates, follow, improve
from cosim.analysis.adversary.objective import Measure, Objective, measure_of
from cosim.analysis.adversary.pattern_evaluation import evaluate
from cosim.analysis.adversary.pattern_tree import search_tree
from cosim.analysis.adversary.search_nodes import WorstPatternFound
from cosim.analysis.adversary.segments import SegmentFlow
from cosim.analysis.adversary.tightness import Worst, certified, shown
from cosim.simulation.continuous.continuous_loop import ContinuousLoop, continuous_loop_of
from cosim.simulation.continuous.continuous_run import ContinuousRun, simulate_continuous
from cosim.simulation.continuous.network_fates import network_fates
from noack.config.scenario import Scenario
from noack.core.random_streams import stream
from noack.theory.run_conditions import ideal_conditions
from noack.theory.scenario_certificates import ScenarioCertificate, certify

NODES = 500_000
BEAM = 512
_IMPROVED = 3
_NODES_FOR_A_GUESS = 20_000
_NODES_TO_IMPROVE = 200_000
_LONGEST = 1000
_CONFIRMED = 1e-5

SearchReport = Callable[[str, int, float], None]
"""Receives the current search step, its number of visited nodes, and the largest value so far."""


class _Known(NamedTuple):
    """A pattern and its value by the fast computation."""

    value: float
    pattern: Pattern


def find_worst(
    resolved: Scenario,
    objective: Objective,
    horizon_s: float | None = None,
    *,
    most_nodes: int = NODES,
    beam: int = BEAM,
    seed: int = 0,
    certificate: ScenarioCertificate | None = None,
    report: SearchReport = lambda what, nodes, value: None,
) -> Worst:
    """Find the pattern with at most M − 1 consecutive losses that maximises the objective.

    The loop is the paper's, in exact continuous time without network delay; the first update is
    delivered. The same arguments give the same result.

    Args:
        resolved: the scenario; its ``network.mansd`` is used, its loss model only for comparison.
        objective: the value to maximise.
        horizon_s: end of the run; by default the scenario's.
        most_nodes: largest number of nodes of the search through all patterns; 0 for no search.
        beam: width of the beam search; 0 for no search.
        seed: seed of the random patterns.
        certificate: the certificate to compare with; by default that of the scenario's own plant,
            for continuous triggering without network delay.
        report: receives the progress.

    Raises:
        CallerError: the events accumulate, or the threshold becomes too small before the horizon.
    """
    began_s = time.monotonic()
    certificate = certificate or certify(resolved, ideal_conditions(resolved))
    constants = certificate.constants
    system = continuous_loop_of(resolved)
    measure = measure_of(system, objective, None if constants is None else constants.rate_per_s)
    horizon_s = resolved.horizon_s if horizon_s is None else horizon_s
    trial = _Trial(system, measure, horizon_s, resolved)
    lossless = trial.run(lambda event: True)
    own = trial.run(network_fates(resolved))
    search = _Search(trial, resolved.network.mansd, report)
    search.guess(stream(seed, "adversary"), trial.decided(own))
    if beam > 0:
        search.beam(beam)
    if most_nodes > 0:
        search.tree(most_nodes)
    if not search.exact:
        search.improve(search.known, _NODES_TO_IMPROVE)
    run = trial.run(trial.whole(search.known.pattern))
    valued = evaluate(run, measure)
    confirmed = math.isclose(valued.value, search.known.value, rel_tol=_CONFIRMED)
    return Worst(
        objective,
        horizon_s,
        shown(valued.value, objective),
        valued.at_s,
        tuple(run.delivered.tolist()),
        tuple(run.event_s.tolist()),
        search.exact and confirmed,
        search.visited,
        shown(evaluate(lossless, measure).value, objective),
        shown(evaluate(own, measure).value, objective),
        certified(certificate, measure, horizon_s, valued),
        time.monotonic() - began_s,
    )


class _Trial:
    """Runs of the reference simulator."""

    def __init__(
        self, system: ContinuousLoop, measure: Measure, horizon_s: float, resolved: Scenario
    ) -> None:
        known_start = resolved.network.initial_sync == "known_state"
        self.flow = SegmentFlow(system, measure, horizon_s, known_start=known_start)

    def run(self, delivered: Callable[[int], bool] | Pattern) -> ContinuousRun:
        return simulate_continuous(
            self.flow.system,
            horizon_s=self.flow.horizon_s,
            delivered=delivered,
            known_start=self.flow.known_start,
        )

    def whole(self, pattern: Pattern) -> Pattern:
        """Add the first packet, which is always delivered and not part of a search."""
        return pattern if self.flow.known_start else (True, *pattern)

    def decided(self, run: ContinuousRun) -> Pattern:
        """Return a run's decisions without the first packet."""
        pattern = tuple(run.delivered.tolist())
        return pattern if self.flow.known_start else pattern[1:]


class _Search:
    """The search steps; each one starts from the worst pattern found before."""

    def __init__(self, trial: _Trial, mansd: int, report: SearchReport) -> None:
        self._flow, self._mansd, self._report = trial.flow, mansd, report
        self._window_s = trial.flow.horizon_s
        self.known = _Known(-math.inf, ())
        self.visited = 0
        self.exact = False

    def guess(self, rng: np.random.Generator, own: Pattern) -> None:
        """Try regular and random patterns, and the scenario's own losses."""
        flow, mansd = self._flow, self._mansd
        busiest = follow(flow, mansd, [(False,) * _LONGEST]).patterns[0]
        self._window_s = flow.horizon_s / (len(busiest) + 1)
        tried = follow(flow, mansd, [own, *candidates(mansd, len(busiest), rng)])
        self.visited += len(busiest) + sum(map(len, tried.patterns))
        self._report("guesses", self.visited, float(tried.value.max()))
        for i in np.argsort(-tried.value, kind="stable")[:_IMPROVED]:
            self.improve(_Known(float(tried.value[i]), tried.patterns[i]), _NODES_FOR_A_GUESS)

    def beam(self, width: int) -> None:
        """Run a beam search of ``width`` runs."""
        self._take(
            search_beam(
                self._flow, self._mansd, width, self._window_s, known=self.known.value,
                report=lambda nodes, value: self._report("beam search", nodes, value),
            )
        )  # fmt: skip

    def tree(self, most_nodes: int) -> None:
        """Search all patterns."""
        flow, mansd = self._flow, self._mansd
        additive = flow.measure.additive
        found = search_tree(
            flow, mansd, most_nodes, known=self.known.value,
            ceiling=cost_ceiling(flow.system, mansd, flow.horizon_s) if additive else None,
            report=lambda nodes, value: self._report("all patterns", nodes, value),
        )  # fmt: skip
        self.exact = found.complete
        self._take(found)

    def improve(self, start: _Known, most_nodes: int) -> None:
        """Change single decisions of a pattern."""
        found = improve(self._flow, self._mansd, start.pattern, start.value, most_nodes)
        self._report("changes", found.nodes, found.value)
        self.visited += found.nodes
        if found.value > self.known.value or not self.known.pattern:
            self.known = _Known(found.value, found.decisions or ())

    def _take(self, found: WorstPatternFound) -> None:
        self.visited += found.nodes
        if found.decisions is not None:
            self.known = _Known(found.value, found.decisions)
