"""Assumptions of the paper and of a certificate, checked for one scenario before it runs.

Each assumption has a status, with the reason. What a run has to do for a bound to hold of it is in the loop
document, with which the run is compared (:mod:`cosim.analysis.conformance`).
"""

import math
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from netem.core.clock import NS_PER_S
from netem.core.number_format import at_least
from noack.core.linear_systems import Matrix, spectral_abscissa
from noack.scenario.estimation import SteadyState, steady_state
from noack.scenario.resolution import LoopMatrices, loop_of, policy_of
from noack.scenario.scenario import Scenario
from noack.theory.certificates.conditions import NetworkConditions, network_delay_text
from noack.theory.certificates.normal_values import normal_limit

_OF_THEOREM_2, _OF_CERTIFICATES = "Theorem 2", "certificates"
_NOT_COVERED = "not covered by the theorems and the certificates"
_NOT_BY_THEOREMS = "not covered by the theorems"


class AssumptionStatus(StrEnum):
    """The status of an assumption."""

    HOLDS = "holds"
    VIOLATED = "violated"
    IDEALISED = "idealised"
    """No sampled loop meets it; certificates allow for the difference."""
    NOT_NEEDED = "not needed"
    """It does not hold, or is not checked; no bound depends on it."""
    ASSUMED = "assumed"
    """It is not proven; what depends on the run is checked in each run."""


class Assumption(NamedTuple):
    """One assumption and its status."""

    what: str
    source: str
    """The place in the paper, or what assumes it."""
    verdict: AssumptionStatus
    why: str


def assumptions(resolved: Scenario) -> list[Assumption]:
    """Return what is assumed of a resolved scenario, with verdicts.

    With ``certificate.paper`` these are the paper's assumptions, else those of the guarantee and of
    certificates.
    """
    if resolved.certificate.paper:
        return paper_assumptions(resolved)
    whole_loop, linear = loop_of(resolved), resolved.coverage.is_linear
    loop = whole_loop.without_loads
    checked = [_closed_loop(loop)] if linear else _not_linear(loop, resolved)[1:]
    if linear and resolved.coverage.is_decaying:
        checked.append(_decay_rate(loop, resolved.decaying.alpha_per_s))
    of_certificates = [each._replace(source=_OF_CERTIFICATES) for each in checked]
    guarantee = _mansd(resolved)._replace(source="guarantee")
    return [*of_certificates, guarantee, *_estimated(whole_loop, resolved)[1:]]


def paper_assumptions(resolved: Scenario) -> list[Assumption]:
    """Return the paper's assumptions for a resolved scenario, with verdicts."""
    whole_loop, linear = loop_of(resolved), resolved.coverage.is_linear
    loop = whole_loop.without_loads
    checked = [_closed_loop(loop)] if linear else _not_linear(loop, resolved)
    if not resolved.coverage.is_decaying:
        why = f'the policy is "{resolved.trigger.policy}": not covered by the paper\'s theorems'
        checked.append(_violated("the trigger is ‖e_s‖ > βe^(−αt)", "eq:thre", why))
    elif linear:
        checked.append(_decay_rate(loop, resolved.decaying.alpha_per_s))
    if not resolved.controller.is_linear:
        why = f'controller.kind = "{resolved.controller.kind}": {_NOT_COVERED}'
        checked.append(_violated("the input is u = K x_c", "eq:ModCont", why))
    if resolved.protocol.acknowledges:
        assumed = "the sensor resets x_s at every event; nothing is acknowledged"
        why = 'network.protocol = "ack": x_s is reset only when an acknowledgement returns'
        checked.append(_violated(assumed, "Section II", why))
    if linear:
        checked.append(_unstable_and_distinct(loop.A))
    checked += [_mansd(resolved), _continuous_time(resolved)]
    if resolved.plant.disturbances:
        kinds = ", ".join(
            f"{disturbance.kind} at the {disturbance.at}" for disturbance in resolved.plant.disturbances
        )
        checked.append(_violated("the plant is not disturbed", "eq:plant", f"{kinds}: {_NOT_BY_THEOREMS}"))
    return checked + _estimated(whole_loop, resolved)


def violated_by_gain_or_threshold(resolved: Scenario) -> list[str]:
    """Return which assumptions gain and threshold of a resolved scenario violate, each as a line."""
    return [
        f"assumption violated: {assumption.what}: {assumption.why}"
        for assumption in assumptions(resolved)
        if assumption.verdict == AssumptionStatus.VIOLATED
        and assumption.source in (_OF_THEOREM_2, _OF_CERTIFICATES)
    ]


def _violated(assumed: str, source: str, why: str) -> Assumption:
    return Assumption(assumed, source, AssumptionStatus.VIOLATED, why)


def _checked(assumed: str, source: str, holds: bool, why: str) -> Assumption:
    status = AssumptionStatus.HOLDS if holds else AssumptionStatus.VIOLATED
    return Assumption(assumed, source, status, why)


