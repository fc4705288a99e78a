"""The worst admissible loss pattern of a scenario, compared with the certificate.

The search first evaluates regular and random patterns, improves each by changes of single
decisions, and runs a beam search. Then it searches all patterns, depth first, up to a number of
nodes. If this covers all patterns, the result is exact: no admissible pattern is worse.
"""

import math
from dataclasses import replace

import numpy as np

from cosim.analysis.adversary.loop_flows import Objective, Pattern, SampledFlow, SampledRun, run_sampled
from cosim.analysis.adversary.pattern_search import (
    PatternSearch,
    SearchReport,
    improve,
    search_beam,
    search_tree,
    try_likely_patterns,
)
from cosim.analysis.adversary.worst_disturbances import (
    DisturbanceBounds,
    disturbance_bounds,
    worst_disturbances,
)
from cosim.analysis.adversary.worst_run import WorstRun, reported_value
from cosim.analysis.scenario_certificates import quick_certificate
from cosim.simulation.continuous import network_fates
from cosim.simulation.sampled_loop import SampledLoop
from netem.core.random_streams import stream
from noack.scenario.scenario import Scenario
from noack.theory.certificates.certified_bounds import ScenarioCertificate

NODES = 500_000
"""Most segments that the search through all patterns computes by default."""
BEAM = 512
"""Runs that the beam search continues by default."""
_NODES_TO_IMPROVE = 200_000
"""Segments that the improvement of the worst pattern may compute."""
_MOST_ROUNDS = 10
"""Largest number of times that the disturbances are made worse."""
_TIMES_PER_ROUND = 6
"""Number of events at whose times they are made worst in each round."""
_LEAST_GAIN = 1 + 1e-6
"""Factor by which a round has to raise the value for another one to follow."""


def find_worst(
    resolved: Scenario,
    objective: Objective,
    *,
    most_nodes: int = NODES,
    beam: int = BEAM,
    certificate: ScenarioCertificate | None = None,
    report: SearchReport = lambda step, nodes, value: None,
) -> WorstRun:
    """Find the loss pattern that maximises the objective, of all that the guarantee allows.

    The first update is delivered. The same arguments give the same result.

    Args:
        resolved: the scenario; its guarantee is used, its loss model only for comparison.
        objective: the objective.
        most_nodes: largest number of nodes of the search through all patterns; 0 for no search.
        beam: width of the beam search; 0 for no search.
        certificate: the certificate to compare with; by default that of the scenario's own plant,
            for the schedule without lateness.
        report: receives the progress.

    Raises:
        CallerError: the loop or its policy is not supported, or the events accumulate.
    """
    if certificate is None:
        certificate = quick_certificate(resolved)
    with np.errstate(all="ignore"):  # a loop that diverges overflows
        return _find_worst(resolved, objective, certificate, beam, most_nodes, report)


def _find_worst(
    resolved: Scenario,
    objective: Objective,
    certificate: ScenarioCertificate,
    beam: int,
    most_nodes: int,
    report: SearchReport,
) -> WorstRun:
    """Search the losses; with bounded disturbances, alternate with these."""
    flow = SampledFlow(SampledLoop(resolved), objective, certificate)
    own_run = run_sampled(flow, network_fates(resolved))
    first_event = 0 if flow.loop.known_start else 1
    # The worst pattern with the disturbances that are drawn.
    search = PatternSearch(flow, resolved.network.guarantee, report)
    exact = _search(search, own_run.delivered[first_event:], beam, most_nodes)
    worst, lossless = _run(flow, search.pattern), run_sampled(flow, lambda event: True)
    bounds = disturbance_bounds(resolved) if objective in (Objective.ERROR, Objective.STATE) else None
    if bounds is not None:
        # The worst disturbances for it, the worst pattern for these, and once more the disturbances.
        exact = False
        disturbed_flow, worst = _worsen_disturbances(flow, bounds, worst)
        second_search = PatternSearch(disturbed_flow, resolved.network.guarantee, report)
        _search(second_search, worst.delivered[first_event:], beam, most_nodes)
        _, worst = _worsen_disturbances(
            disturbed_flow, bounds, max(_run(disturbed_flow, second_search.pattern), worst)
        )
        search.nodes += second_search.nodes
        search.runs += second_search.runs
    return WorstRun(
        objective,
        flow.horizon_s,
        value=reported_value(worst.value, objective),
        at_s=worst.at_s,
        pattern=worst.delivered,
        event_s=worst.event_s,
        exact=exact,
        nodes=search.nodes,
        runs=search.runs,
        lossless=reported_value(lossless.value, objective),
        with_own_network=reported_value(own_run.value, objective),
        certified=flow.certified,
    )


def _run(flow: SampledFlow, pattern: Pattern) -> SampledRun:
    """Run a pattern that was searched; the first packet is not part of it."""
    first_event = 0 if flow.loop.known_start else 1
    return run_sampled(
        flow, lambda event: event - first_event >= len(pattern) or pattern[event - first_event]
    )


def _worsen_disturbances(
    flow: SampledFlow, bounds: DisturbanceBounds, worst: SampledRun
) -> tuple[SampledFlow, SampledRun]:
    """Return the flow with worse disturbances and noise, and its run with the same losses.

    They are made worst for the time of the largest value, some events, and the horizon.
    """
    first_event = 0 if flow.loop.known_start else 1
    previous_value = -math.inf
    for _ in range(_MOST_ROUNDS):
        if not worst.value > previous_value * _LEAST_GAIN:
            break
        previous_value = worst.value
        base_flow, base_run = flow, worst
        some_s = base_run.event_s[:: len(base_run.event_s) // _TIMES_PER_ROUND + 1]
        for at_s in (base_run.at_s or 0.0, *some_s, flow.horizon_s):
            for loop in worst_disturbances(base_flow, bounds, base_run, at_s):
                disturbed_flow = replace(flow, loop=loop)
                candidate = _run(disturbed_flow, base_run.delivered[first_event:])
                if candidate.value > worst.value:
                    flow, worst = disturbed_flow, candidate
    return flow, worst


def _search(search: PatternSearch, scenario_pattern: Pattern, beam: int, most_nodes: int) -> bool:
    """Run all search steps; return whether the maximum was found, as :func:`search_tree` does."""
    window_s = try_likely_patterns(search, scenario_pattern, stream(0, "adversary"))
    if beam > 0:
        search_beam(search, beam, window_s)
    if most_nodes > 0 and search_tree(search, most_nodes):
        return True
    search.step = "changes"
    improve(search, search.pattern, search.value, _NODES_TO_IMPROVE)
    return False
