"""The times of a scenario's loop, as far as they are known whatever its sensor measures.

The margin and the moments need a linear loop, a longest time between two transmissions, a constant
delay, and a watchdog that does not act.
"""

import math
from fractions import Fraction

import numpy as np

from netem.core.clock import NS_PER_S
from netem.core.errors import CallerError
from netem.impairments.kinds.delay import Delay
from noack.core.linear_systems import Vector
from noack.proof.period_times import NEVER, LoopTimes
from noack.scenario.arrival_ties import WITHOUT_DELAY
from noack.scenario.resolution import reference_of, rule_of
from noack.scenario.scenario import Scenario
from noack.theory.coverage import require_exact

_MOST_ON_THEIR_WAY = 40
"""Most updates on their way at once, times the number of states: the size of what is followed."""


def require_covered(resolved: Scenario) -> None:
    """Raise CallerError unless the loop is linear, transmits in time, and the watchdog is idle."""
    resolved.coverage.require_direct_inputs()
    require_exact(_at_rest(without_timeout(resolved)))
    resolved.coverage.require_constant()
    require_idle_watchdog(resolved)


def steady_reference(resolved: Scenario) -> tuple[Vector, Vector] | None:
    """Return x_r and u_r at t = 0, (n + m,), and how fast they move, of a reference whose input is constant.

    So is that of a set-point, also where the integral of the error is a state: about it, this state moves.
    None: the reference is another one.
    """
    reference, (n, m) = reference_of(resolved), resolved.model.dimensions
    if reference is None:
        return np.zeros(n + m), np.zeros(n + m)
    segment = reference.segments[0]
    moving = np.zeros((2, n + m))
    if reference.since_ns or segment.sines.any() or segment.cosines.any() or len(segment.polynomial) > 2:
        return None
    moving[: len(segment.polynomial)] = segment.polynomial
    if moving[1, n:].any() or (np.array(resolved.model.A) @ moving[1, :n]).any():
        return None
    return moving[0], moving[1]


def _at_rest(resolved: Scenario) -> Scenario:
    """Return a scenario without its set-point, if what it follows is one: the states are those about it."""
    if steady_reference(resolved) is None:
        return resolved
    controller = resolved.controller.model_copy(update={"reference": None, "setpoint": None})
    return resolved.model_copy(update={"controller": controller})


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


def intervals(resolved: Scenario) -> range:
    """Return the times that may be between two transmissions, in measurements.

    Raises:
        CallerError: there is no longest time.
    """
    rule, measurement = rule_of(resolved), resolved.timing.measurement_period
    if rule.longest_ns == math.inf:
        raise CallerError(
            f'trigger.policy = "{resolved.trigger.policy}": this needs a longest time '
            "between two events, as periodic and deadline have; use e.g. "
            "--set 'trigger={policy=\"periodic\", period_s=0.5}'"
        )
    # An event that is due between two measurements happens at the later one.
    shortest, longest = (
        max(math.ceil(Fraction(time_ns) / measurement.exact), 1)
        for time_ns in (rule.earliest_ns, rule.longest_ns)
    )
    return range(shortest, longest + 1)


def loop_times(resolved: Scenario, measurements: int) -> LoopTimes:
    """Return the times of a loop with an update after so many measurements, or at multiples of it.

    An update may be on its way for several such times.

    They are the exact times of :class:`noack.scenario.scenario_tables.Timing`, in whole parts of a
    nanosecond.

    Raises:
        CallerError: too many updates are on their way, or they become too old on it.
    """
    timing = resolved.timing
    periods = timing.plant_period, timing.controller_period, timing.measurement_period.times(measurements)
    step, tick, unit = (period.exact for period in periods)
    delay, phase = update_delay_ns(resolved), timing.exact_controller_phase
    timeout_s = resolved.controller.update_timeout_s
    timeout = timing.exact_time(timeout_s or 0.0, timing.update_timeout_ns)
    behind = int(delay // unit)
    _require_few_on_their_way(resolved, float(delay / NS_PER_S), periods[-1].seconds, behind)
    parts = math.lcm(*(time.denominator for time in (step, tick, unit, phase, delay, timeout)))

    def whole(time_ns: Fraction) -> int:
        return int(time_ns * parts)

    return LoopTimes(
        whole(step),
        whole(tick),
        whole(phase),
        whole(unit),
        whole(delay - behind * unit),
        NEVER if timeout_s is None else whole(timeout),
        resolved.controller.timeout_input == "hold",
        parts,
        behind,
    )


def _require_few_on_their_way(resolved: Scenario, delay_s: float, period_s: float, behind: int) -> None:
    """Raise CallerError unless a delay of some periods, rounded down, is covered."""
    most = _MOST_ON_THEIR_WAY // resolved.model.dimensions[0]
    if behind > most:
        raise CallerError(
            f"network.impairments: a delay of {delay_s:g} s is {behind} periods of {period_s:g} s; "
            f"a loop of this size is followed for at most {most}"
        )


def require_usable_updates(resolved: Scenario, times: LoopTimes) -> None:
    """Raise CallerError if updates expire that may be on their way for a period."""
    if times.behind and resolved.controller.update_timeout_s is not None:
        delay_s, period_s = times.seconds(times.whole_delay), times.seconds(times.period)
        raise CallerError(
            f"controller.update_timeout_s: not covered with a delay of {delay_s:g} s, which is longer than "
            f"the {period_s:g} s between two updates"
        )


def update_delay_ns(resolved: Scenario) -> Fraction:
    """Return the constant delay of the updates; raise CallerError if it may vary.

    In a loop whose periods are whole nanoseconds, each delay is one, too.
    """
    delay_ns = Fraction(0)
    for number, impairment in enumerate(resolved.network.impairments):
        constant = isinstance(impairment, Delay) and not (
            impairment.jitter_s or impairment.samples_s or impairment.file
        )
        if isinstance(impairment, Delay) and constant:
            delay_ns += resolved.timing.exact_time(impairment.delay_s, impairment.constant_ns)
        elif impairment.kind not in WITHOUT_DELAY:
            raise CallerError(
                f"network.impairments.{number}: {impairment.kind}: this needs a constant "
                "delay; use delay_s alone"
            )
    return delay_ns
