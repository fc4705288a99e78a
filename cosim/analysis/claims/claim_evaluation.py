"""Checks every claim about a run against its record."""

import importlib
import math
import pkgutil
from typing import TypeVar

import numpy as np

from cosim.analysis.claims import catalogue
from cosim.analysis.claims.claim_definition import (
    ROUNDING,
    Bound,
    CertifiedClaim,
    ClaimDefinition,
    Envelope,
)
from cosim.analysis.claims.observed_conditions import VoidFrom
from cosim.analysis.claims.run_evidence import RunEvidence
from cosim.analysis.summary_model import Claim, ClaimVerdict
from noack.theory.scenario_certificates import OWN_PLANT, ScenarioCertificate, outside_box

_IDEAL_LOOP = (
    "assumes a continuous trigger, and a network and input without delay, which no sampled loop has"
)
_ACKNOWLEDGED = (
    'network.protocol = "ack": x_s is reset when an update is acknowledged, and not at every '
    "event as (I1), and every claim that follows from it, assumes"
)
_Kind = TypeVar("_Kind", ClaimDefinition, CertifiedClaim)


def definitions(kind: type[_Kind]) -> list[_Kind]:
    """Return the claims ``CLAIM`` of a kind in the files of ``catalogue/``, in alphabetical order.

    Certified claims are those of a certificate; the others need none.
    """
    names = sorted(found.name for found in pkgutil.iter_modules(catalogue.__path__))
    every = [importlib.import_module(f"{catalogue.__name__}.{name}").CLAIM for name in names]
    return [claim for claim in every if isinstance(claim, kind)]


def void_claim(
    what: str, source: str, since_s: float, why: str, until_s: float | None = None
) -> Claim:
    """Return a claim that cannot be checked because there is no bound."""
    return Claim(
        what=what, source=source, bound="none", certified=None, observed=None, ratio=None,
        verdict=ClaimVerdict.VOID, since_s=since_s, why=why, from_s=since_s, until_s=until_s,
    )  # fmt: skip


def check(
    bound: Bound, statement: str, source: str, until_s: float = math.inf, unmet: str = ""
) -> Claim:
    """Check a run against a bound up to the end of the claim.

    If the run cannot meet an assumption, ``unmet`` names it.
    """
    void = bound.void if bound.void is not None and bound.void.t_s < until_s else None
    end_s = until_s if void is None else void.t_s
    t_s, shares = bound.t_s[bound.t_s < end_s], bound.shares[bound.t_s < end_s]
    exceeded = np.flatnonzero(~(shares <= 1 + ROUNDING))
    ratio = float(shares.max()) if len(shares) else None
    why = unmet
    if len(exceeded):
        verdict = ClaimVerdict.NOT_APPLICABLE if unmet else ClaimVerdict.VIOLATED
        since_s: float | None = float(t_s[exceeded[0]])
    elif void is not None:
        verdict, since_s = ClaimVerdict.VOID, void.t_s
        why = "; ".join(filter(None, [unmet, void.why]))
    else:
        verdict, since_s = ClaimVerdict.HELD, None
    observed, constant = None, bound.constant
    if constant is not None and ratio is not None:
        observed = constant * ratio
        if bound.is_lower:
            observed = constant / ratio if ratio else None
    formula = bound.formula if constant is None else bound.formula.format(constant)
    return Claim(
        what=statement, source=source, bound=formula, certified=constant, observed=observed,
        ratio=ratio, verdict=verdict, since_s=since_s, why=why, from_s=0.0, until_s=None,
    )  # fmt: skip


class ClaimEvaluation(RunEvidence):
    """The claims about one run, or about one part of it."""

    def judge(self) -> list[Claim]:
        """Return every claim with its verdict."""
        if not len(self.joined.t_ns) or not self.in_common.any():
            return []
        if self.record.scenario.protocol.acknowledges:
            what = "x_c − x_s is the sum of the missed jumps"
            return [void_claim(what, "(I1)", 0.0, _ACKNOWLEDGED)]
        found: list[Claim] = []
        for claim in definitions(ClaimDefinition):
            if (bound := claim.bound(self)) is not None:
                unmet = _IDEAL_LOOP if claim.needs_ideal_loop else ""
                found.append(check(bound, claim.statement, claim.source, self.part.until_s, unmet))
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
        for claim in definitions(CertifiedClaim):
            if (bound := claim.bound(self, certificate)) is not None:
                if outside is not None:
                    bound = bound._replace(void=VoidFrom(0.0, outside))
                found.append(check(bound, claim.statement, source, self.part.until_s))
        return found

    def envelopes(self) -> list[Envelope]:
        """The curves of all bounds."""
        if self.record.scenario.protocol.acknowledges:
            return []
        found = [
            claim.envelope(self, certificate)
            for certificate in self.certificates
            if certificate.constants is not None
            for claim in definitions(CertifiedClaim)
        ]
        found += [claim.envelope(self) for claim in definitions(ClaimDefinition)]
        return [envelope for envelope in found if envelope is not None]
