"""A certificate's lower bound of the inter-event time."""

from cosim.analysis.claims.claim_definition import (
    Bound,
    CertifiedClaim,
    Envelope,
    inter_event_bound,
    inter_event_envelope,
)
from cosim.analysis.claims.run_evidence import RunEvidence, Samples
from noack.theory.certificates.certified_bounds import ScenarioCertificate


def _bound(run: RunEvidence, samples: Samples, certificate: ScenarioCertificate) -> Bound | None:
    if certificate.inter_event_s is None:
        return None
    return inter_event_bound(samples, certificate.inter_event_s, run.violation_of(certificate))


def _envelope(
    run: RunEvidence, samples: Samples, certificate: ScenarioCertificate
) -> Envelope | None:
    if certificate.inter_event_s is None:
        return None
    label = f"certified for {certificate.scope}"
    return inter_event_envelope(run, label, certificate.inter_event_s)


CLAIM = CertifiedClaim("minimum inter-event time", _bound, _envelope)
