"""One direction of a link: decisions for arriving packets, and accounting of departures."""

from netem.rules.guarantee import hold_back_until, make_stale, must_pass, note_outcome
from noack.impairments.link_records import (
    CORRUPTED,
    DELIVERED,
    DROPPED,
    FORCED,
    NEVER_NS,
    OVERFLOWED,
    Counters,
    LinkMemory,
    LinkProgram,
    PacketContext,
    PacketDecision,
    RecordedDecision,
    refuse,
)
from noack.impairments.stage_dispatch import apply_stage


def admit(
    program: LinkProgram,
    state: LinkMemory,
    row: int,
    size_bytes: int,
    now_ns: int,
    decision: PacketDecision,
) -> None:
    """Fill in the decision for a packet that arrives at ``now_ns``; ``row`` is that of its flow.

    Every stage is applied to every packet of a flow, so that a stage's random draws do not depend
    on other stages. A packet that must pass is exempt from everything that would lose it.
    """
    flow, memories, counters = state.flows[row], state.memory[row], state.counters
    decision.packet = flow.packets
    decision.fate = DELIVERED
    decision.release_ns = now_ns
    decision.copy_ns = NEVER_NS
    decision.bit = -1
    decision.copy_bit = -1
    decision.arrival_ns = now_ns
    decision.size_bytes = size_bytes
    decision.must_pass = must_pass(program, flow, state.losses[row])
    decision.spared = 0
    flow.packets += 1
    counters.received += 1
    counters.received_bytes += size_bytes
    if flow.number + 1 < len(program.decisions_begin):
        place = program.decisions_begin[flow.number] + decision.packet
        if place < program.decisions_begin[flow.number + 1]:
            repeat(program.decisions[place], decision)
            settle(program, state, row, decision)
            return
    packet = PacketContext(program, state, flow, decision)
    for number in range(len(program.stages)):
        apply_stage(packet, program.stages[number], memories[number])
    keep_limit(program.limit - state.link.in_flight, decision)
    settle(program, state, row, decision)


def keep_limit(free: int, decision: PacketDecision) -> None:
    """Drop a delayed packet or its copy if it needs more than the ``free`` places in flight."""
    now_ns = decision.arrival_ns
    if decision.release_ns > now_ns and free <= 0:
        refuse(decision, OVERFLOWED)
    if decision.fate != DELIVERED:
        decision.release_ns, decision.copy_ns = NEVER_NS, NEVER_NS
        decision.bit, decision.copy_bit = -1, -1
    elif decision.copy_ns != NEVER_NS and decision.copy_ns < decision.release_ns:
        decision.release_ns, decision.copy_ns = decision.copy_ns, decision.release_ns
        decision.bit, decision.copy_bit = decision.copy_bit, decision.bit
    if decision.copy_ns > now_ns and free < (2 if decision.release_ns > now_ns else 1):
        decision.copy_ns, decision.copy_bit = NEVER_NS, -1


def repeat(recorded: RecordedDecision, decision: PacketDecision) -> None:
    """Repeat a recorded decision; the guarantee holds nevertheless.

    If packets arrive at other times than in the record, other packets may have to pass or to be
    held back: a packet that must pass is delivered here, and :func:`settle` holds packets back.
    A packet shorter than the recorded one is corrupted in another bit, an empty one in none.
    """
    fate, now_ns, size_bytes = recorded.fate, decision.arrival_ns, decision.size_bytes
    decision.bit = within(recorded.bit, size_bytes)
    decision.copy_bit = within(recorded.copy_bit, size_bytes)
    decision.release_ns = NEVER_NS
    decision.spared = fate == FORCED
    intact = decision.bit < 0 or (recorded.copy_delay_ns >= 0 and decision.copy_bit < 0)
    if decision.must_pass != 0 and not (fate in (DELIVERED, FORCED) and intact):
        fate, decision.spared, decision.bit, decision.copy_bit = FORCED, 1, -1, -1
    decision.fate = fate
    if fate in (DELIVERED, FORCED, CORRUPTED):
        decision.fate = DELIVERED
        decision.release_ns = now_ns + max(recorded.delay_ns, 0)
        if recorded.copy_delay_ns >= 0:
            decision.copy_ns = max(now_ns + recorded.copy_delay_ns, decision.release_ns)


