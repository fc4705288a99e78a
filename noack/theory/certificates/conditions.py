"""The conditions of a scenario's run, its own and the paper's; and a reference moved to 0.

At a set-point x_r the loop is described in the coordinates x − x_r, x_s − x_r and x_c − x_r. The
models rest at x_r with u_r: Âx_r + B̂u_r = 0.
"""

import math
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from netem.core.clock import NS_PER_S
from netem.core.periods import exact_ns
from netem.core.settings_section import Table
from netem.guarantee.loss_guarantee import LongestBurst, LossGuarantee, LossRule
from netem.impairments.markov_chain import NotPredictableError
from netem.impairments.target_loss import loss_process
from noack.core.cached_method import cached_method
from noack.core.linear_systems import Matrix
from noack.core.references import Reference
from noack.references.segment import SolutionSegment
from noack.scenario.estimation import assumed_model
from noack.scenario.resolution import loop_of, setpoint_of
from noack.scenario.scenario import Scenario
from noack.settings.values import MatrixRows
from noack.theory.certificates.normal_values import normal_limit, with_bounded_values
from noack.theory.certificates.proven_bounds import ProvenBounds

OWN_PLANT = "the scenario's plant"
BOX = "every plant of the uncertainty box"
EQUATIONS = "the scenario's plant, by its equations"
"""The plants that a certificate covers, by name."""
_ROUNDED_NS = 2
"""More than two times of steps differ from exact ones, together."""
_ROUNDED_JUMP = 1e-9
"""A difference between two pieces of a reference is rounding up to this share of the largest x_r or u_r."""


class NetworkConditions(NamedTuple):
    """The assumptions of a certificate about network and schedule, in the plant's time.

    They are not a schedule, but what may happen at most under one with delays and lateness: see
    :func:`nominal_conditions`.
    """

    dropouts: int
    """The largest number of consecutive losses: M − 1, or less by further constraints."""
    sampling_s: float = 0.0
    """h, the longest time between two tests of the trigger; 0 is a continuous trigger."""
    spacing_s: float = 0.0
    """The shortest time between two tests; all other times between tests are multiples of it. 0: tests
    are at any times, at least ``apart_s`` apart."""
    delay_s: float = 0.0
    """d, the longest time from an event until a delivered update affects the plant's input."""
    hold_s: float = 0.0
    """σ, the largest age of the applied input: by how much its model time is before the time."""
    start_s: float = 0.0
    """Time from which the plant applies the controller's input; before, its input is 0."""
    constraints: tuple[LossRule, ...] = ()
    """Further rules of the guarantee."""
    apart_s: float = 0.0
    """The shortest time between two tests that are on no grid."""
    lead_s: float = 0.0
    """σ⁻, by how much the model time of the applied input may be after the time, as at a late step of the
    plant: no schedule has such inputs, whatever lateness it allows."""

    @property
    def guarantee(self) -> LossGuarantee:
        """All rules that the network keeps."""
        return LossGuarantee((LongestBurst(self.dropouts), *self.constraints))


@cached_method
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
    timing = resolved.timing
    step_ns, tick_ns = timing.plant_period.exact, timing.controller_period.exact
    phase_ns, sample_ns = timing.controller_phase_ns, timing.measurement_period.exact
    rounded_ns = _rounded_ns(resolved)
    # Age of the newest tick at a step: 0 < age ≤ tick and age ≡ −phase modulo the gcd; all these
    # values occur. Time from a measurement to the next tick: 0 ≤ wait < tick.
    newest_ns = tick_ns - phase_ns % _gcd(step_ns, tick_ns) + rounded_ns
    common_ns = _gcd(sample_ns, tick_ns)
    wait_ns = tick_ns - common_ns + phase_ns % common_ns
    late_ns = late_periods * timing.plant_period_ns
    in_flight_ns = network_delay_ns(resolved, late_periods)
    if in_flight_ns > 0:  # an update in flight for up to this time may just miss a tick
        wait_ns = in_flight_ns + tick_ns - 1
        if rounded_ns:  # of the possible times, the largest one below
            rest_ns = phase_ns % common_ns
            wait_ns = (math.ceil((wait_ns + 1 - rest_ns) / common_ns) - 1) * common_ns + rest_ns
    gap_ns = _actuation_gap_ns(resolved)
    delay_ns, first_ns = (_next_step_ns(resolved, t_ns + gap_ns) for t_ns in (wait_ns, phase_ns))
    # With a delay, the newest actuation that has arrived may just be one tick older than that.
    oldest_ns = gap_ns + (newest_ns if gap_ns % tick_ns == 0 else tick_ns + rounded_ns)
    predicted_ns = timing.predicted_ns - tick_ns
    age_ns = math.ceil(max(min(oldest_ns, tick_ns + rounded_ns), oldest_ns - predicted_ns))
    start_ns = first_ns if in_flight_ns == 0 else max(first_ns + late_ns, delay_ns)
    return ideal_conditions(resolved)._replace(
        sampling_s=timing.measurement_period_ns / NS_PER_S,
        spacing_s=0.0 if rounded_ns else timing.measurement_period_ns / NS_PER_S,
        apart_s=timing.measurement_period.lengths_ns[0] / NS_PER_S if rounded_ns else 0.0,
        delay_s=delay_ns / NS_PER_S,
        hold_s=(age_ns + timing.plant_period_ns + late_ns) / NS_PER_S,
        start_s=start_ns / NS_PER_S,
    )


