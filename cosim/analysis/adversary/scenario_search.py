"""The worst admissible loss pattern of a scenario, compared with the certificate.

The search first evaluates regular and random patterns, improves each by changes of single
decisions, and runs a beam search. Then it searches all patterns, depth first, up to a number of
nodes. If this covers all patterns, the result is exact: no admissible pattern is worse. In
continuous time this is so within the resolution of :mod:`cosim.analysis.adversary.loop_flows`,
and the reference simulator has to confirm the value.
"""

import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from cosim.analysis.adversary.loop_flows import (
    Objective,
    Pattern,
    SampledFlow,
    SampledRun,
    SegmentFlow,
    evaluate,
    measure_of,
    run_sampled,
    weight_of,
)
from cosim.analysis.adversary.pattern_search import (
    Ceiling,
    Nodes,
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
from cosim.analysis.adversary.worst_run import WorstRun, certified_value, reported_value
from cosim.analysis.scenario_certificates import quick_certificate
from cosim.simulation.continuous import (
    ContinuousLoop,
    ContinuousRun,
    continuous_loop_of,
    network_fates,
    simulate_continuous,
)
from cosim.simulation.sampled_loop import SampledLoop
from noack.core.linear_systems import Vector, spectral_abscissa
from noack.core.random_streams import stream
from noack.scenario.scenario import Scenario
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.response_bounds import NotDecayingError, bound_response

NODES = 500_000
"""Most segments that the search through all patterns computes by default."""
BEAM = 512
"""Runs that the beam search continues by default."""
_NODES_TO_IMPROVE = 200_000
"""Segments that the improvement of the worst pattern may compute."""
_CONFIRMED = 1e-5
"""Relative difference of search and exact run up to which the value is confirmed."""
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
    continuous: bool = False,
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
        continuous: search the paper's loop in exact continuous time without network delay, not the
            loop as the processes run it; for the policy "decaying" only.
        most_nodes: largest number of nodes of the search through all patterns; 0 for no search.
        beam: width of the beam search; 0 for no search.
        certificate: the certificate to compare with; by default that of the scenario's own plant,
            for the schedule without lateness, or for the paper's conditions.
        report: receives the progress.

    Raises:
        CallerError: the loop or its policy is not supported, the events accumulate, or the
            threshold becomes too small before the horizon.
    """
    if certificate is None:
        certificate = quick_certificate(resolved, ideal=continuous)
    find = _find_continuous if continuous else _find_sampled
    with np.errstate(all="ignore"):  # a loop that diverges overflows
        return find(resolved, objective, certificate, beam, most_nodes, report)


def require_searchable(resolved: Scenario, *, continuous: bool) -> None:
    """Raise CallerError unless a scenario can be searched."""
    if continuous:
        measure_of(continuous_loop_of(resolved), Objective.STATE)
    else:
        SampledLoop(resolved)


def _find_sampled(
    resolved: Scenario,
    objective: Objective,
    certificate: ScenarioCertificate,
    beam: int,
    most_nodes: int,
    report: SearchReport,
) -> WorstRun:
    """Search the loop as the processes run it; with bounded disturbances, alternate with these."""
    began_s = time.monotonic()
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
        elapsed_s=time.monotonic() - began_s,
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


def _find_continuous(
    resolved: Scenario,
    objective: Objective,
    certificate: ScenarioCertificate,
    beam: int,
    most_nodes: int,
    report: SearchReport,
) -> WorstRun:
    """Search the paper's loop, and confirm the worst pattern by an exact run."""
    began_s, horizon_s = time.monotonic(), resolved.horizon_s
    system, proven = continuous_loop_of(resolved), certificate.proven
    measure = measure_of(system, objective, None if proven is None else proven.rate_per_s)
    known_start = resolved.network.initial_sync == "known_state"
    # The first packet is always delivered and not part of the search.
    first_packet: Pattern = () if known_start else (True,)

    def simulated(delivered: Callable[[int], bool] | Pattern) -> ContinuousRun:
        return simulate_continuous(system, horizon_s=horizon_s, delivered=delivered, known_start=known_start)

    own_run = simulated(network_fates(resolved))
    flow = SegmentFlow(system, measure, horizon_s, known_start=known_start)
    search = PatternSearch(flow, resolved.network.guarantee, report)
    exact = _search(search, tuple(own_run.delivered.tolist())[len(first_packet) :], beam, most_nodes)
    run = simulated((*first_packet, *search.pattern))
    worst = evaluate(run, measure)
    return WorstRun(
        objective,
        horizon_s,
        value=reported_value(worst.value, objective),
        at_s=worst.at_s,
        pattern=tuple(run.delivered.tolist()),
        event_s=tuple(run.event_s.tolist()),
        exact=exact and math.isclose(worst.value, search.value, rel_tol=_CONFIRMED),
        nodes=search.nodes,
        runs=search.runs,
        lossless=reported_value(evaluate(simulated(()), measure).value, objective),
        with_own_network=reported_value(evaluate(own_run, measure).value, objective),
        certified=certified_value(certificate, measure, horizon_s, worst),
        elapsed_s=time.monotonic() - began_s,
    )


def _search(search: PatternSearch, scenario_pattern: Pattern, beam: int, most_nodes: int) -> bool:
    """Run all search steps; return whether the maximum was found, as :func:`search_tree` does."""
    flow = search.flow
    window_s = try_likely_patterns(search, scenario_pattern, stream(0, "adversary"))
    if beam > 0:
        search_beam(search, beam, window_s)
    if most_nodes > 0:
        ceiling = None
        if isinstance(flow, SegmentFlow) and flow.objective.additive:
            ceiling = cost_ceiling(flow.system, search.guarantee.longest_burst, flow.horizon_s)
        if search_tree(search, most_nodes, ceiling):
            return True
    search.step = "changes"
    improve(search, search.pattern, search.value, _NODES_TO_IMPROVE)
    return False


def cost_ceiling(system: ContinuousLoop, longest_burst: int | None, horizon_s: float) -> Ceiling | None:
    """Return an upper bound of what the rest of a run adds to ∫‖x‖².

    From x' = (A+BK) x + B p, p = K e_c, and the triangle inequality in L₂[t, ∞),

        ‖x‖_{L₂} ≤ √(x(t)ᵀ P x(t)) + ∫₀^∞‖e^{(A+BK)s}B‖ds · ‖p‖_{L₂},  (A+BK)ᵀP + P(A+BK) = −I

    by Young's inequality for the convolution. By identity (I1) every pattern has
    ‖K e_c‖ ≤ D level(t): D sums the gains of the present e_s and of the longest burst of missed
    ones, at any distance. The bound is cheap and prunes the late part of the search tree. There is
    no comparable bound for suprema: they may occur at any time.

    None if A + BK or the models are not stable, or bursts may be of any length.
    """
    if longest_burst is None:
        return None
    loop, trigger, alpha_per_s = system.loop, system.decaying, system.decaying.rate_per_s
    closed = loop.A + loop.B @ loop.K
    weight = weight_of(system)
    inverse = np.linalg.inv(weight)
    if spectral_abscissa(loop.H) + alpha_per_s >= 0:
        alpha_per_s = 0.0
    growing = loop.H + alpha_per_s * np.eye(loop.n)
    try:
        pushed = bound_response(closed, np.eye(loop.n), loop.B).integral
        missed = bound_response(growing, loop.K, inverse).largest
    except NotDecayingError:
        return None
    gain = pushed * (float(np.linalg.norm(loop.K @ inverse, 2)) + longest_burst * missed)
    P = solve_continuous_lyapunov(closed.T, -np.eye(loop.n))
    rate, beta = 2 * alpha_per_s, trigger.level

    def ceiling(nodes: Nodes) -> Vector:
        x, rest_s = nodes.z[:, : loop.n], horizon_s - nodes.t_s
        state_part = np.einsum("ai,ij,aj->a", x, P, x)
        integral = -np.expm1(-rate * rest_s) / rate if rate else rest_s
        level = beta**2 * np.exp(-rate * nodes.t_s) * integral + trigger.floor**2 * rest_s
        return np.asarray((np.sqrt(state_part) + gain * np.sqrt(level)) ** 2)

    return ceiling
