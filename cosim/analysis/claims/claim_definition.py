"""The form of a claim in ``catalogue/``, and how a run is checked against it.

A file of the catalogue defines ``CLAIM``; :func:`run_claims` and :func:`certified_claims` collect
the definitions in alphabetical order of the file names.
"""

import importlib
import math
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cosim.analysis.claims.claim import Claim, ClaimVerdict, Envelope, Reals
from cosim.analysis.claims.observed_conditions import VoidFrom
from cosim.analysis.claims.run_evidence import RunEvidence
from noack.theory.scenario_certificates import ScenarioCertificate

ROUNDING = 1e-9
"""Relative rounding error of an exact computation over a run of 10,000 steps."""

IDEAL_LOOP = (
    "assumes a continuous trigger, and a network and input without delay, which no sampled loop has"
)


class Bound(NamedTuple):
    """The bound that a claim sets for a run, and the share of it that the run reached."""

    formula: str
    """The bound in words of mathematics; ``{:.4g}`` stands for the constant."""
    t_s: Reals
    """(k,)"""
    shares: Reals
    """Observed value over bound; for lower bounds, bound over observed value. (k,)"""
    void: VoidFrom | None
    """The time from which an assumption was violated."""
    constant: float | None = None
    is_lower: bool = False


@dataclass(frozen=True)
class ClaimDefinition:
    """A claim that needs no certificate."""

    statement: str
    source: str
    assumes: str
    bound: Callable[[RunEvidence], Bound | None]
    """Returns the bound; None if there is no claim about this run."""
    envelope: Callable[[RunEvidence], Envelope | None] = lambda run: None
    needs_ideal_loop: bool = False
    """A run that exceeds the bound does not refute it."""


@dataclass(frozen=True)
class CertifiedClaim:
    """A claim of a certificate; evaluated for each certificate of the scenario."""

    statement: str
    bound: Callable[[RunEvidence, ScenarioCertificate], Bound | None]
    envelope: Callable[[RunEvidence, ScenarioCertificate], Envelope | None] = lambda run, one: None
    assumes: str = "the conditions of the certificate"


def upper_shares(observed: Reals, bound: Reals) -> Reals:
    """Return the share of an upper bound that was reached, (k,); 0 if both values are 0."""
    shares = np.zeros(len(observed))
    return np.divide(observed, bound, out=shares, where=(observed != 0) | ~(bound >= 0))


def check(
    bound: Bound, statement: str, source: str, until_s: float = math.inf, unmet: str = ""
) -> Claim:
    """Check a run against a bound.

    Args:
        bound: the bound.
        statement: the claim in words.
        source: the claim's source.
        until_s: end of the claim.
        unmet: the assumption that this run cannot meet; empty if there is none.
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
    return Claim(statement, source, formula, constant, observed, ratio, verdict, since_s, why)


def _definitions() -> list[ClaimDefinition | CertifiedClaim]:
    from cosim.analysis.claims import catalogue

    names = sorted(found.name for found in pkgutil.iter_modules(catalogue.__path__))
    return [importlib.import_module(f"{catalogue.__name__}.{name}").CLAIM for name in names]


def run_claims() -> list[ClaimDefinition]:
    """The claims that need no certificate."""
    return [one for one in _definitions() if isinstance(one, ClaimDefinition)]


def certified_claims() -> list[CertifiedClaim]:
    """The claims of a certificate."""
    return [one for one in _definitions() if isinstance(one, CertifiedClaim)]