def within(bit: int, size_bytes: int) -> int:
    """Map a bit number to one within a payload of ``size_bytes``; −1 (no bit) stays −1."""
    if bit < 0 or size_bytes == 0:
        return -1
    return bit % (size_bytes * 8)


def settle(program: LinkProgram, state: LinkMemory, row: int, decision: PacketDecision) -> None:
    """Enforce the guarantee for a packet with known times, count it, complete the decision."""
    flow, counters = state.flows[row], state.counters
    recent_ns, losses_before = state.recent_ns[row], state.losses[row]
    packet, now_ns = decision.packet, decision.arrival_ns
    effective_ns = NEVER_NS
    decision.hold_back_ns, decision.makes_stale = 0, 0
    if decision.fate == DELIVERED:
        if decision.bit < 0:
            effective_ns = decision.release_ns
        elif decision.copy_ns != NEVER_NS and decision.copy_bit < 0:
            effective_ns = decision.copy_ns
        else:
            decision.fate = CORRUPTED
    if effective_ns != NEVER_NS:
        if program.tracks:
            needed_ns = hold_back_until(
                program, flow, recent_ns, losses_before, packet, effective_ns
            )
            if needed_ns > effective_ns:
                decision.hold_back_ns = needed_ns - effective_ns
                if decision.bit < 0:
                    decision.release_ns = needed_ns
                if decision.copy_ns != NEVER_NS:
                    decision.copy_ns = max(decision.copy_ns, needed_ns)
                effective_ns = needed_ns
                counters.held_back += 1
            decision.makes_stale = make_stale(
                program, recent_ns, losses_before, packet, effective_ns
            )
        if decision.spared != 0:
            decision.fate = FORCED
        if flow.forced_first != 0:
            flow.forced_first = 0
            flow.first_release_ns = effective_ns
        flow.consecutive_losses = 0
    else:
        flow.consecutive_losses += 1
        losses = min(flow.consecutive_losses, packet + 1 - flow.since)
        flow.longest_loss_burst = max(flow.longest_loss_burst, losses)
        counters.longest_loss_burst = max(counters.longest_loss_burst, losses)
    if program.tracks and program.mansd >= 0:
        recent_ns[packet & (len(recent_ns) - 1)] = effective_ns
    note_outcome(program, losses_before, packet, effective_ns == NEVER_NS)
    decision.consecutive_losses = flow.consecutive_losses
    count(counters, decision.fate)
    if decision.copy_ns != NEVER_NS:
        counters.duplicated += 1
    if decision.release_ns > now_ns:
        state.link.in_flight += 1
    if decision.copy_ns > now_ns:
        state.link.in_flight += 1
    counters.most_in_flight = max(counters.most_in_flight, state.link.in_flight)


def count(counters: Counters, fate: int) -> None:
    """Count a fate."""
    if fate == DELIVERED:
        counters.delivered += 1
    elif fate == DROPPED:
        counters.dropped += 1
    elif fate == FORCED:
        counters.forced += 1
    elif fate == CORRUPTED:
        counters.corrupted += 1
    elif fate == OVERFLOWED:
        counters.overflowed += 1
    else:
        counters.blacked_out += 1


def leave(
    state: LinkMemory, row: int, packet: int, size_bytes: int, delayed: bool, counts: bool
) -> bool:
    """Note that a packet, or a copy, actually leaves; return whether it is stale.

    ``delayed``: it was in flight. ``counts``: it is the packet's first intact copy.
    """
    flow, counters = state.flows[row], state.counters
    counters.forwarded += 1
    counters.forwarded_bytes += size_bytes
    if delayed:
        state.link.in_flight -= 1
    stale = packet < flow.newest
    if counts:
        if stale:
            counters.delivered_out_of_order += 1
        else:
            losses = packet - max(flow.newest, flow.since - 1) - 1
            flow.newest = packet
            flow.longest_loss_burst = max(flow.longest_loss_burst, losses)
            counters.longest_loss_burst = max(counters.longest_loss_burst, losses)
    return stale
