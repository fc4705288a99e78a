"""(I1): x_c − x_s = Σ e^{H(t−t_k)} e_s(t_k⁻) over the events that the controller missed.

This identity follows from the update laws, for every plant, trigger and network. The run must meet
it up to rounding: the residual is divided by the larger of both models' states and by the relative
rounding error.
"""

import numpy as np

from cosim.analysis.claims.claim_definition import Bound, ClaimDefinition
from cosim.analysis.claims.run_evidence import RunEvidence
from cosim.record.align import identity_residual
from noack.core.linear_systems import transition

_LEAST_MARGIN, _LARGEST_MARGIN = 1e-9, 1e-6


def _bound(run: RunEvidence) -> Bound:
    here, margin = run.in_common, _margin(run)
    residual = identity_residual(run.record, run.joined)[here]
    # Use the larger model state, since a missed update may have moved x_c far from x_s.
    before_end = run.t_s < run.part.until_s
    both = np.concatenate([run.joined.x_s[before_end], run.joined.x_c[here & before_end]])
    scale = max(float(np.abs(both).max(initial=0.0)), np.finfo(float).tiny)
    formula = "x_c − x_s = Σ e^(H(t−t_k)) e_s(t_k), relative residual ≤ {:.0e}"
    return Bound(formula, run.t_s[here], residual / (margin * scale), run.first_gap, margin)


def _margin(run: RunEvidence) -> float:
    """Return the relative rounding error that the models may accumulate between two deliveries.

    It is n ε sup‖e^{Hτ}‖ over the time τ between deliveries, at most 1e-6.
    """
    loop, period_ns = run.record.loop, run.record.scenario.timing.measurement_period_ns
    fresh_ns = run.joined.t_ns[np.flatnonzero(np.diff(run.joined.received, prepend=-1))]
    ends_ns = np.append(fresh_ns, run.joined.t_ns[-1])
    longest_ns = int(np.diff(ends_ns).max(initial=0))
    growth, age_ns, moved = 1.0, period_ns, transition(loop.H, period_ns)
    while age_ns <= longest_ns and growth < 1 / np.finfo(float).eps:
        growth = max(growth, float(np.linalg.norm(moved)))
        age_ns, moved = 2 * age_ns, moved @ moved
    rounding = loop.n * float(np.finfo(float).eps) * growth
    return max(_LEAST_MARGIN, min(rounding, _LARGEST_MARGIN))


CLAIM = ClaimDefinition(
    "x_c − x_s is the sum of the missed jumps", "(I1)", "a complete record", _bound
)
