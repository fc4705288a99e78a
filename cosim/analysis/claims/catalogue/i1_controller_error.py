"""(I1) with the triangle inequality: ‖e_c‖ ≤ ‖e_s‖ + Σ ‖e^{H(t−t_k)} e_s(t_k⁻)‖.

It holds for every plant, trigger and network. If the sensor estimates x, the error is x_c − x̂.
"""

from cosim.analysis.claims.claim_definition import (
    Bound,
    ClaimDefinition,
    Envelope,
    controller_error_bound,
)
from cosim.analysis.claims.run_evidence import RunEvidence, Samples


def _bound(run: RunEvidence, samples: Samples) -> Bound:
    error = "e_c" if run.record.scenario.coverage.knows_state else "x_c − x̂"
    formula = f"‖{error}‖ ≤ ‖e_s‖ + Σ ‖e^(H(t−t_k)) e_s(t_k)‖"
    return controller_error_bound(run, samples, formula, samples.error_bounds[0])


CLAIM = ClaimDefinition(
    "the controller's error is at most the sensor's error plus the missed jumps",
    "(I1)", "a complete record", _bound,
    lambda run, samples: Envelope(
        "bound from (I1)", "e_c", samples.t_s, samples.error_bounds[0], "identity"
    ),
)  # fmt: skip
