"""A certificate's bound of ‖x‖: X e^{−rt}, and a constant from the time of the floor on."""

from cosim.analysis.claims.claim_definition import (
    Bound,
    CertifiedClaim,
    Envelope,
    upper_shares,
)
from cosim.analysis.claims.run_evidence import RunEvidence, Samples
from noack.core.linear_systems import row_norms
from noack.theory.certificates.certified_bounds import ScenarioCertificate, envelope_formula


def _bound(run: RunEvidence, samples: Samples, certificate: ScenarioCertificate) -> Bound | None:
    if (constants := certificate.constants) is None:
        return None
    formula = envelope_formula("‖x‖", certificate, "state")
    here = samples.with_x
    t_s, void = samples.t_s[here], run.violation_of(certificate)
    shares = upper_shares(row_norms(samples.true_x[here]), certificate.state(t_s))
    return Bound(formula, t_s, shares, void, constants.state)


def _envelope(run: RunEvidence, samples: Samples, certificate: ScenarioCertificate) -> Envelope:
    values = certificate.state(samples.t_s)
    return Envelope(f"certified for {certificate.scope}", "x", samples.t_s, values)


CLAIM = CertifiedClaim("the state is bounded", _bound, _envelope)
