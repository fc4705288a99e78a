"""The times of a scenario's loop, as far as they are known whatever its sensor measures.

The margin and the moments need a linear loop, a longest time between two transmissions, a constant
delay, and a watchdog that does not act.
"""

import math

import numpy as np

from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.core.periods import nearest_ns
from noack.impairments.kinds.delay import Delay
from noack.scenario.resolution import rule_of, setpoint_of
from noack.scenario.scenario import Scenario
from noack.theory.margins.time_triggered_loop import LoopTimes

_WITHOUT_DELAY = ("loss", "corrupt", "blackout", "duplicate")
"""Kinds of impairments that do not change the delay of a packet."""


def require_covered(resolved: Scenario) -> None:
    """Raise CallerError unless the loop is linear, transmits in time, and the watchdog is idle."""
    resolved.coverage.require_direct_inputs()
    without_timeout(resolved).coverage.require_exact()
    resolved.coverage.require_constant()
    require_idle_watchdog(resolved)
    if resolved.controller.update_timeout_s is None or resolved.controller.timeout_input == "hold":
        return
    setpoint, m = setpoint_of(resolved), resolved.model.dimensions[1]
    at_rest = np.zeros(m) if setpoint is None else setpoint[1]
    if not np.allclose(resolved.controller.safe_input or np.zeros(m), at_rest, rtol=1e-9, atol=0):
        raise CallerError(
            "controller.safe_input: with update_timeout_s the margin needs the input at rest, "
            f"{[float(f'{u:.10g}') for u in at_rest]}"
        )


def without_timeout(scenario: Scenario) -> Scenario:
    """Return a scenario whose controller uses every update, however old."""
    controller = scenario.controller.model_copy(update={"update_timeout_s": None})
    return scenario.model_copy(update={"controller": controller})


def require_idle_watchdog(resolved: Scenario) -> None:
    """Raise CallerError if the watchdog may replace the controller's inputs."""
    timing = resolved.timing
    if timing.plant_period_ns + timing.controller_period_ns > timing.actuation_timeout_ns:
        raise CallerError(
            "plant.watchdog.timeout_s: shorter than the age of the actuations without any delay"
        )


def require_whole_periods(resolved: Scenario) -> None:
    """Raise CallerError if steps differ by 1 ns: an exact loop repeats the same ones."""
    timing = resolved.timing
    for key, period in (("plant", timing.plant_period), ("controller", timing.controller_period)):
        if not period.is_whole:
            nearest_hz = NS_PER_S / nearest_ns(period.exact)
            raise CallerError(
                f"{key}.rate_hz: this needs a period of whole nanoseconds; "
                f"the nearest such rate is {nearest_hz!r}"
            )


def intervals_ns(resolved: Scenario) -> tuple[int, int]:
    """Return the shortest and the longest time between two transmissions, as measurements allow.

    Raises:
        CallerError: there is no longest time.
    """
    require_whole_periods(resolved)
    rule, step_ns = rule_of(resolved), resolved.timing.measurement_period_ns
    if rule.longest_ns == math.inf:
        raise CallerError(
            f'trigger.policy = "{resolved.trigger.policy}": this needs a longest time '
            "between two events, as periodic and deadline have; use e.g. "
            "--set 'trigger={policy=\"periodic\", period_s=0.5}'"
        )
    shortest_ns = max(math.ceil(rule.earliest_ns / step_ns), 1) * step_ns
    return shortest_ns, int(rule.latest_ns(step_ns))


def loop_times(resolved: Scenario, unit_ns: int) -> LoopTimes:
    """Return the times of a loop with an update every ``unit_ns``, or at multiples of it.

    Raises:
        CallerError: the delay of the updates is longer.
    """
    require_whole_periods(resolved)
    timing, delay_ns = resolved.timing, update_delay_ns(resolved)
    if delay_ns >= unit_ns:
        is_every = unit_ns != timing.measurement_period_ns
        pair = "two updates" if is_every else "two measurements"
        raise CallerError(
            f"network.impairments: a delay of {delay_ns / NS_PER_S:g} s; expected less "
            f"than the period between {pair}, {unit_ns / NS_PER_S:g} s"
        )
    return LoopTimes(
        timing.plant_period_ns,
        timing.controller_period_ns,
        timing.controller_phase_ns,
        unit_ns,
        delay_ns,
        timing.update_timeout_ns,
        resolved.controller.timeout_input == "hold",
    )


def update_delay_ns(resolved: Scenario) -> int:
    """Return the constant delay of the updates; raise CallerError if it may vary."""
    delay_ns = 0
    for number, impairment in enumerate(resolved.network.impairments):
        constant = isinstance(impairment, Delay) and not (
            impairment.jitter_s or impairment.samples_s or impairment.file
        )
        if isinstance(impairment, Delay) and constant:
            delay_ns += impairment.constant_ns
        elif impairment.kind not in _WITHOUT_DELAY:
            raise CallerError(
                f"network.impairments.{number}: {impairment.kind}: this needs a constant "
                "delay; use delay_s alone"
            )
    return delay_ns
