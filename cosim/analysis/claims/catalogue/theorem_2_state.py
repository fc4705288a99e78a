"""Theorem 2, eq:normXt of the paper: ‖x‖ ≤ c x₀ e^{−ᾱt} + g (e^{−αt} − e^{−ᾱt})."""

from cosim.analysis.claims.claim_definition import Bound, ClaimDefinition, Envelope, upper_shares
from cosim.analysis.claims.run_evidence import RunEvidence, Samples
from noack.core.linear_systems import row_norms


def _envelope(run: RunEvidence, samples: Samples) -> Envelope | None:
    if run.theorem_2 is None:
        return None
    values = run.theorem_2.state(samples.t_s, run.record.scenario.decaying.alpha_per_s)
    return Envelope("Theorem 2 (eq:normXt)", "x", samples.t_s, values, "printed")


def _bound(run: RunEvidence, samples: Samples) -> Bound | None:
    if (
        not run.record.scenario.coverage.knows_state
        or (envelope := _envelope(run, samples)) is None
    ):
        return None
    shares = upper_shares(row_norms(samples.joined.x), envelope.values)
    formula = "‖x‖ ≤ c x₀ e^(−ᾱt) + g (e^(−αt) − e^(−ᾱt))"
    return Bound(formula, samples.t_s, shares, run.paper_violation)


CLAIM = ClaimDefinition(
    "the state decays", "Theorem 2, eq:normXt",
    "a continuous trigger, a network and input without delay, at most M − 1 consecutive losses",
    _bound, _envelope, needs_ideal_loop=True,
)  # fmt: skip
