"""Checks every claim about a run against its record, after the run, in one pass.

What a certificate claims ends where the run does not conform to the certificate's loop document, and at the
first change of a setting on which the certificate depends. The identity (I1) holds across changes, and is
checked to the end of the run.

Certificates bound deviations from the reference; (I1) needs no such coordinates. The processes of a
stopped run end some milliseconds apart: claims are checked up to the last time that all of them
reached.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from cosim.analysis.claims.claim_catalogue import (
    Bound,
    ClaimDefinition,
    Envelope,
    claims_about,
    output_claims,
)
from cosim.analysis.claims.guarantee_claims import guarantee_claims
from cosim.analysis.claims.reference_deviations import deviations
from cosim.analysis.claims.run_certificates import RunCertificate
from cosim.analysis.claims.run_evidence import ROUNDING, ClaimEnd, RunEvidence, Samples, earliest
from cosim.analysis.conformance.common_end import common_end_ns, up_to_common_end
from cosim.analysis.conformance.recorded_loop import MOST_STEPS
from cosim.analysis.summary.summary_model import (
    NO_BOUND,
    Claim,
    ClaimCause,
    ClaimKind,
    ClaimVerdict,
    ConformancePart,
)
from cosim.record.decimation import decimate
from cosim.record.divergence import largest_reference
from cosim.record.run_events import changes_of
from cosim.record.run_record import RunRecord
from netem.core.clock import NS_PER_S
from netem.core.number_format import at_least, at_most
from noack.core.references import Reference
from noack.scenario.loads import first_load_change_s
from noack.scenario.resolution import loop_of
from noack.theory.certificates.conditions import NetworkConditions, jump_s


def unchecked(claimed: str, kind: ClaimKind, source: str, cause: ClaimCause, detail: str = "") -> Claim:
    """Return a claim of which nothing was compared."""
    return Claim(
        what=claimed, kind=kind, source=source, bound=NO_BOUND, certified=None, observed=None, ratio=None,
        verdict=ClaimVerdict.UNCHECKED, since_s=0.0, cause=cause, detail=detail, until_s=None,
    )  # fmt: skip


class ClaimCheck:
    """Checks a run against a bound, samples by samples, up to the end of the claim.

    Args:
        claimed: what is claimed.
        source: of the claim.
        until_s: end of the claim.
        end: from when on nothing is claimed, besides what the bound says.
    """

    def __init__(
        self,
        claimed: ClaimDefinition,
        source: str,
        until_s: float,
        end: ClaimEnd | None = None,
    ) -> None:
        self._claimed, self._source, self.until_s, self._end_of_all = claimed, source, until_s, end
        self._ratio: float | None = None
        self._exceeded_s: float | None = None
        self._bound: Bound | None = None

    @property
    def is_claimed(self) -> bool:
        """Whether there is a claim about the run: a value was compared, or the claim ended."""
        return self._bound is not None and (self._ratio is not None or self._end is not None)

    def add(self, bound: Bound) -> None:
        """Add the bound at the next samples; formula and constants are the same in every part."""
        self._bound = bound
        before_end = bound.t_s < self._end_s
        t_s, shares = bound.t_s[before_end], bound.shares[before_end]
        if not len(shares):
            return
        largest = float(shares.max())
        self._ratio = largest if self._ratio is None else float(np.maximum(self._ratio, largest))
        exceeded = np.flatnonzero(~(shares <= 1 + ROUNDING))
        if len(exceeded) and self._exceeded_s is None:
            self._exceeded_s = float(t_s[exceeded[0]])

    @property
    def _end(self) -> ClaimEnd | None:
        """What ends the claim early."""
        assert self._bound is not None
        end = earliest([self._bound.end, self._end_of_all])
        return end if end is not None and end.t_s < self.until_s else None

    @property
    def _end_s(self) -> float:
        return self.until_s if (end := self._end) is None else end.t_s

    def result(self) -> Claim:
        """Return the claim with its verdict, after the last samples."""
        bound, end, ratio, since_s = self._bound, self._end, self._ratio, self._exceeded_s
        assert bound is not None
        verdict, cause, detail = ClaimVerdict.HELD, None, ""
        if since_s is not None:
            verdict = ClaimVerdict.VIOLATED
            if self._claimed.needs_ideal_loop:
                verdict, cause = ClaimVerdict.NOT_APPLICABLE, ClaimCause.IDEAL_LOOP
        elif end is not None:
            verdict, since_s, cause, detail = ClaimVerdict.ENDED, end.t_s, end.cause, end.detail
        observed, constant = None, bound.constant
        if constant is not None and ratio is not None:
            observed = constant * ratio
            if bound.is_lower:
                observed = constant / ratio if ratio else None
        text = at_least(constant) if bound.is_lower else at_most(constant)
        return Claim(
            what=self._claimed.statement, kind=self._claimed.kind, source=self._source,
            bound=bound.formula.format(text),
            certified=constant, observed=observed, ratio=ratio, verdict=verdict,
            since_s=since_s, cause=cause, detail=detail,
            until_s=round(self.until_s, 9) if math.isfinite(self.until_s) else None,
            proved=self._claimed.is_certified or None,
            quantity=self._claimed.quantity,
            output=self._claimed.output,
            settles_s=self._claimed.settles_s,
        )  # fmt: skip


class _ClaimInstance(NamedTuple):
    """A claim about a run, by a certificate or without one."""

    claimed: ClaimDefinition
    evidence: RunEvidence
    """What it is checked against."""
    check: ClaimCheck
    curve: list[Envelope]
    """Its curve, from samples to samples."""
    certificate: RunCertificate | None = None

    def take(self, samples: Samples) -> None:
        """Check the next samples, and add to the curve, which is thinned if the run is long."""
        evidence = self.evidence
        certificate = None if self.certificate is None else self.certificate.certificate
        bound, envelope = self.claimed.find(evidence, samples, certificate)
        if evidence.facts.shares_an_update and bound is not None:
            self.check.add(bound)
        if envelope is None or (envelope.quantity == "inter_event" and self.curve):
            return  # the same line for all samples
        if envelope.quantity != "inter_event":
            keep = decimate(envelope.t_s, envelope.values, evidence.record.slice_columns)
            envelope = envelope._replace(t_s=envelope.t_s[keep], values=envelope.values[keep])
        self.curve.append(envelope)


@dataclass(eq=False)
class RunClaims:
    """The claims about a run; each property is computed once."""

    record: RunRecord
    certificates: Sequence[RunCertificate] | None = None
    """Those of the run's scenario, if they are known."""
    most_work: float = 0.0
    """Limit of the search for a witness; 0: only those are used that are known."""
    most_steps: int = MOST_STEPS
    """So many steps are compared with a loop document in all numbers."""

    @cached_property
    def _checked_record(self) -> RunRecord:
        return up_to_common_end(self.record)

    @property
    def judged_until_s(self) -> float | None:
        """End of the claims about a stopped run; None if they are checked to the end of the run."""
        end_ns = common_end_ns(self.record)
        return None if end_ns is None else end_ns / NS_PER_S

    @property
    def _reference(self) -> Reference | None:
        """What certificates bound the distance from: the reference, or the rest under constant loads."""
        loop = loop_of(self.record.scenario)
        if loop.reference is None and loop.loads:
            return Reference.constant(loop.rest, np.zeros(loop.m))  # the proof is about the inputs themselves
        return loop.reference

    @cached_property
    def evidence(self) -> RunEvidence:
        """What (I1) is checked against; certificates, too, if there is no reference."""
        certificates = self.certificates if self._reference is None else ()
        return self._evidence(self._checked_record, certificates)

    @cached_property
    def certified_evidence(self) -> RunEvidence:
        """What certificates are checked against: the run in deviations from its reference."""
        if (reference := self._reference) is None:
            return self.evidence
        moved = deviations(self._checked_record, reference)
        return self._evidence(moved, self.certificates, largest_reference(reference, self.record.scenario))

    def _evidence(
        self,
        record: RunRecord,
        certificates: Sequence[RunCertificate] | None = None,
        offset: float = 0.0,
    ) -> RunEvidence:
        changes = [change.first_ns for change in changes_of(self._checked_record) if change.touches_claims]
        until_s = changes[0] * 1e-9 if changes else math.inf  # as the times of samples are computed
        is_moved = record is not self._checked_record
        if is_moved and (at_s := jump_s(self.record.scenario)) is not None:
            until_s = min(until_s, at_s)
        until_s = min(until_s, first_load_change_s(self.record.scenario))
        return RunEvidence(
            record, self.record, until_s, certificates, offset, is_moved, self.most_work, self.most_steps
        )

    @property
    def _is_evaluated(self) -> bool:
        """Whether the claims are known already."""
        return "_checked" in vars(self)

    @property
    def largest_observed(self) -> dict[str, float | None]:
        """Largest observed value of each condition, over the whole run."""
        return self.evidence.largest_observed

    @property
    def allowed(self) -> NetworkConditions | None:
        """The conditions of the scenario's certificates; None if it can have none."""
        return None if self.record.scenario.protocol.acknowledges else self.evidence.allowed

    @property
    def certified_for(self) -> NetworkConditions | None:
        """The conditions of the certificates of the run's lateness, if they are used."""
        return self.certified_evidence.certified_for

    def evaluate(self) -> list[Claim]:
        """Return every claim with its verdict."""
        if not self.evidence.facts.shares_an_update:
            return []
        if self.record.scenario.protocol.acknowledges:
            what = "x_c − x_s is the sum of the missed jumps"
            i1 = unchecked(what, ClaimKind.IDENTITY, "(I1)", ClaimCause.ACKNOWLEDGED)
            return [*guarantee_claims(self._checked_record), i1]
        claims = guarantee_claims(self._checked_record)
        claims += [each.check.result() for each in self._claimed(None)]
        for certificate in self.certified_evidence.certificates:
            claimed = self._claimed(certificate)
            if (cause := self._cause(certificate, has_claims=bool(claimed))) is not None:
                what = f"a certificate for {certificate.certificate.scope}"
                claims.append(unchecked(what, ClaimKind.CERTIFICATE, certificate.certificate.source, *cause))
            claims += [each.check.result() for each in claimed]
        return claims

    def _claimed(self, certificate: RunCertificate | None) -> list["_ClaimInstance"]:
        """Return the claims of a certificate, or those that need none, about which the run says something."""
        own = [each for each in self._checked if each.certificate is certificate]
        return [each for each in own if each.check.is_claimed]

    def _cause(self, certificate: RunCertificate, *, has_claims: bool) -> tuple[ClaimCause, str] | None:
        """Return why nothing of a certificate was compared; None: something was."""
        if not certificate.certificate.exists:
            return ClaimCause.NO_CERTIFICATE, certificate.certificate.void or ""
        end = self.certified_evidence.end_of(certificate)
        if end is not None and end.cause is ClaimCause.NO_DOCUMENT:
            return end.cause, end.detail
        if has_claims:
            return None
        return ClaimCause.CHANGED, f"{self.certified_evidence.until_s:.3f}"

    def conformance(self) -> list[ConformancePart]:
        """Return for each certificate whether the run is one of its loop document."""
        if not self.evidence.facts.shares_an_update or self.record.scenario.protocol.acknowledges:
            return []
        evidence, parts = self.certified_evidence, list[ConformancePart]()
        for certificate in evidence.certificates:
            if not certificate.certificate.exists:
                continue
            source, end = certificate.certificate.source, evidence.end_of(certificate)
            if certificate.document is None or (end and end.cause is ClaimCause.NO_DOCUMENT):
                missing = certificate.missing if end is None else end.detail
                parts.append(ConformancePart(certificate=source, document="", missing=missing))
            else:
                parts.append(ConformancePart.of(evidence.conformance_of(certificate.document), source))
        return parts

    @cached_property
    def _checked(self) -> list[_ClaimInstance]:
        """All claims, checked in one pass over the run; with a reference, in one for each evidence."""
        instances = list(self._instances())
        for evidence in dict.fromkeys((self.certified_evidence, self.evidence)):
            for samples in evidence.samples():
                for instance in instances:
                    if instance.evidence is evidence:
                        instance.take(samples)
        return instances

    def _instances(self) -> Iterator[_ClaimInstance]:
        """Yield the claims of each certificate, and those that need none."""
        certified, claims = self.certified_evidence, claims_about(self.record.scenario)
        for certificate in certified.certificates:
            if not certificate.certificate.exists:
                continue
            end, source = certified.end_of(certificate), certificate.certificate.source
            if end is not None and end.cause is ClaimCause.NO_DOCUMENT:
                continue
            for claim in (*output_claims(certified, certificate.certificate), *claims):
                if claim.is_certified:
                    check = ClaimCheck(claim, source, certified.until_s, end)
                    yield _ClaimInstance(claim, certified, check, [], certificate)
        for claim in claims:
            if not claim.is_certified:
                evidence, until_s = (
                    (self.evidence, math.inf) if claim.to_the_end else (certified, certified.until_s)
                )
                check = ClaimCheck(claim, claim.source, until_s)
                yield _ClaimInstance(claim, evidence, check, [])

    def envelopes(self) -> list[Envelope]:
        """The curves of all bounds of the run itself, each to its end; those of a long run are thinned."""
        scenario = self.record.scenario
        if scenario.protocol.acknowledges:
            return []
        if scenario.plant.system.runs_user_code and not self._is_evaluated:
            self.certificates = ()  # reading a finished run does not run the code of its plant
        envelopes = []
        for instance in self._checked:
            # Other bounds hold for deviations from a reference, as those of outputs do.
            is_of_run = instance.evidence is self.evidence or instance.claimed.output is not None
            if (curve := instance.curve) and is_of_run:
                t_s = np.concatenate([part.t_s for part in curve])
                values = np.concatenate([part.values for part in curve])
                whole = curve[0]._replace(t_s=t_s, values=values)
                envelopes.append(_envelope_until(whole, instance.check.until_s))
        return envelopes


@lru_cache(maxsize=1)
def claims_of(record: RunRecord) -> "RunClaims":
    """Return the claims about a run; the summary and the report use the same ones."""
    return RunClaims(record)


def _envelope_until(envelope: Envelope, until_s: float) -> Envelope:
    if envelope.quantity == "inter_event":  # two ends of a line
        return envelope._replace(t_s=np.minimum(envelope.t_s, until_s))
    return envelope._replace(values=np.where(envelope.t_s < until_s, envelope.values, np.nan))
