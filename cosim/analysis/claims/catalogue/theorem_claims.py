"""The identity (I1), and what the paper claims.

(I1) holds for every plant, trigger and network. The paper's theorems assume a continuous trigger,
and a network without delay.
"""

import numpy as np

from cosim.analysis.claims.claim_definition import (
    Bound,
    ClaimDefinition,
    Envelope,
    controller_error_bound,
    inter_event_bound,
    inter_event_envelope,
    upper_shares,
)
from cosim.analysis.claims.run_evidence import RunEvidence, Samples
from noack.core.linear_systems import row_norms, transition


def _i1_controller_error_bound(run: RunEvidence, samples: Samples) -> Bound:
    error = "e_c" if run.record.scenario.coverage.knows_state else "x_c − x̂"
    formula = f"‖{error}‖ ≤ ‖e_s‖ + Σ ‖e^(H(t−t_k)) e_s(t_k)‖"
    return controller_error_bound(run, samples, formula, samples.error_bounds[0])


I1_CONTROLLER_ERROR = ClaimDefinition(
    "the controller's error is at most the sensor's error plus the missed jumps",
    "(I1)", "a complete record", _i1_controller_error_bound,
    lambda run, samples: Envelope(
        "bound from (I1)", "e_c", samples.t_s, samples.error_bounds[0], "identity"
    ),
)  # fmt: skip
_LEAST_MARGIN, _LARGEST_MARGIN = 1e-9, 1e-6


def _i1_model_difference_bound(run: RunEvidence, samples: Samples) -> Bound:
    here, margin = samples.in_common, _margin(run)
    residual = samples.residual[here]
    # Use the larger model state, since a missed update may have moved x_c far from x_s.
    scale = max(run.facts.largest_state, float(np.finfo(float).tiny))
    formula = "x_c − x_s = Σ e^(H(t−t_k)) e_s(t_k), relative residual ≤ {:.0e}"
    return Bound(formula, samples.t_s[here], residual / (margin * scale), run.first_gap, margin)


def _margin(run: RunEvidence) -> float:
    """Return the relative rounding error that the models may accumulate between two deliveries.

    It is n ε sup‖e^{Hτ}‖ over the time τ between deliveries, at most 1e-6.
    """
    loop, period_ns = run.record.loop, run.record.scenario.timing.measurement_period_ns
    longest_ns = run.facts.longest_update_ns
    growth, age_ns, moved = 1.0, period_ns, transition(loop.H, period_ns)
    while age_ns <= longest_ns and growth < 1 / np.finfo(float).eps:
        growth = max(growth, float(np.linalg.norm(moved)))
        age_ns, moved = 2 * age_ns, moved @ moved
    rounding = loop.n * float(np.finfo(float).eps) * growth
    return max(_LEAST_MARGIN, min(rounding, _LARGEST_MARGIN))


I1_MODEL_DIFFERENCE = ClaimDefinition(
    "x_c − x_s is the sum of the missed jumps",
    "(I1)",
    "a complete record",
    _i1_model_difference_bound,
)


def _paper_error_bound_bound(run: RunEvidence, samples: Samples) -> Bound | None:
    # Estimates and noise jump at every measurement, so no trigger keeps e_s below a threshold.
    if not run.record.scenario.coverage.is_decaying or not run.record.scenario.coverage.knows_state:
        return None
    formula = "‖e_c‖ ≤ βe^(−αt) + Σ βe^(−αt_k) ‖e^(H(t−t_k))‖"
    return controller_error_bound(run, samples, formula, samples.error_bounds[1])


PAPER_ERROR_BOUND = ClaimDefinition(
    "the paper's bound of the controller's error", "eq:LossEv3",
    "a continuous trigger, a network without delay", _paper_error_bound_bound,
    needs_ideal_loop=True,
)  # fmt: skip


def _theorem_1_controller_error_bound(run: RunEvidence, samples: Samples) -> Bound | None:
    scenario = run.record.scenario
    if (
        not scenario.coverage.is_certifiable
        or not scenario.coverage.is_undisturbed
        or not scenario.coverage.is_decaying
        or scenario.decaying.floor > 0
    ):
        return None
    if (delta := run.trajectory_delta) is None:
        return None
    level = scenario.decaying.beta * np.exp(-scenario.decaying.alpha_per_s * samples.t_s)
    bound = "‖e_c‖ ≤ {:.4g} βe^(−αt)"
    return controller_error_bound(run, samples, bound, delta * level, delta, run.paper_violation)


THEOREM_1_CONTROLLER_ERROR = ClaimDefinition(
    "the controller's error decays", "Theorem 1 (3 for a hold), Δ from this run's trajectory",
    "a continuous trigger, a network without delay, at most M − 1 consecutive losses",
    _theorem_1_controller_error_bound, needs_ideal_loop=True,
)  # fmt: skip


def _theorem_2_inter_event_time_bound(run: RunEvidence, samples: Samples) -> Bound | None:
    if not run.record.scenario.coverage.knows_state or run.theorem_2 is None:
        return None
    return inter_event_bound(samples, run.theorem_2.inter_event_s, run.paper_violation)


def _theorem_2_inter_event_time_envelope(run: RunEvidence, samples: Samples) -> Envelope | None:
    if run.theorem_2 is None:
        return None
    least_s = run.theorem_2.inter_event_s
    return inter_event_envelope(run, "Theorem 2 (eq:tau)", least_s)._replace(kind="printed")


THEOREM_2_INTER_EVENT_TIME = ClaimDefinition(
    "minimum inter-event time", "Theorem 2, eq:tau",
    "a continuous trigger, a network and input without delay, at most M − 1 consecutive losses",
    _theorem_2_inter_event_time_bound, _theorem_2_inter_event_time_envelope, needs_ideal_loop=True,
)  # fmt: skip


def _theorem_2_state_envelope(run: RunEvidence, samples: Samples) -> Envelope | None:
    if run.theorem_2 is None:
        return None
    values = run.theorem_2.state(samples.t_s, run.record.scenario.decaying.alpha_per_s)
    return Envelope("Theorem 2 (eq:normXt)", "x", samples.t_s, values, "printed")


def _theorem_2_state_bound(run: RunEvidence, samples: Samples) -> Bound | None:
    if (
        not run.record.scenario.coverage.knows_state
        or (envelope := _theorem_2_state_envelope(run, samples)) is None
    ):
        return None
    shares = upper_shares(row_norms(samples.joined.x), envelope.values)
    formula = "‖x‖ ≤ c x₀ e^(−ᾱt) + g (e^(−αt) − e^(−ᾱt))"
    return Bound(formula, samples.t_s, shares, run.paper_violation)


THEOREM_2_STATE = ClaimDefinition(
    "the state decays", "Theorem 2, eq:normXt",
    "a continuous trigger, a network and input without delay, at most M − 1 consecutive losses",
    _theorem_2_state_bound, _theorem_2_state_envelope, needs_ideal_loop=True,
)  # fmt: skip
