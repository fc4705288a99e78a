"""Checks every claim about a run against its record.

:class:`ClaimEvaluation` checks the claims about a run whose settings stay the same, in one pass.
:class:`RunClaims` does so for any run. The claims at the start end at the first change of settings.
The part after a change is checked as a separate run, in deviations from the set-point. Its time 0
is the first event after the change whose update the controller received: there x_s = x, and x_c is
reset to x. There are no claims in between.

Such a part starts with an input of the part before: until the plant applies the first input of the
new part, u was computed from older updates. ‖u − Kx‖ is recorded, and the certificate holds if it
covers input errors of this size; see ``CertificateScope`` in
:mod:`noack.theory.certificates.scenario_certificates`.

The processes of a stopped run end some milliseconds apart. Claims and conditions are checked up to
the last time that all of them reached, because the loop is incomplete after it.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache, partial
from typing import NamedTuple, TypeVar

import numpy as np

from cosim.analysis.claims import claim_catalogue
from cosim.analysis.claims.claim_catalogue import Bound, CertifiedClaim, ClaimBound, ClaimDefinition, Envelope
from cosim.analysis.claims.observed_conditions import AssumptionViolation, VoidFrom
from cosim.analysis.claims.run_certificates import late_certificates
from cosim.analysis.claims.run_evidence import ROUNDING, RunEvidence, Samples
from cosim.analysis.claims.run_parts import RunPart, common_end_ns, cut_part, start_error, up_to_common_end
from cosim.analysis.summary.summary_model import NO_BOUND, Claim, ClaimVerdict, ViolationPart
from cosim.record.decimation import decimate
from cosim.record.run_events import RecordedChange, changes_of
from cosim.record.run_record import RunRecord
from noack.core.clock import NEVER_NS, NS_PER_S
from noack.core.linear_systems import Vector
from noack.core.number_format import at_least, at_most
from noack.protocol.record_tables import CONTROLLER_DELIVERY
from noack.scenario.resolution import setpoint_of
from noack.scenario.runtime_parameters import text_of
from noack.scenario.scenario import Scenario
from noack.theory.bounds.certificate_terms import NetworkConditions
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import BOX, allowed_conditions, void_at_setpoint
from noack.theory.certificates.scenario_certificates import outside_box

_IDEAL_LOOP = "assumes a continuous trigger, and a network and input without delay, which no sampled loop has"
_ACKNOWLEDGED = (
    'network.protocol = "ack": x_s is reset when an update is acknowledged, and not at every '
    "event as (I1), and every claim that follows from it, assumes"
)
_Kind = TypeVar("_Kind", ClaimDefinition, CertifiedClaim)


@cache
def definitions(kind: type[_Kind]) -> list[_Kind]:
    """Return the claims of a kind, in the order of the catalogue.

    Certified claims are those of a certificate; the others need none.
    """
    return [claim for claim in vars(claim_catalogue).values() if isinstance(claim, kind)]


def void_claim(claimed: str, source: str, since_s: float, why: str, until_s: float | None = None) -> Claim:
    """Return a claim that cannot be checked because there is no bound."""
    return Claim(
        what=claimed, source=source, bound=NO_BOUND, certified=None, observed=None, ratio=None,
        verdict=ClaimVerdict.VOID, since_s=since_s, why=why, from_s=since_s, until_s=until_s,
    )  # fmt: skip


class ClaimCheck:
    """Checks a part of a run against a bound, samples by samples, up to the end of the claim.

    If the run cannot meet an assumption, ``unmet`` names it.
    """

    def __init__(self, statement: str, source: str, part: RunPart, unmet: str = "") -> None:
        self._statement, self._source, self._part, self._unmet = statement, source, part, unmet
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
        return void if void is not None and void.t_s < self._part.until_s else None

    @property
    def _end_s(self) -> float:
        return self._part.until_s if (void := self._void) is None else void.t_s

    def result(self) -> Claim:
        """Return the claim with its verdict, in the run's time, after the last samples."""
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
        from_s = self._part.from_s
        return Claim(
            what=self._statement, source=self._source, bound=bound.formula.format(text), certified=constant,
            observed=observed, ratio=ratio, verdict=verdict,
            since_s=None if since_s is None else since_s + from_s, why=why, from_s=from_s,
            until_s=_end_s(self._part),
        )  # fmt: skip


