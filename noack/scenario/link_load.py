"""The load of a bottleneck that the loops of a run share, and their delays on it, before the run.

Of any M successive datagrams of a loop, one must pass (M − 1 = the longest burst of losses); a
constraint can require more, at least K − m of any K. The share s that must pass is the largest of
these, 1/M or 1 − m/K. Let b be the bits of loop k's datagram on the link, d the least and D the
largest time between two of its transmissions. The datagrams that must pass need between Σ s b/D and
Σ s b/d bits per second. For actuations d and D are the controller's period.

From d, M, the queue and what is before it follow bounds of the delay in a tail-drop queue and in
the slots of a static schedule (docs/derivations.md, "The delay on a link"). J is by how much the
delays before it can differ, and W(n) the longest time until n of a loop's slots have begun.

A rate that chooses what it sends has a bound for each loop: noack/scenario/response_times.py.

The delay in the network is at most the sum L of the bounds of its impairments. A datagram that is
held back for the guarantee leaves with an earlier one of its loop, which leaves within L of its own
transmission: so L bounds this delay, too. A live run adds the lateness of its processes.
"""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import cycle
from typing import NamedTuple

from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.core.number_format import at_least, at_most
from noack.guarantee.loss_guarantee import WindowBound
from noack.impairments.constraints import join_guarantee
from noack.impairments.disciplines.tail_drop import TailDrop
from noack.impairments.feature import Impairment, Scheduler
from noack.impairments.kinds.opportunities import Opportunities
from noack.impairments.kinds.rate import Rate
from noack.impairments.kinds.schedule import Schedule
from noack.protocol.wire_format import Flow, datagram_bytes
from noack.scenario.response_times import Sender, response_ns
from noack.scenario.run_sections import ProvenDelay
from noack.scenario.scenario import Scenario, loop_names, loop_scenario, loop_sections
from noack.scenario.scenario_checks import with_settings
from noack.scenario.sections import DirectionSection
from noack.trigger_policies.trigger_rule import CodedPolicy


class Demand(NamedTuple):
    """The transmissions of some loops of a kind."""

    loops: int
    payload_bytes: int
    least_s: float  # Least time between two transmissions of a loop
    largest_s: float  # Largest time between two transmissions; infinite if there is none


class _RunPart(NamedTuple):
    """A part of the run, between two changes of settings."""

    change: int | None  # The change of settings with which it begins; None: the start of the run
    direction: DirectionSection
    loops: Sequence[Demand]


class NumberedLoop(NamedTuple):
    """A loop of the run."""

    number: int
    name: str


class LoopsBound(NamedTuple):
    """A bound of the delay of some loops; infinite: there is none."""

    loops: str
    bound_s: float


class LinkLoad(NamedTuple):
    """The load of a bottleneck; rates in bits per second."""

    change: int | None
    """The change of settings from which on this holds; None: from the start of the run on."""
    loop: NumberedLoop | None
    """The loop whose slots these are; None: what all loops share."""
    key: str
    flow: Flow
    window: WindowBound
    """The successive datagrams of a loop, and those of them that may be lost; the others must pass."""
    rate_bps: float
    """The rate that it carries; a link with recorded opportunities: on average."""
    mandatory_at_most_bps: float
    """The rate of the datagrams that must pass, if each loop transmits as often as it can."""
    mandatory_at_least_bps: float
    """The same, if each loop transmits as rarely as it can."""
    delay_bound_s: float | None
    """Bound of a datagram's delay in this queue, in the whole run; None: there is none."""
    loop_bounds: tuple[LoopsBound, ...] = ()
    """The bounds of the loops, if they have one each."""

    @property
    def scope(self) -> str:
        """From when on this holds, and for which loop, as the beginning of a sentence."""
        change = "" if self.change is None else f"from changes.{self.change} on, "
        return change if self.loop is None else f"{change}loop {self.loop.number} ({self.loop.name}), "


