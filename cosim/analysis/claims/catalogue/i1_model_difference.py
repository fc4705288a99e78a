"""(I1): x_c − x_s = Σ e^{H(t−t_k)} e_s(t_k⁻) over the events that the controller missed.

This identity follows from the update laws, for every plant, trigger and network. The run must meet
it up to rounding: the residual is divided by the larger of both models' states and by the relative
rounding error.
"""

import numpy as np

from cosim.analysis.claims.claim_definition import Bound, ClaimDefinition
from cosim.analysis.claims.run_evidence import RunEvidence, Samples
from noack.core.linear_systems import transition

_LEAST_MARGIN, _LARGEST_MARGIN = 1e-9, 1e-6


def _bound(run: RunEvidence, samples: Samples) -> Bound:
    here, margin = samples.in_common, _margin(run)
    residual = samples.residual[here]
    # Use the larger model state, since a missed update may have moved x_c far from x_s.
    scale = max(run.facts.largest_state, float(np.finfo(float).tiny))
    formula = "x_c − x_s = Σ e^(H(t−t_k)) e_s(t_k), relative residual ≤ {:.0e}"
    return Bound(formula, samples.t_s[here], residual / (margin * scale), run.first_gap, margin)


def _margin(run: RunEvidence) -> float:
    """Return the relative rounding error that the models may accumulate between two deliveries.

    It is n ε sup‖e^{Hτ}‖ over the time τ between deliveries, at most 1e-6.
    """
    loop, period_ns = run.record.loop, run.record.scenario.timing.measurement_period_ns
    longest_ns = run.facts.longest_update_ns
    growth, age_ns, moved = 1.0, period_ns, transition(loop.H, period_ns)
    while age_ns <= longest_ns and growth < 1 / np.finfo(float).eps:
        growth = max(growth, float(np.linalg.norm(moved)))
        age_ns, moved = 2 * age_ns, moved @ moved
    rounding = loop.n * float(np.finfo(float).eps) * growth
    return max(_LEAST_MARGIN, min(rounding, _LARGEST_MARGIN))


CLAIM = ClaimDefinition(
    "x_c − x_s is the sum of the missed jumps", "(I1)", "a complete record", _bound
)
