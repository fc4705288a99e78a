"""A certificate's bound of ‖e_s‖ with a sampled trigger: a multiple of the threshold."""

from cosim.analysis.claims.claim_definition import (
    ROUNDING,
    Bound,
    CertifiedClaim,
    upper_shares,
)
from cosim.analysis.claims.run_evidence import RunEvidence, Samples
from noack.core.linear_systems import row_norms
from noack.theory.certificates.certified_bounds import ScenarioCertificate, envelope_formula


def _bound(run: RunEvidence, samples: Samples, certificate: ScenarioCertificate) -> Bound | None:
    if certificate.constants is None:
        return None
    formula = envelope_formula("‖e_s‖", certificate, "overshoot")
    slack = ROUNDING * row_norms(samples.joined.x)
    shares = upper_shares(samples.joined.e_s_norm, certificate.sensor_error(samples.t_s) + slack)
    void, overshoot = run.violation_of(certificate), certificate.constants.overshoot
    return Bound(formula, samples.t_s, shares, void, overshoot)


CLAIM = CertifiedClaim("the sensor's error is bounded", _bound)
