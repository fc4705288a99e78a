"""Whether a link can carry what the guarantee makes it carry; if not, the scenario is refused.

Of any N + 1 successive datagrams of a loop, one must pass (N: the longest burst of losses); a
constraint can require more, at least K − m of any K. What must pass is queued even if the queue is
full. So the queue grows without bound if these datagrams need more than the link's rate, or more
slots than a schedule has, although each loop transmits as rarely as its trigger allows. Only
triggers with a largest time between transmissions have such a load. An actuation is sent at each
tick of the controller. Acknowledgements are left out: how many there are depends on the losses.
"""

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

from netem.core.clock import NS_PER_S
from netem.guarantee.loss_guarantee import WindowBound
from netem.impairments.kinds.opportunities import Opportunities
from netem.impairments.kinds.rate import Rate
from netem.impairments.kinds.schedule import Schedule
from noack.protocol.wire_format import datagram_bytes
from noack.scenario.scenario import Scenario, loop_names, loop_scenario, loop_sections
from noack.scenario.scenario_checks import with_settings
from noack.scenario.sections import DirectionSection
from noack.trigger_policies.trigger_rule import CodedPolicy


class _Sender(NamedTuple):
    """What a loop sends in one direction."""

    payload_bytes: int
    longest_ns: int | None  # Largest time between two transmissions; None: there is none


def refuse_overload(scenario: Scenario) -> None:
    """Raise ValueError if a link must overflow, or has no slot for a loop; the message begins with the key.

    It holds for the settings at the start and after each of the scenario's changes.

    Raises:
        CallerError: a loop's trigger excludes its model.
    """
    if not any(section.link.queues for section in scenario.network.directions.values()):
        return
    sections, names = loop_sections(scenario), loop_names(scenario)
    loops = [loop_scenario(scenario, section) for section in sections]
    for settings in ({}, *(change.set for change in scenario.changes)):
        loops = [with_settings(loop, settings) for loop in loops] if settings else loops
        counted = [*zip(loops, (section.count for section in sections), strict=True)]
        network = loops[0].network
        updates = [_updates(loop) for loop, count in counted for _ in range(count)]
        _refuse("network", network, updates, names)
        if network.actuation is not None:
            actuations = [_actuations(loop) for loop, count in counted for _ in range(count)]
            _refuse("network.actuation", network.actuation, actuations, names)


def _updates(loop: Scenario) -> _Sender:
    rule = loop.trigger.trigger_policy(loop.model.trigger_matrices)
    longest_ns = None
    if not isinstance(rule, CodedPolicy) and rule.longest_ns < loop.timing.horizon_ns:
        longest_ns = int(rule.latest_ns(loop.timing.measurement_period_ns))
    return _Sender(datagram_bytes(loop.states), longest_ns)


def _actuations(loop: Scenario) -> _Sender:
    size_bytes = datagram_bytes(loop.message_sizes.actuation_entries)
    return _Sender(size_bytes, loop.timing.controller_period_ns)


def _refuse(path: str, direction: DirectionSection, senders: Sequence[_Sender], names: Sequence[str]) -> None:
    link = direction.link
    windows = link.guarantee.windows
    window = min(windows, key=lambda window: window.losses / window.packets, default=WindowBound(1, 1))
    passing = window.packets - window.losses
    share = Fraction(passing, window.packets)
    for index, impairment in enumerate(direction.impairments):
        place = f"{path}.impairments.{index}"
        if isinstance(impairment, Rate | Opportunities):
            needed_bps = sum(
                share * int(impairment.line_bits(sender.payload_bytes)) * NS_PER_S / sender.longest_ns
                for sender in senders
                if sender.longest_ns is not None
            )
            if needed_bps > impairment.rate_bps:
                raise ValueError(
                    f"{place}: the datagrams that must pass, {passing} of any {window.packets} of each loop, "
                    f"need {math.ceil(needed_bps)} bit/s, and it carries {impairment.rate_bps:.0f}; the "
                    "queue would grow without bound"
                )
        elif isinstance(impairment, Schedule):
            round_ns = len(impairment.order) * impairment.slot_ns
            for number, sender in enumerate(senders):
                slots = impairment.order.count(number)
                if slots == 0:
                    raise ValueError(
                        f"{place}.order: loop {number} has no slot; the run has the loops 0 to "
                        f"{len(senders) - 1}, and each needs a slot (-1: an idle slot)"
                    )
                if sender.longest_ns is None:
                    continue
                needed = share * round_ns / sender.longest_ns
                if needed > slots:
                    raise ValueError(
                        f"{place}: the datagrams that must pass, {passing} of any {window.packets} of loop "
                        f"{number} ({names[number]}), need {float(needed):.4g} slots in a round, and it has "
                        f"{slots}; the queue would grow without bound"
                    )