class DelayBound(NamedTuple):
    """Bounds of the delay of updates in the network, in the whole run and in virtual time."""

    impairments_s: dict[str, float]
    """The largest delay in each impairment that delays, by its key; infinite: no bound is known."""
    loops_s: list[float]
    """The largest delay of each loop's updates in all of them."""
    loops_certified_s: tuple[float, ...]
    """The delay that the certificates of each loop cover."""

    @property
    def largest_s(self) -> float:
        """The largest delay of an update."""
        return max(self.loops_s)

    @property
    def certified_s(self) -> float:
        """The largest delay that a loop's certificates cover."""
        return max(self.loops_certified_s)

    @property
    def is_certified(self) -> bool:
        """Whether the certificates cover every delay; times are whole nanoseconds."""
        pairs = zip(self.loops_certified_s, self.loops_s, strict=True)
        return all(round(bound_s * NS_PER_S) >= largest_s * NS_PER_S - 0.5 for bound_s, largest_s in pairs)


def link_loads(scenario: Scenario) -> list[LinkLoad]:
    """Return the load of each bottleneck of the network, in either direction.

    A change of settings that alters it adds an element. Acknowledgements are left out: how many
    there are depends on the losses of updates.

    Raises:
        CallerError: a loop cannot be resolved, or its trigger excludes its model.
    """
    updates, actuations = _run_parts(scenario)
    names = loop_names(scenario)
    update_loads = _link_loads(updates, Flow.UPDATE, "network", names)
    return update_loads + _link_loads(actuations, Flow.ACTUATION, "network.actuation", names)


def update_delay(scenario: Scenario) -> DelayBound:
    """Return bounds of the delay of updates, and the delays that the certificates cover.

    Raises:
        CallerError: as :func:`link_loads`.
    """
    delays, loops_s = _largest_delays(_run_parts(scenario)[0])
    bounds_s = {f"network.impairments.{index}": max(delays_s) for index, delays_s in enumerate(delays)}
    impairments_s = {key: bound_s for key, bound_s in bounds_s.items() if bound_s > 0}
    longest_s = scenario.network.link.longest_delay_s
    certified = tuple(delay_s if math.isfinite(delay_s) else longest_s for delay_s in loops_s)
    if (given_s := scenario.certificate.network_delay_s) is not None:
        certified = (given_s,) * len(loops_s)
    return DelayBound(impairments_s, loops_s, certified)


def proven_delays(scenario: Scenario) -> list[ProvenDelay | None]:
    """Return the bound of the delay of each loop's updates that its certificates can use.

    There is none where a delay is given, or where the impairments alone have a bound.

    Raises:
        CallerError: as :func:`link_loads`.
    """
    count = sum(section.count for section in loop_sections(scenario))
    if scenario.certificate.network_delay_s is not None or scenario.network.link.delay_is_bounded:
        return [None] * count
    _, loops_s = _largest_delays(_run_parts(scenario)[0])
    return [ProvenDelay(delay_s, count) for delay_s in loops_s]


def _run_parts(scenario: Scenario) -> tuple[list[_RunPart], list[_RunPart]]:
    """Return the parts of the run between changes of settings: updates, actuations."""
    sections = loop_sections(scenario)
    loops = [loop_scenario(scenario, section) for section in sections]
    counts = [section.count for section in sections]
    updates, actuations = list[_RunPart](), list[_RunPart]()
    for change in (None, *range(len(scenario.changes))):
        if change is not None:
            loops = [with_settings(loop, scenario.changes[change].set) for loop in loops]
        network = loops[0].network
        updates.append(_RunPart(change, network, [*map(_demand, loops, counts)]))
        if network.actuation is not None:
            demands = [*map(_actuations, loops, counts)]
            actuations.append(_RunPart(change, network.actuation, demands))
    return updates, actuations


