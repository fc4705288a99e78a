"""A certificate's bound of ‖e_c‖ for the number of events that are missing at the controller."""

import numpy as np

from cosim.analysis.claims.claim_definition import (
    Bound,
    CertifiedClaim,
    Envelope,
    controller_error_bound,
)
from cosim.analysis.claims.run_evidence import RunEvidence, Samples
from noack.theory.certificates.certified_bounds import ScenarioCertificate


def _bound(run: RunEvidence, samples: Samples, certificate: ScenarioCertificate) -> Bound | None:
    if (bounds := run.known_state_bounds(certificate)) is None:
        return None
    values = bounds.controller_error(samples.t_s, samples.since_event.missing)
    formula = "‖e_c‖ ≤ (1 + Σ_(i<j) sup_(τ≥iδ) ‖e^((H+αI)τ)‖) β̃e^(−αt), j events missing"
    void = run.violation_of(certificate)
    return controller_error_bound(run, samples, formula, values, void=void)


def _envelope(
    run: RunEvidence, samples: Samples, certificate: ScenarioCertificate
) -> Envelope | None:
    if (bounds := run.known_state_bounds(certificate)) is None:
        return None
    values = bounds.controller_error(samples.t_s, samples.since_event.missing)
    label = "certified for the missing events"
    return Envelope(label, "e_c", samples.t_s, np.where(samples.in_common, values, np.nan))


CLAIM = CertifiedClaim(
    "the controller's error is bounded by the events it misses", _bound, _envelope
)
