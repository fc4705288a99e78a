"""The form of a claim in ``catalogue/``, and bounds that several claims share."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from cosim.analysis.claims.observed_conditions import Reals, VoidFrom, earliest
from cosim.analysis.claims.run_evidence import RunEvidence, Samples
from noack.core.linear_systems import row_norms
from noack.theory.certificates.certified_bounds import ScenarioCertificate

ROUNDING = 1e-9
"""Relative rounding error of an exact computation over a run of 10,000 steps."""


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
    bound: Callable[[RunEvidence, Samples], Bound | None]
    """Returns the bound at some samples; None if there is no claim about this run."""
    envelope: Callable[[RunEvidence, Samples], Envelope | None] = lambda run, samples: None
    needs_ideal_loop: bool = False
    """A run that exceeds the bound does not refute it."""


@dataclass(frozen=True)
class CertifiedClaim:
    """A claim of a certificate; evaluated for each certificate of the scenario."""

    statement: str
    bound: Callable[[RunEvidence, Samples, ScenarioCertificate], Bound | None]
    envelope: Callable[[RunEvidence, Samples, ScenarioCertificate], Envelope | None] = (
        lambda run, samples, one: None
    )
    assumes: str = "the conditions of the certificate"


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
) -> Bound:
    """Return a bound of ‖e_c‖_W at the measurements, (k,); it is void from a record's first gap."""
    here = samples.in_common
    # Allow for the rounding of x, which matters for a bound of that size.
    slack = ROUNDING * row_norms(samples.joined.x[here])
    shares = upper_shares(samples.joined.e_c_norm[here], values[here] + slack)
    return Bound(formula, samples.t_s[here], shares, earliest([void, run.first_gap]), constant)


def inter_event_bound(samples: Samples, least_s: float, void: VoidFrom | None) -> Bound:
    """Return a lower bound of the inter-event time."""
    t_s, passed_s = samples.inter_event_s
    formula = "t_(i+1) − t_i ≥ {:.4g} s"
    return Bound(formula, t_s, least_s / passed_s, void, least_s, is_lower=True)


def inter_event_envelope(run: RunEvidence, label: str, least_s: float) -> Envelope:
    """Return the same bound as a line over the run."""
    ends_s = np.array([0.0, run.record.scenario.horizon_s])
    return Envelope(label, "inter_event", ends_s, np.full(2, least_s))