def _link_loads(run_parts: Sequence[_RunPart], flow: Flow, path: str, names: Sequence[str]) -> list[LinkLoad]:
    loads: list[LinkLoad] = []
    if not run_parts:
        return loads
    delays, _ = _largest_delays(run_parts)
    for index, impairment in enumerate(run_parts[0].direction.impairments):
        key = f"{path}.impairments.{index}"
        if isinstance(impairment, Schedule):
            bounds = [LoopsBound(*bound) for bound in zip(names, delays[index], strict=True)]
            loads += _slot_loads(impairment, run_parts, key, flow, bounds)
        elif isinstance(impairment, Rate | Opportunities):
            loop_bounds = tuple(_group_bounds(names, delays[index])) if len(delays[index]) > 1 else ()
            delay_s = _largest_bound(delays[index])
            loads += _rate_loads(impairment, run_parts, key, flow, delay_s, loop_bounds)
    return loads


def _rate_loads(
    impairment: Rate | Opportunities,
    run_parts: Sequence[_RunPart],
    key: str,
    flow: Flow,
    delay_s: float | None,
    loop_bounds: tuple[LoopsBound, ...],
) -> Iterator[LinkLoad]:
    """Yield the load of a rate in each part of the run in which it differs from that before."""
    previous: LinkLoad | None = None
    for change, direction, loops in run_parts:
        window = _window(direction)
        bits = [int(impairment.line_bits(loop.payload_bytes)) * loop.loops for loop in loops]
        at_most_bps = sum(b / loop.least_s for b, loop in zip(bits, loops, strict=True))
        at_least_bps = sum(b / loop.largest_s for b, loop in zip(bits, loops, strict=True))
        load = LinkLoad(
            change=change,
            loop=None,
            key=key,
            flow=flow,
            window=window,
            rate_bps=impairment.rate_bps,
            mandatory_at_most_bps=_share(window) * at_most_bps,
            mandatory_at_least_bps=_share(window) * at_least_bps,
            delay_bound_s=delay_s,
            loop_bounds=loop_bounds,
        )
        if previous is None or load._replace(change=previous.change) != previous:
            yield load
        previous = load


def _group_bounds(names: Sequence[str], delays_s: Sequence[float]) -> Iterator[LoopsBound]:
    """Yield each bound of a delay, with the loops that have it, such as ``p-1, p-3 to p-5``."""
    for delay_s in dict.fromkeys(delays_s):
        loops = {loop for loop, loop_delay_s in enumerate(delays_s) if loop_delay_s == delay_s}
        begins = sorted(loops - {loop + 1 for loop in loops})
        ends = sorted(loops - {loop - 1 for loop in loops})
        pairs = zip(begins, ends, strict=True)
        spans = (names[a] if a == b else f"{names[a]} to {names[b]}" for a, b in pairs)
        yield LoopsBound(", ".join(spans), delay_s)


def _largest_bound(delays_s: Sequence[float]) -> float | None:
    """Return the largest of the bounds of a delay; None: one is not known."""
    return max(delays_s) if math.isfinite(max(delays_s)) else None


def _slot_loads(
    schedule: Schedule,
    run_parts: Sequence[_RunPart],
    key: str,
    flow: Flow,
    bounds: Sequence[LoopsBound],
) -> Iterator[LinkLoad]:
    """Yield for each entry of [[loops]] the load of the slots of its loop with the fewest of them.

    ``bounds`` has that of each loop of the run.
    """
    first, slots = 0, _slots(schedule, run_parts)
    round_s = len(schedule.order) * schedule.slot_ns / NS_PER_S
    for entry, loops in enumerate(run_parts[0].loops):
        number = min(range(first, first + loops.loops), key=lambda loop: len(slots[loop]))
        first += loops.loops
        name, delay_s = bounds[number]
        for change, direction, demands in run_parts:
            loop, window = demands[entry], _window(direction)
            bits = 8 * loop.payload_bytes
            must_pass = bits * _share(window)
            yield LinkLoad(
                change=change,
                loop=NumberedLoop(number, name),
                key=key,
                flow=flow,
                window=window,
                rate_bps=bits * len(slots[number]) / round_s,
                mandatory_at_most_bps=must_pass / loop.least_s,
                mandatory_at_least_bps=must_pass / loop.largest_s,
                delay_bound_s=_largest_bound([delay_s]),
            )


