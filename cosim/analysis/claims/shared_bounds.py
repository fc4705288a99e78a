"""Bounds that several claims have in common: of ‖e_c‖, and of the time between two events."""

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
    """A bound of ‖e_c‖_W at the measurements, (k,); it also needs a complete record."""
    here = run.in_common
    # x itself is rounded, which counts where a bound is that small.
    slack = ROUNDING * row_norms(run.joined.x[here])
    shares = upper_shares(run.joined.e_c_norm[here], values[here] + slack)
    return Bound(formula, run.t_s[here], shares, earliest([void, run.first_gap]), constant)


def inter_event_bound(run: RunEvidence, least_s: float, void: VoidFrom | None) -> Bound:
    """A lower bound of the time between two events."""
    t_s, passed_s = run.inter_event_s
    formula = "t_(i+1) − t_i ≥ {:.4g} s"
    return Bound(formula, t_s, least_s / passed_s, void, least_s, is_lower=True)


def inter_event_envelope(run: RunEvidence, label: str, least_s: float) -> Envelope:
    """The same bound as a line over the run."""
    ends_s = np.array([0.0, run.record.scenario.horizon_s])
    return Envelope(label, "inter_event", ends_s, np.full(2, least_s))
