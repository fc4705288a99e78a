"""The conditions of a scenario's run, its own and the paper's; and a reference moved to 0.

At a set-point x_r the loop is described in the coordinates x − x_r, x_s − x_r and x_c − x_r. The
models rest at x_r with u_r: Âx_r + B̂u_r = 0.
"""

from typing import NamedTuple

import numpy as np

from netem.core.clock import NS_PER_S
from netem.core.settings_section import Table
from netem.guarantee.loss_guarantee import LongestBurst, LossGuarantee, LossRule
from netem.impairments.markov_chain import NotPredictableError
from netem.impairments.target_loss import loss_process
from noack.core.cached_method import cached_method
from noack.core.linear_systems import Matrix
from noack.core.references import Reference
from noack.core.schedule import LoopSchedule
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
_ROUNDED_JUMP = 1e-9
"""A difference between two pieces of a reference is rounding up to this share of the largest x_r or u_r."""


class NetworkConditions(NamedTuple):
    """The assumptions of a certificate about network and schedule, in the plant's time.

    They are not a schedule, but what may happen at most under one with delays and lateness: see
    :func:`nominal_conditions`.
    """

    dropouts: int
    """At most this number of updates is lost in a row: mansd, or less by further constraints."""
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

    The conditions are in the plant's time and hold for all rates (:class:`noack.core.schedule.LoopSchedule`).
    If the network delay has no bound, four times its jitter is used; a run with a longer delay violates the
    conditions. If losses of inputs have no bound, an input may be as old as the run.
    """
    bounds = schedule_of(resolved, late_periods).bounds
    sampling_s, is_even = bounds.sampling_ns / NS_PER_S, resolved.timing.has_whole_periods
    return ideal_conditions(resolved)._replace(
        sampling_s=sampling_s,
        spacing_s=sampling_s if is_even else 0.0,
        apart_s=0.0 if is_even else bounds.least_sampling_ns / NS_PER_S,
        delay_s=bounds.delay_ns / NS_PER_S,
        hold_s=bounds.age_ns / NS_PER_S,
        start_s=bounds.start_ns / NS_PER_S,
    )


def schedule_of(resolved: Scenario, late_periods: int) -> LoopSchedule:
    """Return a scenario's schedule, with lateness up to some steps and the delays that are allowed for.

    If losses of inputs have no bound, they may be held up for the whole run.
    """
    timing = resolved.timing
    gap_ns = timing.horizon_ns if timing.actuation_gap_ns is None else timing.actuation_gap_ns
    return timing.schedule(late_periods, certified_delay_s(resolved), gap_ns)


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
    return schedule_of(resolved, late_periods).in_flight_ns


def allowed_conditions(resolved: Scenario) -> NetworkConditions:
    """The conditions of a scenario's certificates: its own schedule, with its allowance."""
    return nominal_conditions(resolved, resolved.certificate.late_periods)


@cached_method
def ideal_conditions(resolved: Scenario) -> NetworkConditions:
    """The paper's conditions: a continuous trigger, a network and input without delay.

    The guarantee gives the longest burst of losses, and its rules except ``mansd``.
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