def _end_s(part: RunPart) -> float | None:
    """Return the end of the claims of a part, in the run's time; None for that of the run."""
    return round(part.from_s + part.until_s, 9) if math.isfinite(part.until_s) else None


class _ClaimInstance(NamedTuple):
    """A claim about a run, by a certificate or without one."""

    find: Callable[[RunEvidence, Samples], ClaimBound]
    check: ClaimCheck
    curve: list[Envelope]
    """The parts of its curve."""
    certificate: ScenarioCertificate | None = None
    outside: str | None = None
    """Why the certificate does not cover the run's plant."""

    def take(self, run: RunEvidence, samples: Samples) -> None:
        """Check the next samples, and add to the curve, which is thinned if the run is long."""
        bound, envelope = self.find(run, samples)
        if run.facts.is_ever_bounded and bound is not None:
            if self.outside is not None:
                bound = bound._replace(void=VoidFrom(0.0, self.outside))
            self.check.add(bound)
        if envelope is None or (envelope.quantity == "inter_event" and self.curve):
            return  # the same line in every part
        if envelope.quantity != "inter_event":
            keep = decimate(envelope.t_s, envelope.values, run.record.slice_columns)
            envelope = envelope._replace(t_s=envelope.t_s[keep], values=envelope.values[keep])
        self.curve.append(envelope)


class ClaimEvaluation(RunEvidence):
    """The claims about one run, or about one part of it."""

    def evaluate(self) -> list[Claim]:
        """Return every claim with its verdict, in the run's time."""
        if not self.facts.is_ever_bounded:
            return []
        void = partial(void_claim, since_s=self.part.from_s, until_s=_end_s(self.part))
        if self.record.scenario.protocol.acknowledges:
            claimed = "x_c − x_s is the sum of the missed jumps"
            return [void(claimed, "(I1)", why=_ACKNOWLEDGED)]
        claims: list[Claim] = []
        for certificate in (None, *self.certificates):
            if certificate is not None and not certificate.exists:
                claimed = f"a certificate for {certificate.scope}"
                claims.append(void(claimed, certificate.source, why=certificate.void or ""))
            claims += [
                instance.check.result()
                for instance in self._checked
                if instance.certificate is certificate and instance.check.is_claimed
            ]
        return claims

    @cached_property
    def _checked(self) -> list[_ClaimInstance]:
        """All claims, checked in one pass over the run."""
        instances = list(self._instances())
        for samples in self.samples():
            for instance in instances:
                instance.take(self, samples)
        return instances

    def _instances(self) -> Iterator[_ClaimInstance]:
        """Yield the claims of each certificate, and those that need none."""
        scenario = self.record.scenario
        for certificate in self.certificates:
            if (constants := certificate.constants) is None:
                continue
            outside = outside_box(scenario) if certificate.scope == BOX else None
            for claim in definitions(CertifiedClaim):
                check = ClaimCheck(claim.statement, certificate.source, self.part)
                find = partial(claim.find, certificate=certificate, constants=constants)
                yield _ClaimInstance(find, check, [], certificate, outside)
        for claim in definitions(ClaimDefinition):
            unmet = _IDEAL_LOOP if claim.needs_ideal_loop else ""
            yield _ClaimInstance(claim.find, ClaimCheck(claim.statement, claim.source, self.part, unmet), [])

    def envelopes(self) -> list[Envelope]:
        """The curves of all bounds; those of a long run are thinned."""
        if self.record.scenario.protocol.acknowledges:
            return []
        return [
            curve[0]._replace(
                t_s=np.concatenate([part.t_s for part in curve]),
                values=np.concatenate([part.values for part in curve]),
            )
            for curve in (instance.curve for instance in self._checked)
            if curve
        ]


