"""What a certificate claims: bounds of the errors, the state and the inter-event time.

Each claim is evaluated for each certificate of the scenario, and is void from the first violation
of the certificate's conditions on.
"""

import numpy as np

from cosim.analysis.claims.claim_definition import (
    ROUNDING,
    Bound,
    CertifiedClaim,
    Envelope,
    controller_error_bound,
    inter_event_bound,
    inter_event_envelope,
    upper_shares,
)
from cosim.analysis.claims.run_evidence import RunEvidence, Samples
from noack.core.linear_systems import row_norms
from noack.theory.certificates.certified_bounds import ScenarioCertificate, envelope_formula


def _certified_controller_error_bound(
    run: RunEvidence, samples: Samples, certificate: ScenarioCertificate
) -> Bound | None:
    if certificate.constants is None:
        return None
    formula = envelope_formula("‖e_c‖", certificate, "delta")
    values, void = certificate.controller_error(samples.t_s), run.violation_of(certificate)
    return controller_error_bound(run, samples, formula, values, certificate.constants.delta, void)


def _certified_controller_error_envelope(
    run: RunEvidence, samples: Samples, certificate: ScenarioCertificate
) -> Envelope:
    values = certificate.controller_error(samples.t_s)
    return Envelope(f"certified for {certificate.scope}", "e_c", samples.t_s, values)


CERTIFIED_CONTROLLER_ERROR = CertifiedClaim(
    "the controller's error is bounded",
    _certified_controller_error_bound,
    _certified_controller_error_envelope,
)


def _certified_controller_error_from_events_bound(
    run: RunEvidence, samples: Samples, certificate: ScenarioCertificate
) -> Bound | None:
    if (bounds := run.known_state_bounds(certificate)) is None:
        return None
    values = bounds.controller_error(samples.t_s, samples.since_event.missing)
    formula = "‖e_c‖ ≤ (1 + Σ_(i<j) sup_(τ≥iδ) ‖e^((H+αI)τ)‖) β̃e^(−αt), j events missing"
    void = run.violation_of(certificate)
    return controller_error_bound(run, samples, formula, values, void=void)


def _certified_controller_error_from_events_envelope(
    run: RunEvidence, samples: Samples, certificate: ScenarioCertificate
) -> Envelope | None:
    if (bounds := run.known_state_bounds(certificate)) is None:
        return None
    values = bounds.controller_error(samples.t_s, samples.since_event.missing)
    label = "bound, given the updates missing now"
    return Envelope(label, "e_c", samples.t_s, np.where(samples.in_common, values, np.nan))


CERTIFIED_CONTROLLER_ERROR_FROM_EVENTS = CertifiedClaim(
    "the controller's error is bounded by the events it misses",
    _certified_controller_error_from_events_bound,
    _certified_controller_error_from_events_envelope,
)


def _certified_estimation_error_bound(
    run: RunEvidence, samples: Samples, certificate: ScenarioCertificate
) -> Bound | None:
    scenario, loop = run.record.scenario, run.record.loop
    if certificate.constants is None or scenario.coverage.knows_state:
        return None
    weight = np.eye(loop.n) if loop.weight is None else loop.weight
    here = samples.with_x
    t_s = samples.t_s[here]
    errors = row_norms((samples.joined.x[here] - samples.true_x[here]) @ weight.T)
    formula = envelope_formula("‖x̂ − x‖", certificate, "estimation_error")
    shares = upper_shares(errors, certificate.estimation_error(t_s))
    return Bound(
        formula, t_s, shares, run.violation_of(certificate), certificate.constants.estimation_error
    )


CERTIFIED_ESTIMATION_ERROR = CertifiedClaim(
    "the estimation error is bounded", _certified_estimation_error_bound
)


def _certified_inter_event_time_bound(
    run: RunEvidence, samples: Samples, certificate: ScenarioCertificate
) -> Bound | None:
    if certificate.inter_event_s is None:
        return None
    return inter_event_bound(samples, certificate.inter_event_s, run.violation_of(certificate))


