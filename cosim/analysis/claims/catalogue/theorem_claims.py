"""The identity (I1), and what the paper claims.

(I1) holds for every plant, trigger and network. The paper's theorems assume a continuous trigger,
and a network without delay.
"""

import numpy as np

from cosim.analysis.claims.claim_definition import (
    Bound,
    ClaimBound,
    Envelope,
    claim,
    controller_error_bound,
    least_inter_event_time,
    norm_text,
    upper_shares,
)
from cosim.analysis.claims.run_evidence import ROUNDING, RunEvidence, Samples
from noack.core.linear_systems import Propagator

_LEAST_MARGIN, _LARGEST_MARGIN = 1e-9, 1e-6
_EPSILON = float(np.finfo(float).eps)
_COMPLETE = "a complete record"
_CONTINUOUS = "a continuous trigger, a network without delay"
_CAPPED = "at most M − 1 consecutive losses"


@claim("the controller's error is at most the sensor's error plus the missed jumps", "(I1)", _COMPLETE)
def i1_controller_error(run: RunEvidence, samples: Samples) -> ClaimBound:
    """The triangle inequality for (I1)."""
    error, values = (
        "e_c" if run.record.scenario.coverage.knows_state else "x_c − x̂",
        samples.error_bounds[0],
    )
    jump = norm_text(run, "e^(H(t−t_k)) e_s(t_k)")
    formula = f"{norm_text(run, error)} ≤ {norm_text(run, 'e_s')} + Σ {jump}"
    return ClaimBound(
        controller_error_bound(run, samples, formula, values),
        Envelope("bound from (I1)", "e_c", samples.t_s, values, "identity"),
    )


@claim("x_c − x_s is the sum of the missed jumps", "(I1)", _COMPLETE)
def i1_model_difference(run: RunEvidence, samples: Samples) -> ClaimBound:
    """(I1) itself, up to rounding."""
    here, margin = samples.is_bounded, _margin(run)
    residual = samples.residual[here]
    # Use the larger model state, since a missed update may have moved x_c far from x_s.
    scale = max(run.facts.largest_state + run.part.offset, float(np.finfo(float).tiny))
    formula = "x_c − x_s = Σ e^(H(t−t_k)) e_s(t_k), relative residual ≤ {}"
    shares = residual / (margin * scale)
    return ClaimBound(Bound(formula, samples.t_s[here], shares, run.first_gap, margin))


def _margin(run: RunEvidence) -> float:
    """Return the relative rounding error that the models may accumulate between two deliveries.

    It is n ε sup‖e^{Hτ}‖ over the time τ between deliveries, at most 1e-6.
    """
    loop, period_ns = run.record.loop, run.record.scenario.timing.measurement_period_ns
    longest_ns = run.facts.longest_update_ns
    growth, age_ns, moved = 1.0, period_ns, Propagator(loop.H).transition(period_ns)
    while age_ns <= longest_ns and growth < 1 / _EPSILON:
        growth = max(growth, float(np.linalg.norm(moved)))
        age_ns, moved = 2 * age_ns, moved @ moved
    rounding = loop.n * _EPSILON * growth
    return max(_LEAST_MARGIN, min(rounding, _LARGEST_MARGIN))


@claim("the paper's bound of the controller's error", "eq:LossEv3", _CONTINUOUS, needs_ideal_loop=True)
def paper_error_bound(run: RunEvidence, samples: Samples) -> ClaimBound:
    """(I1) with the threshold in place of e_s at the events."""
    coverage = run.record.scenario.coverage
    # Estimates and noise jump at every measurement, so no trigger keeps e_s below a threshold.
    if not coverage.is_decaying or not coverage.knows_state:
        return ClaimBound()
    growth = "‖e^(H(t−t_k))‖" if run.record.loop.weight is None else "‖W e^(H(t−t_k)) W⁻¹‖"
    formula = f"{norm_text(run, 'e_c')} ≤ βe^(−αt) + Σ βe^(−αt_k) {growth}"
    return ClaimBound(controller_error_bound(run, samples, formula, samples.error_bounds[1]))


@claim(
    "the controller's error decays",
    "Theorem 1 (3 for a hold), Δ from this run's trajectory",
    f"{_CONTINUOUS}, {_CAPPED}",
    needs_ideal_loop=True,
)
def theorem_1_controller_error(run: RunEvidence, samples: Samples) -> ClaimBound:
    """Theorem 1 with the Δ of the trajectory."""
    scenario = run.record.scenario
    coverage = scenario.coverage
    is_covered = coverage.is_certifiable and coverage.is_undisturbed and coverage.is_decaying
    if not is_covered or scenario.decaying.floor > 0 or (delta := run.trajectory_delta) is None:
        return ClaimBound()
    level = scenario.decaying.beta * np.exp(-scenario.decaying.alpha_per_s * samples.t_s)
    formula, void = f"{norm_text(run, 'e_c')} ≤ {{}} βe^(−αt)", run.paper_violation
    return ClaimBound(controller_error_bound(run, samples, formula, delta * level, delta, void))


_IDEAL = f"a continuous trigger, a network and input without delay, {_CAPPED}"


@claim("minimum inter-event time", "Theorem 2, eq:tau", _IDEAL, needs_ideal_loop=True)
def theorem_2_inter_event_time(run: RunEvidence, samples: Samples) -> ClaimBound:
    """Theorem 2's τ."""
    if run.theorem_2 is None:
        return ClaimBound()
    least = least_inter_event_time(
        run,
        samples,
        run.theorem_2.inter_event_s,
        run.paper_violation,
        "Theorem 2 (eq:tau)",
        "printed",
    )
    knows_state = run.record.scenario.coverage.knows_state
    return least if knows_state else ClaimBound(None, least.envelope)


@claim("the state decays", "Theorem 2, eq:normXt", _IDEAL, needs_ideal_loop=True)
def theorem_2_state(run: RunEvidence, samples: Samples) -> ClaimBound:
    """Theorem 2's bound of ‖x‖."""
    if run.theorem_2 is None:
        return ClaimBound()
    values = run.theorem_2.state(samples.t_s, run.record.scenario.decaying.alpha_per_s)
    envelope = Envelope("Theorem 2 (eq:normXt)", "x", samples.t_s, values, "printed")
    if not run.record.scenario.coverage.knows_state:
        return ClaimBound(None, envelope)
    slack = ROUNDING * run.part.offset
    shares = upper_shares(samples.aligned.x_norm, values + slack)
    formula = "‖x‖ ≤ c x₀ e^(−ᾱt) + g (e^(−αt) − e^(−ᾱt))"
    return ClaimBound(Bound(formula, samples.t_s, shares, run.paper_violation), envelope)
