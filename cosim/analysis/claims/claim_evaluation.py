"""Checks every claim about a run against its record."""

from cosim.analysis.claims.claim import Claim, Envelope, void_claim
from cosim.analysis.claims.claim_definition import (
    IDEAL_LOOP,
    certified_claims,
    check,
    run_claims,
)
from cosim.analysis.claims.observed_conditions import VoidFrom
from cosim.analysis.claims.run_evidence import RunEvidence
from noack.theory.scenario_certificates import OWN_PLANT, ScenarioCertificate, outside_box

_NO_CLAIM = void_claim(
    "x_c − x_s is the sum of the missed jumps", "(I1)", 0.0,
    'network.protocol = "ack": x_s is reset when an update is acknowledged, and not at every '
    "event as (I1), and every claim that follows from it, assumes",
)  # fmt: skip


class ClaimEvaluation(RunEvidence):
    """The claims about one run, or about one part of it."""

    def judge(self) -> list[Claim]:
        """Return every claim with its verdict."""
        if not len(self.joined.t_ns) or not self.in_common.any():
            return []
        if self.record.scenario.protocol.acknowledges:
            return [_NO_CLAIM]
        found: list[Claim] = []
        for claim in run_claims():
            if (bound := claim.bound(self)) is not None:
                unmet = IDEAL_LOOP if claim.needs_ideal_loop else ""
                found.append(check(bound, claim.statement, claim.source, self.until_s, unmet))
        for certificate in self.certificates:
            found += self._certified(certificate)
        return found

    def _certified(self, certificate: ScenarioCertificate) -> list[Claim]:
        source = certificate.source
        if certificate.constants is None:
            what = f"a certificate for {certificate.scope}"
            return [void_claim(what, source, 0.0, certificate.void or "")]
        outside = outside_box(self.record.scenario) if certificate.scope != OWN_PLANT else None
        found = []
        for claim in certified_claims():
            if (bound := claim.bound(self, certificate)) is not None:
                if outside is not None:
                    bound = bound._replace(void=VoidFrom(0.0, outside))
                found.append(check(bound, claim.statement, source, self.until_s))
        return found

    def envelopes(self) -> list[Envelope]:
        """The curves of all bounds."""
        if self.record.scenario.protocol.acknowledges:
            return []
        found = [
            claim.envelope(self, certificate)
            for certificate in self.certificates
            if certificate.constants is not None
            for claim in certified_claims()
        ]
        found += [claim.envelope(self) for claim in run_claims()]
        return [envelope for envelope in found if envelope is not None]