def _not_linear(loop: LoopMatrices, resolved: Scenario) -> list[Assumption]:
    nominal = spectral_abscissa(loop.A_model + loop.B_model @ loop.K)
    kind = (
        f'it is of kind "{resolved.plant.system.kind}": {_NOT_BY_THEOREMS}; a certificate may cover '
        "its equations"
    )
    why = f"largest real part of an eigenvalue: {nominal:.3g} /s (Â + B̂K){_with_other_sign(loop)}"
    return [
        _violated("the plant is ẋ = Ax + Bu", "eq:plant", kind),
        _checked("the gain stabilises the model", _OF_THEOREM_2, nominal < 0, why),
    ]


def _estimated(loop: LoopMatrices, resolved: Scenario) -> list[Assumption]:
    """Return the assumptions that replace "the sensor measures x" with an observer or noise."""
    if resolved.coverage.knows_state:
        return []
    estimation = steady_state(resolved)
    rms = float(np.sqrt(np.trace(estimation.covariance)))
    how = "with noise"
    if resolved.observer is not None:
        p = resolved.message_sizes.outputs
        entries = "1 entry" if p == 1 else f"{p} entries"
        how = f"by an observer ({resolved.observer.kind}), from y of {entries}"
    why = f"x is known {how}: {_NOT_BY_THEOREMS}"
    checked = [_violated("the sensor measures x", "Section II", why)]
    decays = estimation.radius < 1
    if resolved.observer is not None:
        error = (
            f"noise and random disturbances alone give ‖x̂ − x‖ = {rms:.3g} (RMS)"
            if decays
            else "‖x̂ − x‖ grows"
        )
        why = f"steady-state spectral radius {estimation.radius:.4g} per measurement; {error}"
        if not np.isfinite(estimation.radius):
            why = "no steady state found: model and covariances differ by too many magnitudes"
        checked.append(_checked("the observer's error decays", "(I − LC)e^(ÂT)", decays, why))
    least = policy_of(resolved).least_threshold
    if least is not None and (decays or resolved.observer is None):
        checked.append(_above_noise(loop, least, estimation))
    return checked


def _above_noise(loop: LoopMatrices, least: float, estimation: SteadyState) -> Assumption:
    """Return whether the trigger's smallest threshold is above the e_s from estimation errors.

    This e_s is the difference between the estimation error now and at the last event. Its RMS is
    √2 times that of the error if the two are uncorrelated; three times this value is rarely
    exceeded. For an unstable plant the error from the last event grows until every threshold is
    reached.
    """
    weight = np.eye(loop.n) if loop.weight is None else loop.weight
    size = float(np.sqrt(2 * np.trace(weight @ estimation.covariance @ weight.T)))
    return _checked(
        "the threshold stays above the noise",
        "trigger",
        least >= 3 * size,
        f"it falls to {least:.3g}; noise alone gives ‖e_s‖ = {size:.3g} (RMS): set "
        f"trigger.floor ≥ {3 * size:.2g}; below that, noise alone triggers",
    )


def _closed_loop(loop: LoopMatrices) -> Assumption:
    true = spectral_abscissa(loop.A + loop.B @ loop.K)
    nominal = spectral_abscissa(loop.A_model + loop.B_model @ loop.K)
    return _checked(
        "the gain stabilises the plant and the model",
        _OF_THEOREM_2,
        true < 0 and nominal < 0,
        f"largest real part of an eigenvalue: {true:.3g} /s (A + BK), {nominal:.3g} /s (Â + B̂K)"
        f"{_with_other_sign(loop)}",
    )


def other_sign(loop: LoopMatrices) -> str:
    """Return a hint if K seems to be the gain of u = −Kx, the convention of most programs; else nothing."""
    plus, minus = (spectral_abscissa(loop.A_model + sign * loop.B_model @ loop.K) for sign in (1.0, -1.0))
    return "the loop's u is +Kx, and −K would stabilise it" if minus < 0 <= plus else ""


def _with_other_sign(loop: LoopMatrices) -> str:
    return f"; {hint}" if (hint := other_sign(loop)) else ""


def _decay_rate(loop: LoopMatrices, alpha_per_s: float) -> Assumption:
    rate = -spectral_abscissa(loop.A + loop.B @ loop.K)
    assumed = "0 < α < ᾱ: the threshold decays more slowly than the closed loop"
    why = f"α = {alpha_per_s:g} /s; A + BK: {_decays(rate)}"
    return _checked(assumed, _OF_THEOREM_2, alpha_per_s < rate, why)


def _decays(rate_per_s: float) -> str:
    if rate_per_s > 0:
        return f"decay rate {rate_per_s:.3g} /s"
    return f"grows at {0.0 - rate_per_s:.3g} /s"


