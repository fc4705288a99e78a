"""Checks every claim about a run against its record."""

import importlib
import math
import pkgutil
from collections.abc import Iterator
from functools import cache, cached_property
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
from cosim.analysis.claims.run_evidence import RunEvidence, Samples
from cosim.analysis.summary_model import Claim, ClaimVerdict
from cosim.record.decimate import decimate
from noack.theory.certificates.conditions import OWN_PLANT
from noack.theory.certificates.scenario_certificates import outside_box

_IDEAL_LOOP = (
    "assumes a continuous trigger, and a network and input without delay, which no sampled loop has"
)
_ACKNOWLEDGED = (
    'network.protocol = "ack": x_s is reset when an update is acknowledged, and not at every '
    "event as (I1), and every claim that follows from it, assumes"
)
_CERTIFIED = "certificate "
_Kind = TypeVar("_Kind", ClaimDefinition, CertifiedClaim)


@cache
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


class ClaimCheck:
    """Checks a run against a bound, part by part, up to the end of the claim.

    If the run cannot meet an assumption, ``unmet`` names it.
    """

    def __init__(
        self, statement: str, source: str, until_s: float = math.inf, unmet: str = ""
    ) -> None:
        self._statement, self._source, self._until_s, self._unmet = (
            statement, source, until_s, unmet
        )  # fmt: skip
        self._ratio: float | None = None
        self._exceeded_s: float | None = None
        self._bound: Bound | None = None

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
        return void if void is not None and void.t_s < self._until_s else None

    @property
    def _end_s(self) -> float:
        return self._until_s if (void := self._void) is None else void.t_s

    def result(self) -> Claim:
        """Return the claim with its verdict, after the last part."""
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
        formula = bound.formula if constant is None else bound.formula.format(constant)
        return Claim(
            what=self._statement, source=self._source, bound=formula, certified=constant,
            observed=observed, ratio=ratio, verdict=verdict, since_s=since_s, why=why, from_s=0.0,
            until_s=None,
        )  # fmt: skip


class ClaimEvaluation(RunEvidence):
    """The claims about one run, or about one part of it."""

    def judge(self) -> list[Claim]:
        """Return every claim with its verdict."""
        if not self.facts.any_in_common:
            return []
        if self.record.scenario.protocol.acknowledges:
            what = "x_c − x_s is the sum of the missed jumps"
            return [void_claim(what, "(I1)", 0.0, _ACKNOWLEDGED)]
        checks, _ = self._checked
        found = [checks[key].result() for key in checks if not key.startswith(_CERTIFIED)]
        for i, certificate in enumerate(self.certificates):
            if certificate.constants is None:
                what = f"a certificate for {certificate.scope}"
                found.append(void_claim(what, certificate.source, 0.0, certificate.void or ""))
            mine = f"{_CERTIFIED}{i} "
            found += [checks[key].result() for key in checks if key.startswith(mine)]
        return found

    @cached_property
    def _checked(self) -> tuple[dict[str, ClaimCheck], dict[str, list[Envelope]]]:
        """The checks of all claims, and the curves of all bounds, from one pass over the run."""
        checks: dict[str, ClaimCheck] = {}
        curves: dict[str, list[Envelope]] = {}
        columns, counts = self.record.slice_columns, self.facts.any_in_common
        for samples in self.samples():
            for key, check, bound in self._bounds(samples) if counts else ():
                checks.setdefault(key, check).add(bound)
            for key, envelope in self._envelopes(samples):
                if envelope.quantity == "inter_event":  # the same line in every part
                    curves.setdefault(key, [envelope])
                    continue
                keep = decimate(envelope.t_s, envelope.values, columns)
                thin = envelope._replace(t_s=envelope.t_s[keep], values=envelope.values[keep])
                curves.setdefault(key, []).append(thin)
        return checks, curves

    def _bounds(self, samples: Samples) -> Iterator[tuple[str, ClaimCheck, Bound]]:
        """Yield each claim's name, a new check, and its bound at some samples."""
        until_s = self.part.until_s
        for number, claim in enumerate(definitions(ClaimDefinition)):
            if (bound := claim.bound(self, samples)) is not None:
                unmet = _IDEAL_LOOP if claim.needs_ideal_loop else ""
                check = ClaimCheck(claim.statement, claim.source, until_s, unmet)
                yield f"{number}", check, bound
        for i, certificate in enumerate(self.certificates):
            if certificate.constants is None:
                continue
            scenario = self.record.scenario
            outside = outside_box(scenario) if certificate.scope != OWN_PLANT else None
            for number, one in enumerate(definitions(CertifiedClaim)):
                if (bound := one.bound(self, samples, certificate)) is not None:
                    if outside is not None:
                        bound = bound._replace(void=VoidFrom(0.0, outside))
                    check = ClaimCheck(one.statement, certificate.source, until_s)
                    yield f"{_CERTIFIED}{i} {number}", check, bound

    def envelopes(self) -> list[Envelope]:
        """The curves of all bounds; those of a long run are thinned."""
        if self.record.scenario.protocol.acknowledges:
            return []
        _, curves = self._checked
        return [
            parts[0]._replace(
                t_s=np.concatenate([one.t_s for one in parts]),
                values=np.concatenate([one.values for one in parts]),
            )
            for parts in curves.values()
        ]

    def _envelopes(self, samples: Samples) -> Iterator[tuple[str, Envelope]]:
        for i, certificate in enumerate(self.certificates):
            if certificate.constants is None:
                continue
            for number, one in enumerate(definitions(CertifiedClaim)):
                if (envelope := one.envelope(self, samples, certificate)) is not None:
                    yield f"{_CERTIFIED}{i} {number}", envelope
        for number, claim in enumerate(definitions(ClaimDefinition)):
            if (envelope := claim.envelope(self, samples)) is not None:
                yield f"{number}", envelope
