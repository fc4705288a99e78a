"""A certificate's bound of ‖x‖ from the newest event on: its prediction, and what moves x from it.

What is checked is the deviation of x from the prediction, which is the larger claim.
"""

import numpy as np

from cosim.analysis.claims.claim_definition import (
    ROUNDING,
    Bound,
    CertifiedClaim,
    Envelope,
    upper_shares,
)
from cosim.analysis.claims.run_evidence import RunEvidence, Samples
from noack.core.linear_systems import row_norms
from noack.theory.certificates.certified_bounds import ScenarioCertificate


def _bound(run: RunEvidence, samples: Samples, certificate: ScenarioCertificate) -> Bound | None:
    if (bounds := run.known_state_bounds(certificate)) is None:
        return None
    since, here = samples.since_event, samples.with_x & ~np.isnan(samples.since_event.age_s)
    t_s, predicted = samples.t_s[here], since.predicted[here]
    missing = run.missing_events(samples, bounds)[here]
    most = bounds.state_deviation(t_s, since.age_s[here], missing)
    deviation = row_norms(samples.true_x[here] - predicted)
    shares = upper_shares(deviation, most + ROUNDING * row_norms(predicted))
    formula = "‖x − e^((A+BK)(t−t_k)) x(t_k)‖ ≤ ∫‖e^((A+BK)s) B‖ ‖u − Kx‖ds, since the event t_k"
    return Bound(formula, t_s, shares, run.violation_of(certificate))


def _envelope(
    run: RunEvidence, samples: Samples, certificate: ScenarioCertificate
) -> Envelope | None:
    if (bounds := run.known_state_bounds(certificate)) is None:
        return None
    t_s, since, missing = samples.t_s, samples.since_event, run.missing_events(samples, bounds)
    values = row_norms(since.predicted) + bounds.state_deviation(t_s, since.age_s, missing)
    label = "certified from the newest event"
    return Envelope(label, "x", t_s, np.fmin(values, certificate.state(t_s)))


CLAIM = CertifiedClaim("the state is bounded from the newest event on", _bound, _envelope)
