"""The conditions of a scenario's run: those of its own schedule, and the paper's ideal ones."""

import math
from typing import Any

from noack.config.scenario import Scenario
from noack.core.clock import NS_PER_S
from noack.impairments.loss_guarantee import LongestBurst, LossGuarantee
from noack.impairments.loss_process import loss_process
from noack.impairments.markov_chain import NotPredictableError
from noack.theory.certificate_terms import NetworkConditions


def nominal_conditions(resolved: Scenario, late_periods: int = 0) -> NetworkConditions:
    """Return the conditions of a scenario's schedule, with lateness up to ``late_periods`` steps.

    The conditions are in the plant's time and hold for all rates. An update takes effect at the
    first step with an actuation from a tick at or after the update. The model state of an applied
    input ages until the step after it. At equal times, the plant's step comes before arrivals. If
    the network delay has no bound, four times its jitter is used; a run with a longer delay
    violates the conditions. Lost and delayed actuations delay updates and make inputs older; if
    their losses have no bound, an input may be as old as the run. Of predicted inputs, the plant
    applies the one whose time has come.
    """
    step_ns, tick_ns = resolved.timing.plant_period_ns, resolved.timing.controller_period_ns
    phase_ns, sample_ns = (
        resolved.timing.controller_phase_ns,
        step_ns * resolved.plant.measure_every,
    )
    # Age of the newest tick at a step: 0 < age ≤ tick and age ≡ −phase modulo the gcd; all these
    # values occur. Time from a measurement to the next tick: 0 ≤ wait < tick.
    newest_ns = tick_ns - phase_ns % math.gcd(step_ns, tick_ns)
    common_ns = math.gcd(sample_ns, tick_ns)
    wait_ns = tick_ns - common_ns + phase_ns % common_ns
    late_ns = late_periods * step_ns
    under_way_ns = network_delay_ns(resolved, late_periods)
    if under_way_ns > 0:  # an update in flight for up to this time may just miss a tick
        wait_ns = under_way_ns + tick_ns - 1
    gap_ns = resolved.timing.actuation_gap_ns
    if gap_ns is None:
        gap_ns = resolved.timing.horizon_ns
    delay_ns, first_ns = (
        ((t_ns + gap_ns) // step_ns + 1) * step_ns for t_ns in (wait_ns, phase_ns)
    )
    # With a delay, the newest actuation that has arrived may just be one tick older than that.
    oldest_ns = gap_ns + (newest_ns if gap_ns % tick_ns == 0 else tick_ns)
    predicted_ns = resolved.timing.predicted_ns - tick_ns
    age_ns = max(min(oldest_ns, tick_ns), oldest_ns - predicted_ns)
    start_ns = first_ns if under_way_ns == 0 else max(first_ns + late_ns, delay_ns)
    return NetworkConditions(
        **_losses(resolved),
        sampling_s=sample_ns / NS_PER_S,
        spacing_s=sample_ns / NS_PER_S,
        delay_s=delay_ns / NS_PER_S,
        hold_s=(age_ns + step_ns + late_ns) / NS_PER_S,
        start_s=start_ns / NS_PER_S,
    )


def certified_delay_s(resolved: Scenario) -> float:
    """The network delay that the certificates allow for: as given, or the longest one."""
    given_s = resolved.certificate.network_delay_s
    return resolved.network.link.longest_delay_s if given_s is None else given_s


def network_delay_ns(resolved: Scenario, late_periods: int) -> int:
    """Return the longest time for which the network may delay an update under these conditions."""
    late_ns = late_periods * resolved.timing.plant_period_ns
    return late_ns + math.ceil(certified_delay_s(resolved) * NS_PER_S)


def allowed_conditions(resolved: Scenario) -> NetworkConditions:
    """The conditions of a scenario's certificates: its own schedule, with its allowance."""
    return nominal_conditions(resolved, resolved.certificate.late_periods)


def ideal_conditions(resolved: Scenario) -> NetworkConditions:
    """The paper's conditions: a continuous trigger, a network and input without delay."""
    return NetworkConditions(**_losses(resolved))


def most_events(resolved: Scenario, inter_event_s: float) -> int:
    """Return the largest number of events in a run, given a bound of its inter-event times."""
    return math.floor(resolved.timing.horizon_ns / NS_PER_S / inter_event_s * (1 + 1e-12)) + 1


def kept_probability(
    resolved: Scenario, guarantee: LossGuarantee, inter_event_s: float | None
) -> float | None:
    """Bound the probability that a run's losses keep a guarantee that nothing enforces.

    Until the first loss too many, events are at least ``inter_event_s`` apart. None: there is no
    such bound, or the losses are no Markov chain over the packets.
    """
    if not inter_event_s:
        return None
    try:
        losses = loss_process(resolved.network.link)
        return losses.keeps(guarantee, most_events(resolved, inter_event_s))
    except NotPredictableError:
        return None


def _losses(resolved: Scenario) -> dict[str, Any]:
    """Return what the guarantee says: its longest burst, and its rules except the cap M − 1."""
    guarantee = resolved.network.guarantee
    further = [rule for rule in guarantee.rules if not isinstance(rule, LongestBurst)]
    return {"dropouts": guarantee.longest_burst, "constraints": tuple(further)}