def _rounded_ns(resolved: Scenario) -> int:
    """Return by how much times of steps, together, differ from exact ones; their order may, too."""
    return 0 if resolved.timing.has_whole_periods else _ROUNDED_NS


def _next_step_ns(resolved: Scenario, t_ns: Fraction | int) -> int:
    """Return a time up to which the plant's next step after a time has come."""
    step_ns, rounded_ns = resolved.timing.plant_period.exact, _rounded_ns(resolved)
    return math.ceil(((t_ns + rounded_ns) // step_ns + 1) * step_ns) + rounded_ns


def _gcd(first: Fraction, second: Fraction) -> Fraction:
    """Return the largest time of which both are multiples."""
    unit = first.denominator * second.denominator
    return Fraction(math.gcd(int(first * unit), int(second * unit)), unit)


def _actuation_gap_ns(resolved: Scenario) -> int:
    """Return the longest time by which the newest actuation is held up; without a bound, the run's length."""
    gap_ns, horizon_ns = resolved.timing.actuation_gap_ns, resolved.timing.horizon_ns
    return horizon_ns if gap_ns is None else gap_ns


def certified_delay_s(resolved: Scenario) -> float:
    """The network delay that the certificates allow for.

    As given; else the longest delay of the impairments, in which a queue counts as full, and an
    unbounded jitter four times.
    """
    given_s = resolved.certificate.network_delay_s
    return resolved.network.link.longest_delay_s if given_s is None else given_s


def with_stated_numbers(resolved: Scenario) -> Scenario:
    """Return a resolved scenario with numbers in place of what follows from other keys.

    These are the network delay that certificates allow for, the watchdog's timeout, the covariances of a
    Kalman filter, and the input of a set-point, which becomes a constant reference; their effect stays the
    same. In the place of normally distributed values there are those within the bounds that a run keeps but
    for a small probability. The delay in a queue is not known: if it is not stated, it stays so.
    """
    update: Table = {}
    if not resolved.network.link.queues:
        stated = {"network_delay_s": float(certified_delay_s(resolved))}
        update["certificate"] = resolved.certificate.model_copy(update=stated)
    timeout_s = resolved.timing.actuation_timeout_ns / NS_PER_S
    watchdog = resolved.plant.watchdog.model_copy(update={"timeout_s": timeout_s})
    update["plant"] = with_bounded_values(resolved).model_copy(update={"watchdog": watchdog})
    if resolved.observer is not None:
        update["observer"] = resolved.observer.stated(assumed_model(resolved))
    if (setpoint := setpoint_of(resolved)) is not None:
        states = resolved.model.followed_states
        (segment,) = Reference.constant(setpoint[0][:states], setpoint[1]).segments
        pieces = {"reference": (SolutionSegment.of(segment, states),), "setpoint": None}
        update["controller"] = resolved.controller.model_copy(update=pieces)
    return resolved.model_copy(update=update)


def network_delay_text(resolved: Scenario) -> str:
    """Return in words which network delay the certificates allow for; empty: none is needed."""
    link, given_s = resolved.network.link, resolved.certificate.network_delay_s
    longest_s = link.longest_delay_s
    delays = f"the network delays updates by up to {1e3 * longest_s:g} ms" if link.delay_is_bounded else ""
    if given_s is not None and given_s != longest_s:
        allowance = f"certificate.network_delay_s allows for a delay of {1e3 * given_s:g} ms"
        return f"{delays}; {allowance}" if delays and longest_s else allowance
    if link.delay_is_bounded:
        return delays if longest_s else ""
    if link.queues:
        return "no bound of the delay in the network's queue is known: state certificate.network_delay_s"
    return f"no bound of the network's delay is known; the certificates allow for {1e3 * longest_s:g} ms"


def network_delay_ns(resolved: Scenario, late_periods: int) -> int:
    """Return the longest time for which the network may delay an update under these conditions."""
    timing, delay_s = resolved.timing, certified_delay_s(resolved)
    if not timing.has_whole_periods:  # whole steps take as many: see netem.core.periods
        return math.floor(late_periods * timing.plant_period.exact) + int(exact_ns(delay_s) if delay_s else 0)
    return late_periods * timing.plant_period_ns + math.ceil(delay_s * NS_PER_S)


def allowed_conditions(resolved: Scenario) -> NetworkConditions:
    """The conditions of a scenario's certificates: its own schedule, with its allowance."""
    return nominal_conditions(resolved, resolved.certificate.late_periods)


@cached_method
def ideal_conditions(resolved: Scenario) -> NetworkConditions:
    """The paper's conditions: a continuous trigger, a network and input without delay.

    The guarantee gives the longest burst of losses, and its rules except the cap M − 1.
    """
    guarantee = resolved.network.guarantee
    assert guarantee.longest_burst is not None  # a scenario has a cap
    further = [rule for rule in guarantee.rules if not isinstance(rule, LongestBurst)]
    return NetworkConditions(dropouts=guarantee.longest_burst, constraints=tuple(further))


def kept_probability(resolved: Scenario, conditions: NetworkConditions, bounds: ProvenBounds) -> float | None:
    """Bound the probability that a run's losses keep a guarantee that nothing enforces.

    Until the first loss too many, events are as far apart as proven, but for runs whose normal values
    exceed their bounds. None: there is no such bound, or none up to the end of the run, or the losses are
    no Markov chain over the packets.
    """
    tests_s = conditions.spacing_s or conditions.apart_s
    packets = bounds.most_events(resolved.timing.horizon_ns / NS_PER_S, conditions.start_s, tests_s)
    if packets is None or jump_s(resolved) is not None:
        return None
    try:
        losses = loss_process(resolved.network.link)
        kept = losses.keeps(conditions.guarantee, packets)
    except NotPredictableError:
        return None
    excluded = 0.0 if normal_limit(resolved) is None else resolved.certificate.exceedance_probability
    return max(kept - excluded, 0.0)


def about_reference(resolved: Scenario) -> Scenario:
    """Return the loop in the coordinates around its reference or set-point, which is 0 there.

    An observer's first estimate is moved, too: its error is the same. What disturbs the loop in these
    coordinates is left out: see :mod:`noack.proof.elaborate.reference`.
    """
    loop = loop_of(resolved)
    if loop.reference is None:
        return resolved
    x_r, observer = loop.reference.state(0), resolved.observer
    if observer is not None and (
        resolved.network.initial_sync == "first_packet" or observer.initial_estimate
    ):
        estimate = (
            np.zeros(loop.n) if observer.initial_estimate is None else np.array(observer.initial_estimate)
        )
        observer = observer.model_copy(update={"initial_estimate": tuple((estimate - x_r).tolist())})
    start = {"initial_state": tuple((loop.x0 - x_r).tolist())}
    return resolved.model_copy(
        update={
            "plant": resolved.plant.model_copy(update=start),
            "observer": observer,
            "controller": resolved.controller.model_copy(update={"setpoint": None, "reference": None}),
        }
    )


def jump_s(resolved: Scenario) -> float | None:
    """Return when the reference first jumps, to which time certificates hold; None: it never does."""
    reference = loop_of(resolved).reference
    if reference is None or reference.is_constant:
        return None
    largest = 0.0
    for place, begin_ns in enumerate(reference.since_ns):
        before, after = reference.segments[place : place + 2]
        left, right = before.at((begin_ns - before.begin_ns) * 1e-9), after.at(0.0)
        largest = max(largest, float(np.abs([left, right]).max()))
        step = float(np.abs(right - left)[: reference.n].max())
        if begin_ns < resolved.timing.horizon_ns and step > _ROUNDED_JUMP * largest:
            return begin_ns / NS_PER_S
    return None


def outside_box(resolved: Scenario) -> str | None:
    """Return, as text, an entry of the plant outside its uncertainty box; None if there is none."""
    loop, plant = loop_of(resolved), resolved.plant
    if plant.uncertainty_A is None and plant.uncertainty_B is None:
        return None
    for name, true, model, rows in (
        ("A", loop.A, loop.A_model, plant.uncertainty_A),
        ("B", loop.B, loop.B_model, plant.uncertainty_B),
    ):
        half = _halfwidth(rows, true)
        slack = 1e-12 * (1.0 + np.abs(model))
        for i, j in np.argwhere(np.abs(true - model) > half + slack):
            distance = abs(true[i, j] - model[i, j])
            return (
                f"the plant lies outside: {name}[{i + 1}, {j + 1}] is {distance:.3g} from the "
                f"model's, the half-width is {half[i, j]:.3g}"
            )
    return None


def _halfwidth(rows: MatrixRows | None, matrix: Matrix) -> Matrix:
    return np.zeros_like(matrix) if rows is None else np.array(rows)
