"""Losses against bounds of the paper's loop, in continuous time without delays: patterns tried in turn."""

import numpy as np

from cosim.analysis.adversary.pattern_search import likely_patterns
from cosim.simulation.continuous import continuous_loop_of, simulate_continuous
from netem.guarantee.loss_guarantee import LossAutomaton
from noack.scenario.scenario import Scenario
from noack.theory.certificates.certified_bounds import ScenarioCertificate

_EVENTS, _SAMPLES = 40, 400


def largest_share(resolved: Scenario, certificate: ScenarioCertificate, most_patterns: int) -> float:
    """The largest share of its bound that ‖e_c‖_W or ‖x‖ has, over regular and random patterns.

    The guarantee forces deliveries.
    """
    system, horizon_s = continuous_loop_of(resolved), resolved.horizon_s
    known_start = resolved.network.initial_sync == "known_state"
    automaton = LossAutomaton(resolved.network.guarantee)
    patterns = likely_patterns(resolved.network.guarantee, _EVENTS, np.random.default_rng(0))
    share = 0.0
    for number in np.linspace(0, len(patterns) - 1, min(most_patterns, len(patterns))).astype(int):
        pattern, state, fates = patterns[number], np.zeros(1, int), [] if known_start else [True]
        for arrives in pattern:
            after_loss = automaton.after_loss(state)
            fates.append(arrives or after_loss[0] < 0)
            state = automaton.after_delivery(state) if fates[-1] else after_loss
        run = simulate_continuous(system, horizon_s=horizon_s, delivered=fates, known_start=known_start)
        samples = run.at(np.linspace(0.0, run.diverged_at_s or horizon_s, _SAMPLES))
        sizes = {"e_c": run.e_c_norm(samples), "x": np.linalg.norm(samples.x, axis=1)}
        for quantity, norms in sizes.items():
            if certificate.has(quantity):
                bounds = certificate.bound(samples.t_s, quantity)
                share = max(share, float((norms / np.maximum(bounds, 1e-300)).max()))
    return share
