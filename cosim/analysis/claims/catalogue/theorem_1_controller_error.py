"""Theorem 1 of the paper, and Theorem 3 for a hold: ‖e_c‖ ≤ Δ βe^{−αt} (eq:Normec).

Its Δ is that of the run's trajectory (:mod:`cosim.analysis.claims.trajectory_delta`).
"""

import numpy as np

from cosim.analysis.claims.claim_definition import Bound, ClaimDefinition, controller_error_bound
from cosim.analysis.claims.run_evidence import RunEvidence, Samples


def _bound(run: RunEvidence, samples: Samples) -> Bound | None:
    scenario = run.record.scenario
    if (
        not scenario.coverage.is_certifiable
        or not scenario.coverage.is_undisturbed
        or not scenario.coverage.is_decaying
        or scenario.decaying.floor > 0
    ):
        return None
    if (delta := run.trajectory_delta) is None:
        return None
    level = scenario.decaying.beta * np.exp(-scenario.decaying.alpha_per_s * samples.t_s)
    bound = "‖e_c‖ ≤ {:.4g} βe^(−αt)"
    return controller_error_bound(run, samples, bound, delta * level, delta, run.paper_violation)


CLAIM = ClaimDefinition(
    "the controller's error decays", "Theorem 1 (3 for a hold), Δ from this run's trajectory",
    "a continuous trigger, a network without delay, at most M − 1 consecutive losses",
    _bound, needs_ideal_loop=True,
)  # fmt: skip
