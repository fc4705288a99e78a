"""A certificate's bound of ‖e_c‖: Δ times the threshold."""

from cosim.analysis.claims.claim_definition import (
    Bound,
    CertifiedClaim,
    Envelope,
    controller_error_bound,
)
from cosim.analysis.claims.run_evidence import RunEvidence, Samples
from noack.theory.certificates.certified_bounds import ScenarioCertificate, envelope_formula


def _bound(run: RunEvidence, samples: Samples, certificate: ScenarioCertificate) -> Bound | None:
    if certificate.constants is None:
        return None
    formula = envelope_formula("‖e_c‖", certificate, "delta")
    values, void = certificate.controller_error(samples.t_s), run.violation_of(certificate)
    return controller_error_bound(run, samples, formula, values, certificate.constants.delta, void)


def _envelope(run: RunEvidence, samples: Samples, certificate: ScenarioCertificate) -> Envelope:
    values = certificate.controller_error(samples.t_s)
    return Envelope(f"certified for {certificate.scope}", "e_c", samples.t_s, values)


CLAIM = CertifiedClaim("the controller's error is bounded", _bound, _envelope)