def _slots(schedule: Schedule, run_parts: Sequence[_RunPart]) -> list[list[int]]:
    """Return the slots of each loop of the run."""
    loops = sum(demand.loops for demand in run_parts[0].loops)
    return [*schedule.slots, *([] for _ in range(loops))][:loops]


def _least_times_s(run_parts: Sequence[_RunPart]) -> list[float]:
    """Return the shortest time between two transmissions of a loop in the run, by its demand."""
    by_demand = zip(*(part.loops for part in run_parts), strict=True)
    return [min(demand.least_s for demand in demands) for demands in by_demand]


def _window(direction: DirectionSection) -> WindowBound:
    link = direction.link
    windows = join_guarantee(link.mansd, link.constraints).windows
    return min(windows, key=lambda window: window.losses / window.packets, default=WindowBound(1, 1))


def _share(window: WindowBound) -> float:
    return (window.packets - window.losses) / window.packets


def _largest_delays(run_parts: Sequence[_RunPart]) -> tuple[list[list[float]], list[float]]:
    """Return the bounds of the delay in each impairment, and of each loop in all, in seconds.

    A schedule, and a rate that chooses what it sends, have a bound for each loop; another
    impairment has one for all; infinite: there is none.
    """
    least_s, largest_s = 0.0, [0.0] * sum(demand.loops for demand in run_parts[0].loops)
    delays_s, copied = list[list[float]](), False
    for impairment in run_parts[0].direction.impairments:  # they cannot change
        spread_s = max(largest_s) - least_s
        delays_s.append(_delays_in(impairment, run_parts, spread_s, copied=copied))
        if isinstance(impairment, Schedule | Rate):
            # One bound may be that of all loops.
            largest_s = [
                before_s + added_s for before_s, added_s in zip(largest_s, cycle(delays_s[-1]), strict=False)
            ]
        else:
            ranges_s = {before_s: impairment.delay_range_s(least_s, before_s) for before_s in set(largest_s)}
            largest_s = [ranges_s[before_s][1] for before_s in largest_s]
            least_s = min(ranges_s.values())[0]
        copied = copied or impairment.copies
    return delays_s, largest_s


def _delays_in(
    impairment: Impairment, run_parts: Sequence[_RunPart], spread_s: float, *, copied: bool
) -> list[float]:
    """Return the bounds of the delay in an impairment, of each loop or one for all."""
    if isinstance(impairment, Schedule):
        return _slot_delays_s(impairment, run_parts, spread_s, copied=copied)
    if not isinstance(impairment, Rate):
        return [impairment.longest_s if impairment.is_bounded else math.inf]
    if impairment.scheduler is not None:
        return _chosen_delays_s(impairment, impairment.scheduler, run_parts)
    return [_queue_delay_s(impairment, run_parts, spread_s, copied=copied)]


def _slot_delays_s(
    schedule: Schedule, run_parts: Sequence[_RunPart], spread_s: float, *, copied: bool
) -> list[float]:
    """Return the bounds for the slots of each loop; see :func:`_queue_delay_s`."""
    least_ns = [
        round(least_s * NS_PER_S)
        for least_s, demand in zip(_least_times_s(run_parts), run_parts[0].loops, strict=True)
        for _ in range(demand.loops)
    ]
    share = max(_share(_window(part.direction)) for part in run_parts)
    if any(part.direction.constraints for part in run_parts):
        share = math.inf
    copies = 2 if copied else 1
    return [
        _slot_delay_ns(schedule, slots, loop_least_ns, share, copies) / NS_PER_S + spread_s
        for slots, loop_least_ns in zip(_slots(schedule, run_parts), least_ns, strict=True)
    ]


