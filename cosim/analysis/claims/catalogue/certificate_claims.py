"""What a certificate claims: bounds of the errors, the state and the inter-event time.

Each claim is evaluated for each certificate of the scenario, and is void from the first violation
of the certificate's conditions on.
"""

import numpy as np

from cosim.analysis.claims.claim_definition import (
    Bound,
    ClaimBound,
    Envelope,
    certified,
    controller_error_bound,
    least_inter_event_time,
    norm_text,
    upper_shares,
)
from cosim.analysis.claims.run_evidence import ROUNDING, RunEvidence, Samples
from noack.core.linear_systems import row_norms
from noack.core.number_format import at_most
from noack.theory.bounds.certificate_terms import Constants
from noack.theory.certificates.certified_bounds import ScenarioCertificate, envelope_formula


@certified("the controller's error is bounded")
def controller_error(
    run: RunEvidence, samples: Samples, certificate: ScenarioCertificate, constants: Constants
) -> ClaimBound:
    """‖e_c‖_W from when the plant applies the controller's input on."""
    formula = envelope_formula(norm_text(run, "e_c"), certificate, "delta")
    values, void = certificate.controller_error(samples.t_s), run.violation_of(certificate)
    return ClaimBound(
        controller_error_bound(run, samples, formula, values, constants.delta, void, run.started_s),
        Envelope(f"certified for {certificate.scope}", "e_c", samples.t_s, values),
    )


@certified("the controller's error is bounded by the events it misses")
def controller_error_from_events(
    run: RunEvidence, samples: Samples, certificate: ScenarioCertificate, constants: Constants
) -> ClaimBound:
    """‖e_c‖_W, given the number of missing events."""
    bounds, since = run.known_state_bounds(certificate), samples.since_event
    if bounds is None or since is None:
        return ClaimBound()
    values = bounds.controller_error(samples.t_s, since.missing)
    growth = "‖e^((H+αI)τ)‖" if run.record.loop.weight is None else "‖W e^((H+αI)τ) W⁻¹‖"
    missing = f"(1 + Σ_(i<j) sup_(τ≥iδ) {growth}) β̃e^(−αt), j events missing"
    formula = f"{norm_text(run, 'e_c')} ≤ {missing}"
    void = run.violation_of(certificate)
    label = "bound, given the updates missing now"
    return ClaimBound(
        controller_error_bound(run, samples, formula, values, void=void, since_s=run.started_s),
        Envelope(label, "e_c", samples.t_s, np.where(samples.is_bounded, values, np.nan)),
    )


@certified("the estimation error is bounded")
def estimation_error(
    run: RunEvidence, samples: Samples, certificate: ScenarioCertificate, constants: Constants
) -> ClaimBound:
    """‖x̂ − x‖_W at the measurements."""
    scenario, loop = run.record.scenario, run.record.loop
    if scenario.coverage.knows_state:
        return ClaimBound()
    weight = np.eye(loop.n) if loop.weight is None else loop.weight
    here, void = samples.with_x, run.violation_of(certificate)
    t_s = samples.t_s[here]
    errors = row_norms((samples.aligned.x - samples.true_x).compress(here, axis=0) @ weight.T)
    formula = envelope_formula(norm_text(run, "x̂ − x"), certificate, "estimation_error")
    shares = upper_shares(errors, certificate.estimation_error(t_s))
    return ClaimBound(Bound(formula, t_s, shares, void, constants.estimation_error))


@certified("minimum inter-event time")
def inter_event_time(
    run: RunEvidence, samples: Samples, certificate: ScenarioCertificate, constants: Constants
) -> ClaimBound:
    """The time between two events."""
    if certificate.inter_event_s is None:
        return ClaimBound()
    void, label = run.violation_of(certificate), f"certified for {certificate.scope}"
    return least_inter_event_time(run, samples, certificate.inter_event_s, void, label)


@certified("the sensor's error is bounded")
def sensor_error(
    run: RunEvidence, samples: Samples, certificate: ScenarioCertificate, constants: Constants
) -> ClaimBound:
    """‖e_s‖_W before each reset."""
    formula = envelope_formula(norm_text(run, "e_s"), certificate, "overshoot")
    slack = run.rounding(samples.aligned.x_norm)
    shares = upper_shares(samples.aligned.e_s_norm, certificate.sensor_error(samples.t_s) + slack)
    void = run.violation_of(certificate)
    return ClaimBound(Bound(formula, samples.t_s, shares, void, constants.overshoot))


@certified("the state is bounded")
def state(
    run: RunEvidence, samples: Samples, certificate: ScenarioCertificate, constants: Constants
) -> ClaimBound:
    """‖x‖ over time."""
    formula = envelope_formula("‖x‖", certificate, "state")
    here, values = samples.with_x, certificate.state(samples.t_s)
    slack = ROUNDING * run.part.offset
    shares = upper_shares(row_norms(samples.true_x.compress(here, axis=0)), values[here] + slack)
    void = run.violation_of(certificate)
    return ClaimBound(
        Bound(formula, samples.t_s[here], shares, void, constants.state),
        Envelope(f"certified for {certificate.scope}", "x", samples.t_s, values),
    )


@certified("x stays in the region")
def region(
    run: RunEvidence, samples: Samples, certificate: ScenarioCertificate, constants: Constants
) -> ClaimBound:
    """The region of a nonlinear plant, coordinate by coordinate."""
    if certificate.region is None:
        return ClaimBound()
    here, limits = samples.with_x, np.array(certificate.region.x)
    shares = (np.abs(samples.true_x.compress(here, axis=0)) / limits).max(axis=1)
    names = run.record.loop.state_names
    formula = ", ".join(f"|{name}| ≤ {at_most(limit)}" for name, limit in zip(names, limits, strict=True))
    return ClaimBound(Bound(formula, samples.t_s[here], shares, run.violation_of(certificate)))


@certified("the state is bounded from the newest event on")
def state_from_events(
    run: RunEvidence, samples: Samples, certificate: ScenarioCertificate, constants: Constants
) -> ClaimBound:
    """‖x‖ from the newest event on, at which the sensor knows x."""
    bounds, since, t_s = run.known_state_bounds(certificate), samples.since_event, samples.t_s
    if bounds is None or since is None:
        return ClaimBound()
    most = bounds.state_deviation(t_s, since.age_s, run.missing_events(samples, since, bounds))
    predicted = row_norms(since.predicted)
    here = samples.with_x & ~np.isnan(since.age_s)
    deviation = row_norms((samples.true_x - since.predicted).compress(here, axis=0))
    shares = upper_shares(deviation, most[here] + run.rounding(predicted[here]))
    formula = "‖x − e^((A+BK)(t−t_k)) x(t_k)‖ ≤ ∫‖e^((A+BK)s) B‖ ‖u − Kx‖ds, since the event t_k"
    values = np.fmin(predicted + most, certificate.state(t_s))
    return ClaimBound(
        Bound(formula, t_s[here], shares, run.violation_of(certificate)),
        Envelope("bound, given x at the last event", "x", t_s, values),
    )
