"""A certificate's bound of ‖x̂ − x‖_W at the measurements, with noise or an observer."""

import numpy as np

from cosim.analysis.claims.claim_definition import (
    Bound,
    CertifiedClaim,
    upper_shares,
)
from cosim.analysis.claims.run_evidence import RunEvidence, Samples
from noack.core.linear_systems import row_norms
from noack.theory.certificates.certified_bounds import ScenarioCertificate, envelope_formula


def _bound(run: RunEvidence, samples: Samples, certificate: ScenarioCertificate) -> Bound | None:
    scenario, loop = run.record.scenario, run.record.loop
    if certificate.constants is None or scenario.coverage.knows_state:
        return None
    weight = np.eye(loop.n) if loop.weight is None else loop.weight
    here = samples.with_x
    t_s = samples.t_s[here]
    errors = row_norms((samples.joined.x[here] - samples.true_x[here]) @ weight.T)
    formula = envelope_formula("‖x̂ − x‖", certificate, "estimation_error")
    shares = upper_shares(errors, certificate.estimation_error(t_s))
    return Bound(
        formula, t_s, shares, run.violation_of(certificate), certificate.constants.estimation_error
    )


CLAIM = CertifiedClaim("the estimation error is bounded", _bound)