def _slot_delay_ns(
    schedule: Schedule, slots: Sequence[int], least_ns: int, share: float, copies: int
) -> float:
    """Return the smaller of both bounds for the slots of a loop, without J; infinite: there is none.

    Args:
        schedule: the schedule.
        slots: the numbers of the loop's slots.
        least_ns: d, the shortest time between two transmissions.
        share: s, the share of the datagrams that must pass; infinite: that is not known.
        copies: how many times each datagram may arrive.
    """
    round_ns, count = len(schedule.order) * schedule.slot_ns, len(slots)
    bounds_ns = [math.inf]
    # W(n) − (n − 1) d, if every datagram passes.
    if copies * round_ns <= count * least_ns:
        waits_ns = (schedule.wait_ns(slots, n + 1) for n in range(copies * count))
        bounds_ns.append(max(t_ns - n // copies * least_ns for n, t_ns in enumerate(waits_ns)))
    # W(Q + n) − (n − 1) d/s, if the others find the queue full; W(Q) if nothing must pass.
    if slots and share == 0:
        bounds_ns.append(schedule.wait_ns(slots, schedule.queue))
    elif slots and round_ns * share <= count * least_ns:
        waits_ns = (schedule.wait_ns(slots, schedule.queue + n + 1) for n in range(count))
        bounds_ns.append(max(t_ns - n * least_ns / share for n, t_ns in enumerate(waits_ns)))
    return min(bounds_ns)


def _chosen_delays_s(rate: Rate, scheduler: Scheduler, run_parts: Sequence[_RunPart]) -> list[float]:
    """Return the bounds for each loop of a rate that chooses what it sends.

    A change of the direction's settings makes the order of what waits final, so that any may go first.
    """
    demands = run_parts[0].loops
    changes = any(part.direction.link != run_parts[0].direction.link for part in run_parts)
    # d and c of the loops of each demand.
    senders_ns = [
        (
            round(least_s * NS_PER_S),
            max(-(-int(rate.line_bits(demand.payload_bytes)) * NS_PER_S // rate.rate_bps), 1),
        )
        for least_s, demand in zip(_least_times_s(run_parts), demands, strict=True)
    ]
    entries = (entry for entry, demand in enumerate(demands) for _ in range(demand.loops))
    kinds = [(entry, scheduler.number(loop)) for loop, entry in enumerate(entries)]
    counts = Counter(kinds)
    # The bound of each kind: the other loops by their d and c, and by when they yield.
    bounds_s = {}
    for kind in counts:
        entry, number = kind
        sender_counts = Counter[tuple[int, int, float]]()
        for (other_entry, other_number), count in (counts - Counter([kind])).items():
            yields_ns = math.inf if changes else scheduler.yields_ns(number, other_number)
            sender_counts[*senders_ns[other_entry], yields_ns] += count
        other_senders = {Sender(*sender_ns): count for sender_ns, count in sender_counts.items()}
        bounds_s[kind] = response_ns(Sender(*senders_ns[entry]), other_senders) / NS_PER_S
    return [bounds_s[kind] for kind in kinds]


def _queue_delay_s(rate: Rate, run_parts: Sequence[_RunPart], spread_s: float, *, copied: bool) -> float:
    """Return the bound for the least M and the shortest times between transmissions of the run.

    What waits in the queue at a change was sent before it, so no part has a bound of its own.

    Args:
        rate: the bottleneck.
        run_parts: the parts of the run.
        spread_s: by how much the delays before the queue can differ.
        copied: datagrams may have been sent twice before the queue.
    """
    if not isinstance(rate.discipline, TailDrop) or math.isinf(spread_s):
        return math.inf
    bits = [int(rate.line_bits(loop.payload_bytes)) for loop in run_parts[0].loops]
    counts = [loop.loops for loop in run_parts[0].loops]
    least_s = _least_times_s(run_parts)
    every_bps: float = sum(
        bit_count * count / least for bit_count, count, least in zip(bits, counts, least_s, strict=True)
    )
    together = sum(bit_count * count for bit_count, count in zip(bits, counts, strict=True))
    copies = 2 if copied else 1
    if copies * every_bps <= rate.rate_bps:
        return copies * (together + every_bps * spread_s) / rate.rate_bps
    needed_bps = every_bps * max(_share(_window(part.direction)) for part in run_parts)
    if needed_bps < rate.rate_bps and not any(part.direction.constraints for part in run_parts):
        waiting = rate.queue * max(bits) + together + needed_bps * spread_s
        return waiting / (rate.rate_bps - needed_bps)
    return math.inf


def require_slots(scenario: Scenario) -> None:
    """Raise CallerError if a schedule has no slot for a loop, or one for another loop."""
    loops = sum(section.count for section in loop_sections(scenario))
    for path, section in scenario.network.directions.items():
        for index, impairment in enumerate(section.impairments):
            flows = len(impairment.slots) if isinstance(impairment, Schedule) else loops
            if flows != loops:
                wrong = f"loop {flows} has no slot" if flows < loops else f"a slot is for loop {flows - 1}"
                raise CallerError(
                    f"{path}.impairments.{index}.order: {wrong}; the run has the loops "
                    f"0 to {loops - 1}, and each needs a slot (-1: an idle slot)"
                )


def require_capacity(scenario: Scenario) -> None:
    """Raise CallerError if a bottleneck cannot carry the datagrams of the loops that must pass.

    It is raised, too, if a schedule does not fit the loops.
    """
    require_slots(scenario)
    for load in link_loads(scenario):
        if load.mandatory_at_least_bps > load.rate_bps:
            losses, packets = load.window
            raise CallerError(
                f"{load.key}: {load.scope}the datagrams that must pass, {packets - losses} of any "
                f"{packets} of each loop, need {math.ceil(load.mandatory_at_least_bps)} bit/s, "
                f"and it carries {load.rate_bps:.0f}; the queue would grow without bound"
            )


def load_warnings(loads: Sequence[LinkLoad], scenario: Scenario) -> Iterator[str]:
    """Yield warnings about the bottlenecks, one line each."""
    overloaded = [load for load in loads if load.mandatory_at_most_bps > load.rate_bps]
    for load in overloaded:
        yield (
            f"{load.key}, {load.rate_bps:.0f} bit/s: {load.scope}if all loops transmit as "
            "often as they can, the datagrams that must pass need "
            f"{math.ceil(load.mandatory_at_most_bps)} bit/s; then the queue grows without bound"
        )
    delay = update_delay(scenario)
    unknown = [key for key, impairment_s in delay.impairments_s.items() if math.isinf(impairment_s)]
    source = "that of full queues" if scenario.certificate.network_delay_s is None else "as given"
    covered = f"the certificates cover {at_least(delay.certified_s, 3)} s, {source}"
    covered += "; certificate.network_delay_s changes it"
    if not unknown and not delay.is_certified:
        parts = ", ".join(f"{key} {impairment_s:.3g} s" for key, impairment_s in delay.impairments_s.items())
        yield f"updates may be delayed by up to {at_most(delay.largest_s, 3)} s ({parts}), {covered}"
    elif set(unknown) - {load.key for load in overloaded}:
        yield f"no bound of the delay of updates is known ({', '.join(unknown)}), {covered}"


def _demand(loop: Scenario, count: int) -> Demand:
    least_ns, largest_ns = _inter_event_times_ns(loop)
    size_bytes = datagram_bytes(loop.model.dimensions[0])
    return Demand(count, size_bytes, least_ns / NS_PER_S, largest_ns / NS_PER_S)


def _inter_event_times_ns(loop: Scenario) -> tuple[float, float]:
    """Return the least and the largest time between two events that the trigger permits."""
    rule = loop.trigger.trigger_policy(loop.model.trigger_matrices)
    measured_ns = loop.timing.measurement_period_ns
    if isinstance(rule, CodedPolicy):  # it may transmit at every measurement, or never
        return measured_ns, math.inf
    is_due = rule.longest_ns < loop.timing.horizon_ns
    return max(measured_ns, rule.earliest_ns), rule.latest_ns(measured_ns) if is_due else math.inf


def _actuations(loop: Scenario, count: int) -> Demand:
    """The controller sends one at each of its ticks."""
    size_bytes = datagram_bytes(loop.message_sizes.actuation_entries)
    period_s = loop.timing.controller_period_ns / NS_PER_S
    return Demand(count, size_bytes, period_s, period_s)