def _unstable_and_distinct(A: Matrix) -> Assumption:
    eigenvalues = np.linalg.eigvals(A)
    # A defective pair splits by about the square root of the rounding error.
    tolerance = math.sqrt(np.finfo(float).eps) * max(float(np.linalg.norm(A, 2)), 1.0)
    unstable = int((eigenvalues.real > tolerance).sum())
    n = len(eigenvalues)
    gaps = [abs(eigenvalues[i] - eigenvalues[j]) for i in range(n) for j in range(i)]
    distinct = min(gaps, default=math.inf) > tolerance
    count = "no eigenvalue" if unstable == 0 else f"{unstable} of {n} eigenvalues"
    why = f"{count} in the open right half plane; "
    why += "all distinct" if distinct else "repeated eigenvalues"
    holds = unstable > 0 and distinct
    return Assumption(
        "A is unstable with distinct eigenvalues",
        "Proposition 1, used by Theorem 1",
        AssumptionStatus.HOLDS if holds else AssumptionStatus.NOT_NEEDED,
        why if holds else f"{why}; used by the paper's proof, but by no bound of noack",
    )


def _mansd(resolved: Scenario) -> Assumption:
    network = resolved.network
    start = {
        "first_packet": "the first packet is delivered",
        "known_state": "sensor and controller know x(0)",
    }[network.initial_sync]
    enforced = "enforced by the network" if network.enforce_mansd else "not enforced (enforce_mansd)"
    return _checked(
        f"{network.guarantee.meaning} after a first delivery at t_0",
        "Section III",
        network.enforce_mansd,
        f"{enforced}; {start}",
    )


def _continuous_time(resolved: Scenario) -> Assumption:
    period_ms = 1e3 * resolved.timing.measurement_period_ns / NS_PER_S
    control_ms = 1e3 * resolved.timing.controller_period_ns / NS_PER_S
    return Assumption(
        "continuous trigger; network and input without delay",
        "Section II",
        AssumptionStatus.IDEALISED,
        "never true of a sampled loop; the certificates allow for the difference. Here: sampled "
        f"every {period_ms:g} ms, input held for {control_ms:g} ms"
        + (f"; {delay}" if (delay := network_delay_text(resolved)) else "")
        + _actuation_gap(resolved),
    )


def _actuation_gap(resolved: Scenario) -> str:
    if resolved.network.actuation is None:
        return ""
    if (gap_ns := resolved.timing.actuation_gap_ns) is None:
        return "; nothing limits the losses of actuations"
    text = f"; losses and delays hold up actuations by up to {1e3 * gap_ns / NS_PER_S:g} ms"
    if resolved.controller.predictions > 1:
        text += f", and each has inputs for {1e3 * resolved.timing.predicted_ns / NS_PER_S:g} ms"
    return text


def certificate_assumptions(
    resolved: Scenario, conditions: NetworkConditions, probability: float | None
) -> list[Assumption]:
    """Return the assumptions of a certificate, with verdicts.

    ``probability`` is that of a run that keeps a guarantee that nothing enforces, if it is known.
    """
    checked = _conditions(conditions, resolved, probability)
    if not resolved.coverage.is_undisturbed:
        assumed, source = "disturbances and noise stay within their bounds", "certificate"
        status, why = AssumptionStatus.HOLDS, "by their settings"
        if (limit := normal_limit(resolved)) is not None:
            status, why = AssumptionStatus.ASSUMED, "normal values have no bound"
            assumed = (
                f"normal values stay within {limit:.3g} standard deviations; a run exceeds them with a "
                f"probability of at most {resolved.certificate.exceedance_probability:g}"
            )
        checked.append(Assumption(assumed, source, status, why))
    return checked


def _conditions(
    conditions: NetworkConditions, resolved: Scenario, probability: float | None
) -> list[Assumption]:
    # The guarantee on the losses.
    enforced = resolved.network.enforce_mansd
    why = "enforced by the network" if enforced else "not enforced"
    if probability is not None:
        horizon_s = resolved.timing.horizon_ns / NS_PER_S
        known = (
            f"with probability {at_least(probability)} or more (computed)"
            if probability > 0
            else "with a probability that may be 0"
        )
        why += f"; a run of {horizon_s:g} s keeps it {known}"
    losses = Assumption(
        f"{conditions.guarantee.meaning} after a first delivery at t_0",
        "certificate",
        AssumptionStatus.HOLDS if enforced else AssumptionStatus.ASSUMED,
        why,
    )
    # The times of the loop, which each run checks.
    sampling = f"every {1e3 * conditions.sampling_s:g} ms" if conditions.sampling_s else "continuously"
    delay = network_delay_text(resolved) if conditions.delay_s else ""
    network = f"; {delay}" if delay else ""
    youngest = f"−{1e3 * conditions.lead_s:g}" if conditions.lead_s else "0"
    ages = f"{youngest} to {1e3 * conditions.hold_s:g}"
    schedule = (
        (f"the trigger is tested {sampling}", ""),
        (f"an update reaches the plant within {1e3 * conditions.delay_s:g} ms of its event", network),
        (f"the applied input is {ages} ms old", ""),
        (f"the first input arrives within {1e3 * conditions.start_s:g} ms", ""),
    )
    status = AssumptionStatus.ASSUMED
    return [
        losses,
        *(
            Assumption(assumed, "certificate", status, f"checked in each run{why}")
            for assumed, why in schedule
        ),
    ]
