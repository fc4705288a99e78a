"""Why there is no certificate, if that follows from several settings, or from settings and times.

What follows from single keys is in :mod:`noack.theory.coverage`. Each reason begins with a key.
"""

import math
from collections.abc import Mapping

import numpy as np

from noack.core.clock import NS_PER_S
from noack.core.periods import nearest_ns
from noack.scenario.resolution import loop_of, setpoint_of
from noack.scenario.scenario import Scenario
from noack.theory.bounds.certificate_terms import NetworkConditions
from noack.theory.bounds.disturbances import excluded_probability
from noack.theory.bounds.reference_limits import ReferenceLimits
from noack.theory.certificates.conditions import BOX, OWN_PLANT, REGION, first_input_ns, nominal_conditions


def refusal_under(
    conditions: NetworkConditions,
    resolved: Scenario,
    plants: str,
    *,
    knows_delay: bool = False,
    knows_inputs: bool = False,
    start_error: float = 0.0,
) -> str | None:
    """Return why there is no certificate under some conditions; None: there may be one.

    Args:
        conditions: the times that are assumed.
        resolved: the scenario.
        plants: the name of the plants that it would cover.
        knows_delay: the largest delay of updates is that of the conditions, even if the scenario
            does not state it.
        knows_inputs: a run checks which inputs the plant applies, at its start and from its watchdog.
        start_error: as for :class:`CertificateScope`, 0 if it is None there.
    """
    if resolved.model.load_states:
        return "model.load: a constant load does not decay; no bound is computed, but one may be proven"
    if not knows_delay and (why := _without_delay(conditions, resolved)) is not None:
        return why
    if not knows_inputs:
        why = _safe_input(conditions, resolved) or _watchdog(conditions, resolved)
        if why is not None:
            return why
    if (why := refusal_of_steps(resolved)) is not None:
        return why
    if resolved.observer is not None:
        if start_error:
            return "controller.setpoint: with an observer, only where the first input is not wrong"
        if plants in (BOX, REGION):
            kind = resolved.observer.kind
            return f'observer.kind = "{kind}": its error is bounded for one plant only, not for a box'
    if math.isinf(start_error):
        return "controller.setpoint: the first input was not known, or not in the range of K as bounds assume"
    return None


def _without_delay(conditions: NetworkConditions, resolved: Scenario) -> str | None:
    """Return why there is none if a queue delays updates and no largest delay is stated."""
    network = resolved.network
    if not conditions.delay_s or resolved.certificate.network_delay_s is not None:
        return None
    queues = [index for index, impairment in enumerate(network.impairments) if impairment.queues]
    if not queues:
        return None
    return (
        "certificate.network_delay_s: state the largest delay of updates, which the run checks; that in "
        f"the queue of network.impairments.{queues[0]} is not known before"
    )


def _safe_input(conditions: NetworkConditions, resolved: Scenario) -> str | None:
    """Return why there is none if a safe input other than 0 may come before the first update.

    If the input of the first tick is in time for ``conditions.start_s``, none comes.
    """
    if not any(resolved.controller.safe_input or ()) or resolved.network.initial_sync == "known_state":
        return None
    if conditions.start_s <= first_input_ns(resolved) / NS_PER_S:
        return None
    return "controller.safe_input: it may be the input before the first update, where bounds assume 0"


def _watchdog(conditions: NetworkConditions, resolved: Scenario) -> str | None:
    """Return why there is none if the watchdog may replace an input that is not too old.

    At a step, an input is at most as old as ``conditions.hold_s``, less the step until the next one.
    Where actuations cross the network, the settings are checked with their losses.
    """
    watchdog, timing = resolved.plant.watchdog, resolved.timing
    if watchdog.policy == "hold" or resolved.network.actuation is not None:
        return None
    oldest_s = conditions.hold_s - timing.plant_period_ns / NS_PER_S
    if timing.actuation_timeout_ns / NS_PER_S >= oldest_s * (1 - 1e-12):
        return None
    return (
        "plant.watchdog.timeout_s: the watchdog may replace an input, which may be "
        f"{1e3 * oldest_s:g} ms old at a step; set it to at least that"
    )


def refusal_of_steps(resolved: Scenario) -> str | None:
    """Return why there is none if the plant's steps differ by 1 ns.

    An observer's steps are then not those of the plant, and sums of normal values not those of equal steps.
    """
    rate_hz, is_estimated = resolved.plant.rate_hz, resolved.observer is not None
    is_normal = excluded_probability(resolved) > 0
    if resolved.timing.plant_period.is_whole or not (is_estimated or is_normal):
        return None
    what = "an observer" if is_estimated else "normally distributed disturbances or noise"
    nearest_hz = NS_PER_S / nearest_ns(resolved.timing.plant_period.exact)
    return (
        f"plant.rate_hz = {rate_hz:g}: bounds with {what} need a period of whole nanoseconds; "
        f"the nearest such rate is {nearest_hz!r}"
    )


def refusals_about_reference(resolved: Scenario, *, knows_inputs: bool = False) -> Mapping[str, str]:
    """Return by plants why there is no certificate at the set-point, or about the reference.

    Until the first input arrives, the input is 0, and not u_r; ``knows_inputs``: a run shows how long.
    """
    setpoint = setpoint_of(resolved)
    if resolved.controller.reference is not None:
        return _refusals_of_moving(resolved)
    if setpoint is None:
        return {}
    if not resolved.coverage.is_linear:
        return {
            REGION: "controller.setpoint: the region of a nonlinear plant is one about 0, and not about a "
            "set-point"
        }
    x_r, u_r = setpoint
    if u_r.any() and not knows_inputs:
        start_s = nominal_conditions(resolved, resolved.certificate.late_periods).start_s
        why = (
            "controller.setpoint: the input is 0 until the first one arrives, and not the set-point's "
            "u_r ≠ 0; a [[controller.reference]] that steps there, with a join_s and from_s above "
            f"{start_s:g}, can be certified"
        )
        return dict.fromkeys((OWN_PLANT, BOX), why)
    half_A, half_B = resolved.plant.uncertainty_A, resolved.plant.uncertainty_B
    moved = np.zeros(len(x_r)) if half_A is None else np.array(half_A) @ np.abs(x_r)
    moved = moved + (0.0 if half_B is None else np.array(half_B) @ np.abs(u_r))
    if moved.any():
        return {BOX: "controller.setpoint: not every plant of the box rests there, A x_r + B u_r ≠ 0"}
    return {}


def _refusals_of_moving(resolved: Scenario) -> Mapping[str, str]:
    """Return by plants why there is no certificate about a reference that changes over time."""
    if not resolved.coverage.is_linear:
        return {REGION: "controller.reference: the region of a nonlinear plant is one about 0"}
    start_s = nominal_conditions(resolved, resolved.certificate.late_periods).start_s
    reference = loop_of(resolved).reference
    assert reference is not None
    if ReferenceLimits(reference, resolved.timing.horizon_ns).is_at_rest_until(start_s):
        return {}
    why = (
        "controller.reference: the input is 0 until the first one arrives, and not u_r; begin the first "
        f"piece after {start_s:g} s"
    )
    return dict.fromkeys((OWN_PLANT, BOX), why)
