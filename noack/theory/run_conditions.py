"""The conditions under which a scenario runs: of its own schedule, and the paper's ideal ones."""

import math

from noack.config.scenario import Scenario
from noack.core.clock import NS_PER_S
from noack.theory.certificate import NetworkConditions


def nominal_conditions(resolved: Scenario, late_periods: int = 0) -> NetworkConditions:
    """The conditions of a scenario's own schedule, if what is late is so by ``late_periods`` steps.

    In the plant's time, for all rates: an update takes effect from the first step on whose newest
    tick is not before it, and the model state behind an input ages until the step after the one
    that latched it. The plant steps before it takes what arrives at the same time. A delay of the
    network that has no bound is taken at four times its jitter; a run that exceeds that leaves the
    conditions.
    """
    step_ns, tick_ns = resolved.timing.plant_period_ns, resolved.timing.controller_period_ns
    phase_ns, sample_ns = (
        resolved.timing.controller_phase_ns,
        step_ns * resolved.plant.measure_every,
    )
    # From a step back to the tick before: 0 < age ≤ tick, and age ≡ −phase modulo the gcd, all of
    # which occur sooner or later. From a measurement on to the next tick: 0 ≤ wait < tick.
    newest_ns = tick_ns - phase_ns % math.gcd(step_ns, tick_ns)
    common_ns = math.gcd(sample_ns, tick_ns)
    wait_ns = tick_ns - common_ns + phase_ns % common_ns
    late_ns = late_periods * step_ns
    under_way_ns = late_ns + math.ceil(resolved.network.link.longest_delay_s * NS_PER_S)
    if under_way_ns > 0:  # an update that is late by any time up to that may just miss a tick
        wait_ns = under_way_ns + tick_ns - 1
    delay_ns, first_ns = ((t_ns // step_ns + 1) * step_ns for t_ns in (wait_ns, phase_ns))
    start_ns = first_ns if under_way_ns == 0 else max(first_ns + late_ns, delay_ns)
    return NetworkConditions(
        dropouts=resolved.network.mansd,
        sampling_s=sample_ns / NS_PER_S,
        spacing_s=sample_ns / NS_PER_S,
        delay_s=delay_ns / NS_PER_S,
        hold_s=(newest_ns + step_ns + late_ns) / NS_PER_S,
        start_s=start_ns / NS_PER_S,
    )


def allowed_conditions(resolved: Scenario) -> NetworkConditions:
    """The conditions of a scenario's certificates: its own schedule, with its allowance."""
    return nominal_conditions(resolved, resolved.certificate.late_periods)


def ideal_conditions(resolved: Scenario) -> NetworkConditions:
    """The paper's conditions: a continuous trigger, a network and input without delay."""
    return NetworkConditions(dropouts=resolved.network.mansd)
