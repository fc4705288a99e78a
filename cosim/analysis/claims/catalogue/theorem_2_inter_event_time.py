"""Theorem 2, eq:tau of the paper: a lower bound of the inter-event time."""

from cosim.analysis.claims.claim_definition import (
    Bound,
    ClaimDefinition,
    Envelope,
    inter_event_bound,
    inter_event_envelope,
)
from cosim.analysis.claims.run_evidence import RunEvidence, Samples


def _bound(run: RunEvidence, samples: Samples) -> Bound | None:
    if not run.record.scenario.coverage.knows_state or run.theorem_2 is None:
        return None
    return inter_event_bound(samples, run.theorem_2.inter_event_s, run.paper_violation)


def _envelope(run: RunEvidence, samples: Samples) -> Envelope | None:
    if run.theorem_2 is None:
        return None
    least_s = run.theorem_2.inter_event_s
    return inter_event_envelope(run, "Theorem 2 (eq:tau)", least_s)._replace(kind="printed")


CLAIM = ClaimDefinition(
    "minimum inter-event time", "Theorem 2, eq:tau",
    "a continuous trigger, a network and input without delay, at most M − 1 consecutive losses",
    _bound, _envelope, needs_ideal_loop=True,
)  # fmt: skip
