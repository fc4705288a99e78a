"""eq:LossEv3 of the paper: ‖e_c‖ ≤ βe^{−αt} + Σ βe^{−αt_k} ‖e^{H(t−t_k)}‖ over the missed events.

The paper assumes a continuous trigger, so that ‖e_s‖ ≤ βe^{−αt} at all times.
"""

from cosim.analysis.claims.claim_definition import Bound, ClaimDefinition, controller_error_bound
from cosim.analysis.claims.run_evidence import RunEvidence, Samples


def _bound(run: RunEvidence, samples: Samples) -> Bound | None:
    # Estimates and noise jump at every measurement, so no trigger keeps e_s below a threshold.
    if not run.record.scenario.coverage.is_decaying or not run.record.scenario.coverage.knows_state:
        return None
    formula = "‖e_c‖ ≤ βe^(−αt) + Σ βe^(−αt_k) ‖e^(H(t−t_k))‖"
    return controller_error_bound(run, samples, formula, samples.error_bounds[1])


CLAIM = ClaimDefinition(
    "the paper's bound of the controller's error", "eq:LossEv3",
    "a continuous trigger, a network without delay", _bound, needs_ideal_loop=True,
)  # fmt: skip