@dataclass(eq=False)
class RunClaims:
    """The claims about a run, part by part; each property is computed once."""

    record: RunRecord
    certificates: Sequence[ScenarioCertificate] | None = None
    """Those of the run's scenario, if they are known."""

    @cached_property
    def _checked_record(self) -> RunRecord:
        return up_to_common_end(self.record)

    @property
    def judged_until_s(self) -> float | None:
        """End of the claims about a stopped run; None if they are checked to the end of the run."""
        end_ns = common_end_ns(self.record)
        return None if end_ns is None else end_ns / NS_PER_S

    @cached_property
    def _setpoint(self) -> tuple[Vector, Vector] | None:
        return setpoint_of(self._checked_record.scenario)

    @cached_property
    def parts(self) -> list[ClaimEvaluation | Claim]:
        """The claims of each part; for a part without claims, the reason as a void claim."""
        record = self._checked_record
        changes = [change for change in changes_of(record) if change.touches_claims]
        first_ns = changes[0].first_ns if changes else NEVER_NS
        void = void_at_setpoint(record.scenario, knows_start=True)
        part_record, certificates, error = record, self.certificates, None
        if self._setpoint is not None:
            part_record, certificates = cut_part(record, record.scenario, 0, None), None
            if self._setpoint[1].any():  # the input is 0 at first, and not u_r
                error = start_error(part_record, ClaimEvaluation(part_record).started_s)
        offset = _offset(record.scenario)
        until_s = _until_s(first_ns, 0)
        part = RunPart(self.record, 0.0, until_s, error, void, certificates, offset)
        parts: list[ClaimEvaluation | Claim] = [ClaimEvaluation(part_record, part)]
        for change, after in zip(changes, [*changes[1:], None], strict=False):
            until_ns = NEVER_NS if after is None else after.first_ns
            parts.append(self._claims_after(change, until_ns))
        return parts

    @property
    def _is_evaluated(self) -> bool:
        """Whether the claims are known already."""
        return "parts" in vars(self)

    @cached_property
    def conditions(self) -> dict[str, float | None]:
        """Largest observed value of each condition, over the whole run."""
        first = self.parts[0]
        if isinstance(first, ClaimEvaluation) and first.record is self._checked_record:
            return first.conditions
        return ClaimEvaluation(self._checked_record).conditions

    @property
    def allowed(self) -> NetworkConditions | None:
        """The conditions of the scenario's certificates; None if it can have none."""
        scenario, first = self.record.scenario, self.parts[0]
        if not scenario.coverage.some_certificate_applies:
            return None
        if isinstance(first, ClaimEvaluation) and first.record is self._checked_record:
            return first.allowed
        return allowed_conditions(scenario)

    @property
    def certified_for(self) -> NetworkConditions | None:
        """The wider schedule that the certificates of the run's first late part cover."""
        parts = (part.certified_for for part in self.parts if not isinstance(part, Claim))
        return next((conditions for conditions in parts if conditions is not None), None)

    def violations(self) -> list[AssumptionViolation]:
        """The assumptions that the run violated: in each part, the first violation of each."""
        violations = []
        for part in self.parts:
            if not isinstance(part, Claim):
                from_s = part.part.from_s
                violations += [
                    violation._replace(t_s=violation.t_s + from_s, worst_at_s=violation.worst_at_s + from_s)
                    for violation in part.violations()
                ]
        return sorted(violations, key=lambda violation: violation.t_s)

    def evaluate(self) -> list[Claim]:
        """Return every claim with its verdict, in the run's time."""
        evaluated = ([part] if isinstance(part, Claim) else part.evaluate() for part in self.parts)
        return [claim for claims in evaluated for claim in claims]

    def envelopes(self) -> list[Envelope]:
        """The curves of all bounds, each over its own part of the run."""
        if self.record.scenario.plant.system.runs_user_code and not self._is_evaluated:
            self.certificates = ()  # reading a finished run does not run the code of its plant
        envelopes: list[Envelope] = []
        for evaluation in self.parts:
            # Other bounds hold for deviations from another set-point, or start later.
            if not isinstance(evaluation, Claim) and evaluation.part.from_s == 0 and self._setpoint is None:
                envelopes += [
                    _envelope_until(curve, evaluation.part.until_s) for curve in evaluation.envelopes()
                ]
        return envelopes

    def _claims_after(self, change: RecordedChange, until_ns: int) -> ClaimEvaluation | Claim:
        """The claims about the part of the run that follows a change."""
        record = self._checked_record
        known = record.events()["event"]
        after = record.columns(
            CONTROLLER_DELIVERY,
            "t_ns",
            "sequence",
            where=lambda rows: rows["t_ns"] >= change.everywhere_ns,
        )
        after = after[np.isin(after["sequence"], known)]
        if change.everywhere_ns == NEVER_NS:
            return _void_after(change, until_ns, "not every process received the change")
        if not len(after) or after["t_ns"][0] >= until_ns:
            up_to = "" if until_ns == NEVER_NS else f", up to {until_ns / NS_PER_S:.3f} s"
            return _void_after(change, until_ns, f"no update was delivered after it{up_to}")
        origin_ns, sequence = int(after["t_ns"][0]), int(after["sequence"][0])
        part_record = cut_part(record, change.scenario, origin_ns, sequence)
        part = RunPart(
            self.record,
            origin_ns / NS_PER_S,
            _until_s(until_ns, origin_ns),
            start_error(part_record, ClaimEvaluation(part_record).started_s),
            void_at_setpoint(change.scenario, knows_start=True),
            offset=_offset(change.scenario),
        )
        return ClaimEvaluation(part_record, part)


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


