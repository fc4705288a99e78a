"""Checks every claim about a run against its record, after the run, in one pass.

What a certificate claims ends at the first change of a setting on which the certificate depends. The
identity (I1) holds across changes, and is checked to the end of the run.

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
from cosim.analysis.claims.common_end import common_end_ns, up_to_common_end
from cosim.analysis.claims.observed_conditions import AssumptionViolation, VoidFrom
from cosim.analysis.claims.reference_deviations import deviations
from cosim.analysis.claims.run_evidence import ROUNDING, RunEvidence, Samples
from cosim.analysis.summary.summary_model import NO_BOUND, Claim, ClaimVerdict, ViolationPart
from cosim.record.decimation import decimate
from cosim.record.divergence import largest_reference
from cosim.record.run_events import changes_of
from cosim.record.run_record import RunRecord
from noack.core.clock import NS_PER_S
from noack.core.number_format import at_least, at_most
from noack.core.references import Reference
from noack.scenario.loads import first_load_change_s
from noack.scenario.resolution import loop_of
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import BOX, NetworkConditions, jump_s, outside_box

_IDEAL_LOOP = "assumes a continuous trigger, and a network and input without delay, which no sampled loop has"
_ACKNOWLEDGED = (
    'network.protocol = "ack": x_s is reset when an update is acknowledged, and not at every '
    "event as (I1), and every claim that follows from it, assumes"
)


def void_claim(claimed: str, source: str, why: str) -> Claim:
    """Return a claim that cannot be checked because there is no bound."""
    return Claim(
        what=claimed, source=source, bound=NO_BOUND, certified=None, observed=None, ratio=None,
        verdict=ClaimVerdict.VOID, since_s=0.0, why=why, until_s=None,
    )  # fmt: skip


class ClaimCheck:
    """Checks a run against a bound, samples by samples, up to the end of the claim.

    Args:
        claimed: what is claimed.
        source: of the claim.
        until_s: end of the claim.
        unmet: an assumption that the run cannot meet.
    """

    def __init__(
        self,
        claimed: ClaimDefinition,
        source: str,
        until_s: float,
        unmet: str = "",
    ) -> None:
        self._claimed, self._source, self.until_s, self._unmet = claimed, source, until_s, unmet
        self._ratio: float | None = None
        self._exceeded_s: float | None = None
        self._bound: Bound | None = None

    @property
    def is_claimed(self) -> bool:
        """Whether there is a claim about the run: a value was compared, or an assumption violated."""
        return self._bound is not None and (self._ratio is not None or self._void is not None)

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
    def _void(self) -> VoidFrom | None:
        """The violated assumption that ends the claim early."""
        assert self._bound is not None
        void = self._bound.void
        return void if void is not None and void.t_s < self.until_s else None

    @property
    def _end_s(self) -> float:
        return self.until_s if (void := self._void) is None else void.t_s

    def result(self) -> Claim:
        """Return the claim with its verdict, after the last samples."""
        bound, void, why, ratio = self._bound, self._void, self._unmet, self._ratio
        assert bound is not None
        since_s = self._exceeded_s
        if since_s is not None:
            verdict = ClaimVerdict.NOT_APPLICABLE if self._unmet else ClaimVerdict.VIOLATED
        elif void is not None:
            verdict, since_s = ClaimVerdict.VOID, void.t_s
            why = "; ".join(filter(None, [self._unmet, void.why]))
        else:
            verdict = ClaimVerdict.HELD
        observed, constant = None, bound.constant
        if constant is not None and ratio is not None:
            observed = constant * ratio
            if bound.is_lower:
                observed = constant / ratio if ratio else None
        text = at_least(constant) if bound.is_lower else at_most(constant)
        return Claim(
            what=self._claimed.statement, source=self._source, bound=bound.formula.format(text),
            certified=constant, observed=observed, ratio=ratio, verdict=verdict,
            since_s=since_s, why=why,
            until_s=round(self.until_s, 9) if math.isfinite(self.until_s) else None,
            proved=self._claimed.is_certified or None,
            output=self._claimed.output,
        )  # fmt: skip


class _ClaimInstance(NamedTuple):
    """A claim about a run, by a certificate or without one."""

    claimed: ClaimDefinition
    evidence: RunEvidence
    """What it is checked against."""
    check: ClaimCheck
    curve: list[Envelope]
    """Its curve, from samples to samples."""
    certificate: ScenarioCertificate | None = None
    outside: str | None = None
    """Why the certificate does not cover the run's plant."""

    def take(self, samples: Samples) -> None:
        """Check the next samples, and add to the curve, which is thinned if the run is long."""
        evidence = self.evidence
        bound, envelope = self.claimed.find(evidence, samples, self.certificate)
        if evidence.facts.shares_an_update and bound is not None:
            if self.outside is not None:
                bound = bound._replace(void=VoidFrom(0.0, self.outside))
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
    certificates: Sequence[ScenarioCertificate] | None = None
    """Those of the run's scenario, if they are known. They are not those of a run with a reference, which
    are about it: these are computed here, with the witnesses that were found for the others."""
    most_work: float = 0.0
    """Limit of the search for a witness; 0: only those are used that are known."""

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
        return self._evidence(moved, None, largest_reference(reference, self.record.scenario))

    def _evidence(
        self,
        record: RunRecord,
        certificates: Sequence[ScenarioCertificate] | None = None,
        offset: float = 0.0,
    ) -> RunEvidence:
        changes = [change.first_ns for change in changes_of(self._checked_record) if change.touches_claims]
        until_s = changes[0] * 1e-9 if changes else math.inf  # as the times of samples are computed
        if record is not self._checked_record and (at_s := jump_s(self.record.scenario)) is not None:
            until_s = min(until_s, at_s)
        until_s = min(until_s, first_load_change_s(self.record.scenario))
        return RunEvidence(record, self.record, until_s, certificates, offset, self.most_work)

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

    def violations(self) -> list[AssumptionViolation]:
        """The assumptions that the run violated, each at the first time."""
        return sorted(self.certified_evidence.violations(), key=lambda violation: violation.t_s)

    def evaluate(self) -> list[Claim]:
        """Return every claim with its verdict."""
        if not self.evidence.facts.shares_an_update:
            return []
        if self.record.scenario.protocol.acknowledges:
            return [void_claim("x_c − x_s is the sum of the missed jumps", "(I1)", _ACKNOWLEDGED)]
        claims: list[Claim] = []
        for certificate in (None, *self.certified_evidence.certificates):
            if certificate is not None and not certificate.exists:
                claimed = f"a certificate for {certificate.scope}"
                claims.append(void_claim(claimed, certificate.source, certificate.void or ""))
            own = [instance.check for instance in self._checked if instance.certificate is certificate]
            claimed_checks = [check for check in own if check.is_claimed]
            if certificate is not None and own and not claimed_checks:
                why = (
                    f"settings changed at {self.certified_evidence.until_s:.3f} s, before it could be checked"
                )
                claims.append(void_claim(f"a certificate for {certificate.scope}", certificate.source, why))
            claims += [check.result() for check in claimed_checks]
        return claims

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
            if not certificate.exists:
                continue
            outside = outside_box(certified.record.scenario) if certificate.scope == BOX else None
            for claim in (*output_claims(certified, certificate), *claims):
                if claim.is_certified:
                    check = ClaimCheck(claim, certificate.source, certified.until_s)
                    yield _ClaimInstance(claim, certified, check, [], certificate, outside)
        for claim in claims:
            if not claim.is_certified:
                unmet = _IDEAL_LOOP if claim.needs_ideal_loop else ""
                evidence, until_s = (
                    (self.evidence, math.inf) if claim.to_the_end else (certified, certified.until_s)
                )
                check = ClaimCheck(claim, claim.source, until_s, unmet)
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


def list_violations(
    reported: Sequence[ViolationPart], observed: Sequence[AssumptionViolation]
) -> list[ViolationPart]:
    """Return all violations of a run: those reported by processes, then those found in the record.

    A violation of M − 1 that a process reported is not repeated.
    """
    known = {violation.cause for violation in reported}
    return [*reported] + [
        ViolationPart(
            t_s=violation.t_s,
            process="recorder",
            cause=violation.cause,
            what=violation.text,
            worst_at_s=violation.worst_at_s,
        )
        for violation in observed
        if violation.cause not in known
    ]


@lru_cache(maxsize=1)
def claims_of(record: RunRecord) -> "RunClaims":
    """Return the claims about a run; the summary and the report use the same ones."""
    return RunClaims(record)


def _envelope_until(envelope: Envelope, until_s: float) -> Envelope:
    if envelope.quantity == "inter_event":  # two ends of a line
        return envelope._replace(t_s=np.minimum(envelope.t_s, until_s))
    return envelope._replace(values=np.where(envelope.t_s < until_s, envelope.values, np.nan))
