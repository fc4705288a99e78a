"""The form of a claim in ``catalogue/``, and bounds that several claims share."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from cosim.analysis.claims.observed_conditions import Reals, VoidFrom, earliest
from cosim.analysis.claims.run_evidence import RunEvidence, Samples
from noack.theory.bounds.certificate_terms import Constants
from noack.theory.certificates.certified_bounds import ScenarioCertificate


class Envelope(NamedTuple):
    """A curve that bounds a measured one."""

    label: str
    quantity: Literal["e_c", "x", "inter_event"]
    """``"e_c"`` for ‖e_c‖_W, ``"x"`` for ‖x‖, ``"inter_event"`` for a lower bound in seconds."""
    t_s: Reals
    values: Reals
    kind: Literal["certified", "identity", "printed"] = "certified"
    """The source: a certificate, identity (I1), or a formula of the paper."""


class Bound(NamedTuple):
    """The bound that a claim sets for a run, and the share of it that the run reached."""

    formula: str
    """The bound in words of mathematics; ``{}`` stands for the constant."""
    t_s: Reals
    """(k,)"""
    shares: Reals
    """Observed value over bound; for lower bounds, bound over observed value. (k,)"""
    void: VoidFrom | None
    """The time from which an assumption was violated."""
    constant: float | None = None
    is_lower: bool = False


class ClaimBound(NamedTuple):
    """The bound that a claim sets for some samples of a run, and its curve."""

    bound: Bound | None = None
    """None if there is no claim about this run."""
    envelope: Envelope | None = None
    """The bound as a curve."""


@dataclass(frozen=True)
class ClaimDefinition:
    """A claim that needs no certificate."""

    statement: str
    source: str
    assumes: str
    find: Callable[[RunEvidence, Samples], ClaimBound]
    needs_ideal_loop: bool
    """A run that exceeds the bound does not refute it."""


@dataclass(frozen=True)
class CertifiedClaim:
    """A claim of a certificate with constants; it is evaluated for each one of the scenario."""

    statement: str
    find: Callable[[RunEvidence, Samples, ScenarioCertificate, Constants], ClaimBound]
    assumes: str = "the conditions of the certificate"


def claim(
    statement: str, source: str, assumes: str, *, needs_ideal_loop: bool = False
) -> Callable[[Callable[[RunEvidence, Samples], ClaimBound]], ClaimDefinition]:
    """Make a function the definition of a claim."""
    return lambda find: ClaimDefinition(statement, source, assumes, find, needs_ideal_loop)


def certified(
    statement: str,
) -> Callable[[Callable[[RunEvidence, Samples, ScenarioCertificate, Constants], ClaimBound]], CertifiedClaim]:
    """Make a function the definition of a claim of certificates."""
    return lambda find: CertifiedClaim(statement, find)


def norm_text(run: RunEvidence, vector: str) -> str:
    """Return how a formula writes the norm of an error, in the trigger's norm: ‖e_c‖ or ‖W e_c‖."""
    if run.record.loop.weight is None:
        return f"‖{vector}‖"
    return f"‖W({vector})‖" if " − " in vector else f"‖W {vector}‖"


def upper_shares(observed: Reals, bound: Reals) -> Reals:
    """Return the share of an upper bound that was reached, (k,); 0 if both values are 0."""
    shares = np.zeros(len(observed))
    return np.divide(observed, bound, out=shares, where=(observed != 0) | ~(bound >= 0))


def controller_error_bound(
    run: RunEvidence,
    samples: Samples,
    formula: str,
    values: Reals,
    constant: float | None = None,
    void: VoidFrom | None = None,
    since_s: float = 0.0,
) -> Bound:
    """Return a bound of ‖e_c‖_W at the measurements from a time on; void from a record's first gap."""
    here = samples.is_bounded & (samples.t_s >= since_s - 1e-9)
    # Allow for the rounding of x, which matters for a bound of that size.
    slack = run.rounding(samples.aligned.x_norm[here])
    shares = upper_shares(samples.aligned.e_c_norm[here], values[here] + slack)
    return Bound(formula, samples.t_s[here], shares, earliest([void, run.first_gap]), constant)


def least_inter_event_time(
    run: RunEvidence,
    samples: Samples,
    least_s: float,
    void: VoidFrom | None,
    label: str,
    kind: Literal["certified", "printed"] = "certified",
) -> ClaimBound:
    """Return a lower bound of the inter-event time, and the same as a line over the run."""
    t_s, passed_s = samples.inter_event_s
    formula = "t_(i+1) − t_i ≥ {} s"
    void = earliest([void, run.lost_in_rounding])
    bound = Bound(formula, t_s, least_s / passed_s, void, least_s, is_lower=True)
    ends_s = np.array([0.0, run.record.scenario.horizon_s])
    return ClaimBound(bound, Envelope(label, "inter_event", ends_s, np.full(2, least_s), kind))