def _certified_inter_event_time_envelope(
    run: RunEvidence, samples: Samples, certificate: ScenarioCertificate
) -> Envelope | None:
    if certificate.inter_event_s is None:
        return None
    label = f"certified for {certificate.scope}"
    return inter_event_envelope(run, label, certificate.inter_event_s)


CERTIFIED_INTER_EVENT_TIME = CertifiedClaim(
    "minimum inter-event time",
    _certified_inter_event_time_bound,
    _certified_inter_event_time_envelope,
)


def _certified_sensor_error_bound(
    run: RunEvidence, samples: Samples, certificate: ScenarioCertificate
) -> Bound | None:
    if certificate.constants is None:
        return None
    formula = envelope_formula("‖e_s‖", certificate, "overshoot")
    slack = ROUNDING * row_norms(samples.joined.x)
    shares = upper_shares(samples.joined.e_s_norm, certificate.sensor_error(samples.t_s) + slack)
    void, overshoot = run.violation_of(certificate), certificate.constants.overshoot
    return Bound(formula, samples.t_s, shares, void, overshoot)


CERTIFIED_SENSOR_ERROR = CertifiedClaim(
    "the sensor's error is bounded", _certified_sensor_error_bound
)


def _certified_state_bound(
    run: RunEvidence, samples: Samples, certificate: ScenarioCertificate
) -> Bound | None:
    if (constants := certificate.constants) is None:
        return None
    formula = envelope_formula("‖x‖", certificate, "state")
    here = samples.with_x
    t_s, void = samples.t_s[here], run.violation_of(certificate)
    shares = upper_shares(row_norms(samples.true_x[here]), certificate.state(t_s))
    return Bound(formula, t_s, shares, void, constants.state)


def _certified_state_envelope(
    run: RunEvidence, samples: Samples, certificate: ScenarioCertificate
) -> Envelope:
    values = certificate.state(samples.t_s)
    return Envelope(f"certified for {certificate.scope}", "x", samples.t_s, values)


CERTIFIED_STATE = CertifiedClaim(
    "the state is bounded", _certified_state_bound, _certified_state_envelope
)


def _certified_state_from_events_bound(
    run: RunEvidence, samples: Samples, certificate: ScenarioCertificate
) -> Bound | None:
    if (bounds := run.known_state_bounds(certificate)) is None:
        return None
    since, here = samples.since_event, samples.with_x & ~np.isnan(samples.since_event.age_s)
    t_s, predicted = samples.t_s[here], since.predicted[here]
    missing = run.missing_events(samples, bounds)[here]
    most = bounds.state_deviation(t_s, since.age_s[here], missing)
    deviation = row_norms(samples.true_x[here] - predicted)
    shares = upper_shares(deviation, most + ROUNDING * row_norms(predicted))
    formula = "‖x − e^((A+BK)(t−t_k)) x(t_k)‖ ≤ ∫‖e^((A+BK)s) B‖ ‖u − Kx‖ds, since the event t_k"
    return Bound(formula, t_s, shares, run.violation_of(certificate))


def _certified_state_from_events_envelope(
    run: RunEvidence, samples: Samples, certificate: ScenarioCertificate
) -> Envelope | None:
    if (bounds := run.known_state_bounds(certificate)) is None:
        return None
    t_s, since, missing = samples.t_s, samples.since_event, run.missing_events(samples, bounds)
    values = row_norms(since.predicted) + bounds.state_deviation(t_s, since.age_s, missing)
    label = "bound, given x at the last event"
    return Envelope(label, "x", t_s, np.fmin(values, certificate.state(t_s)))


CERTIFIED_STATE_FROM_EVENTS = CertifiedClaim(
    "the state is bounded from the newest event on",
    _certified_state_from_events_bound,
    _certified_state_from_events_envelope,
)