def _offset(scenario: Scenario) -> float:
    """Return ‖x_r‖ of the set-point of a scenario."""
    setpoint = setpoint_of(scenario)
    return 0.0 if setpoint is None else float(np.linalg.norm(setpoint[0]))


def certify_late(claims: Sequence[RunClaims]) -> None:
    """Search together for the certificates of the runs that were later than allowed."""
    firsts = [first for run_claims in claims if isinstance(first := run_claims.parts[0], ClaimEvaluation)]
    for first, certificates in zip(firsts, late_certificates(firsts), strict=True):
        first.wider = certificates


@lru_cache(maxsize=1)
def claims_of(record: RunRecord) -> "RunClaims":
    """Return the claims about a run; the summary and the report use the same ones."""
    return RunClaims(record)


def _void_after(change: RecordedChange, until_ns: int, why: str) -> Claim:
    """Return a void claim for the part after a change, with the reason for having no claims."""
    at_s, text = change.first_ns / NS_PER_S, text_of(change.change.settings)
    until_s = None if until_ns == NEVER_NS else until_ns / NS_PER_S
    why = f"changed at {at_s:.3f} s: {text}; {why}"
    return void_claim("claims after a change", "claims", at_s, why, until_s)


def _until_s(until_ns: int, origin_ns: int) -> float:
    """Return the end of a part in its own time, computed as the times of its samples are."""
    return math.inf if until_ns == NEVER_NS else (until_ns - origin_ns) * 1e-9


def _envelope_until(envelope: Envelope, until_s: float) -> Envelope:
    if envelope.quantity == "inter_event":  # two ends of a line
        return envelope._replace(t_s=np.minimum(envelope.t_s, until_s))
    return envelope._replace(values=np.where(envelope.t_s < until_s, envelope.values, np.nan))
