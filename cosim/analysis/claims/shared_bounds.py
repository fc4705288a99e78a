"""Bounds that several claims share: of ‖e_c‖ and of the inter-event time."""

import numpy as np

from cosim.analysis.claims.claim import Envelope, Reals
from cosim.analysis.claims.claim_definition import ROUNDING, Bound, upper_shares
from cosim.analysis.claims.observed_conditions import VoidFrom, earliest
from cosim.analysis.claims.run_evidence import RunEvidence
from noack.core.linear_systems import row_norms


def controller_error_bound(
    run: RunEvidence,
    formula: str,
    values: Reals,
    constant: float | None = None,
    void: VoidFrom | None = None,
) -> Bound:
    """Return a bound of ‖e_c‖_W at the measurements, (k,); it is void from a record's first gap."""
    here = run.in_common
    # Allow for the rounding of x, which matters for a bound of that size.
    slack = ROUNDING * row_norms(run.joined.x[here])
    shares = upper_shares(run.joined.e_c_norm[here], values[here] + slack)
    return Bound(formula, run.t_s[here], shares, earliest([void, run.first_gap]), constant)


def inter_event_bound(run: RunEvidence, least_s: float, void: VoidFrom | None) -> Bound:
    """Return a lower bound of the inter-event time."""
    t_s, passed_s = run.inter_event_s
    formula = "t_(i+1) − t_i ≥ {:.4g} s"
    return Bound(formula, t_s, least_s / passed_s, void, least_s, is_lower=True)


def inter_event_envelope(run: RunEvidence, label: str, least_s: float) -> Envelope:
    """Return the same bound as a line over the run."""
    ends_s = np.array([0.0, run.record.scenario.horizon_s])
    return Envelope(label, "inter_event", ends_s, np.full(2, least_s))
