"""One direction of a link: what becomes of a datagram, and what has left."""

from collections.abc import MutableSequence, Sequence
from typing import NamedTuple

from netem.rule_records import (
    BlackoutSettings,
    ChanceSettings,
    Counters,
    DelaySettings,
    FlowState,
    FourStateSettings,
    GilbertElliottSettings,
    LinkState,
    PacketDecision,
    QueueState,
    RateSettings,
    RecordedDecision,
    RuleStage,
    ScriptSettings,
    StageMemory,
)
from netem.rules import bernoulli, four_state, gilbert_elliott, scripted_losses
from netem.rules.blackout import dark
from netem.rules.correlated_chance import happens
from netem.rules.delay import delay_ns
from netem.rules.mansd import NEVER_NS, must_pass, needed_until_ns, overtake
from netem.rules.philox import uniforms
from netem.rules.rate import enters, serve

BERNOULLI = 1
GILBERT_ELLIOTT = 2
FOUR_STATE = 3
SCRIPTED = 4
WORST_CASE = 5
LAST_LOSS = 9
"""Kinds of stages up to here are losses."""
DUPLICATE = 10
CORRUPT = 11
DELAY = 12
REORDER = 13
RATE = 14
BLACKOUT = 15

DELIVERED = 0
DROPPED = 1
FORCED = 2
CORRUPTED = 3
OVERFLOWED = 4
BLACKED_OUT = 5
"""The values of :class:`noack.protocol.record_tables.Fate`."""


class LinkProgram(NamedTuple):
    """The settings of a link, as its rules read them: k stages, and a table for each kind."""

    stages: Sequence[RuleStage]
    """(k,) In the order in which they apply."""
    chances: Sequence[ChanceSettings]
    chains: Sequence[GilbertElliottSettings]
    four_states: Sequence[FourStateSettings]
    scripts: Sequence[ScriptSettings]
    waits: Sequence[DelaySettings]
    bottlenecks: Sequence[RateSettings]
    darknesses: Sequence[BlackoutSettings]
    integers: Sequence[int]
    """Tables of scripts and blackouts."""
    reals: Sequence[float]
    """Tables of empirical delays, in ns."""
    decisions: Sequence[RecordedDecision]
    """Recorded decisions that are taken again, flow by flow."""
    decisions_begin: Sequence[int]
    """(flows + 1,) Where those of each recorded flow begin, and the last ends; or empty."""
    mansd: int
    """M − 1; −1 for no cap."""
    limit: int
    """At most so many datagrams are delayed at once."""
    scored: bool
    """Whether a delay asks how bad the times are."""
    tracks: bool
    """Whether something can be overtaken."""


class LinkMemory(NamedTuple):
    """What a link remembers."""

    flows: Sequence[FlowState]
    """(rows,) A row may be used again for another flow when a flow has ended."""
    memory: Sequence[Sequence[StageMemory]]
    """(rows, k)"""
    recent_ns: Sequence[MutableSequence[int]]
    """(rows, mansd + 1) Release times; see :mod:`netem.rules.mansd`."""
    queues: Sequence[QueueState]
    """One for each bottleneck."""
    departures_ns: MutableSequence[int]
    """The bottlenecks' rings."""
    link: LinkState
    counters: Counters


def loses(
    program: LinkProgram,
    stage: RuleStage,
    memory: StageMemory,
    flow: FlowState,
    packet: int,
) -> bool:
    """Whether a loss stage would lose the datagram."""
    if stage.kind == WORST_CASE:
        return True
    if stage.kind == SCRIPTED:
        return scripted_losses.lost(program.scripts[stage.place], program.integers, packet)
    u, v = uniforms(stage.key0, stage.key1, flow.number, packet, 0)
    if stage.kind == BERNOULLI:
        return bernoulli.lost(program.chances[stage.place], memory, flow, u, program.scored)
    if stage.kind == GILBERT_ELLIOTT:
        w = 0.0
        if program.scored:
            w, _ = uniforms(stage.key0, stage.key1, flow.number, packet, 1)
        chain = program.chains[stage.place]
        return gilbert_elliott.lost(chain, memory, flow, u, v, w, program.scored)
    return four_state.lost(program.four_states[stage.place], memory, u)


def admit(
    program: LinkProgram,
    state: LinkMemory,
    row: int,
    size_bytes: int,
    now_ns: int,
    verdict: PacketDecision,
) -> None:
    """Decide what becomes of a datagram that comes in at ``now_ns``.

    Every stage sees every datagram of a flow, so that what one of them does depends on no other. A
    datagram that must pass is exempt from what would undo its delivery.

    Args:
        program: the link's settings.
        state: what it remembers.
        row: of the datagram's flow.
        size_bytes: of the payload.
        now_ns: when it came.
        verdict: receives the decision.
    """
    flow, memories, counters = state.flows[row], state.memory[row], state.counters
    packet = flow.packets
    flow.packets += 1
    counters.arrived += 1
    counters.arrived_bytes += size_bytes
    if flow.number + 1 < len(program.decisions_begin):
        place = program.decisions_begin[flow.number] + packet
        if place < program.decisions_begin[flow.number + 1]:
            repeat(program, state, row, packet, size_bytes, program.decisions[place], now_ns,
                   verdict)  # fmt: skip
            return
    must = must_pass(flow, program.mansd)
    spared = False
    fate = DELIVERED
    release_ns, copy_ns, bit, copy_bit = now_ns, NEVER_NS, -1, -1
    for number in range(len(program.stages)):
        stage, memory = program.stages[number], memories[number]
        kind = stage.kind
        refusal = DELIVERED
        if kind <= LAST_LOSS:
            if loses(program, stage, memory, flow, packet):
                refusal = DROPPED
        elif kind == BLACKOUT:
            if dark(program.darknesses[stage.place], program.integers, now_ns):
                refusal = BLACKED_OUT
        elif kind == RATE:
            if fate == DELIVERED:
                bottleneck, queue = program.bottlenecks[stage.place], state.queues[stage.place]
                ring_ns = state.departures_ns
                if enters(bottleneck, queue, ring_ns, release_ns) or must:
                    spared = spared or queue.count == bottleneck.queue
                    release_ns = serve(bottleneck, queue, ring_ns, size_bytes)
                else:
                    refusal = OVERFLOWED
                if copy_ns != NEVER_NS:
                    if refusal == DELIVERED and enters(bottleneck, queue, ring_ns, copy_ns):
                        copy_ns = serve(bottleneck, queue, ring_ns, size_bytes)
                    else:
                        copy_ns = NEVER_NS
        else:
            u, v = uniforms(stage.key0, stage.key1, flow.number, packet, 0)
            if kind == DELAY:
                wait = program.waits[stage.place]
                release_ns += delay_ns(wait, program.reals, memory, flow, u)
                if copy_ns != NEVER_NS:
                    # As if it came next, but the next datagram's delay must not depend on it.
                    phase, latest = memory.phase, memory.score
                    copy_ns += delay_ns(wait, program.reals, memory, flow, v)
                    memory.phase, memory.score = phase, latest
            else:
                chance = program.chances[stage.place]
                # Advanced by every datagram, whoever's turn it is.
                does = happens(chance, memory, u)
                if kind == REORDER:
                    if does and (packet + 1) % chance.gap == 0:
                        release_ns = now_ns
                elif kind == DUPLICATE:
                    if does:
                        copy_ns, copy_bit = release_ns, bit
                elif kind == CORRUPT and size_bytes > 0:
                    if does:
                        if must:
                            spared = True
                        else:
                            bit = int(v * (size_bytes * 8))
                    if copy_ns != NEVER_NS and not must:
                        u, v = uniforms(stage.key0, stage.key1, flow.number, packet, 1)
                        if u < chance.probability:
                            copy_bit = int(v * (size_bytes * 8))
        if refusal != DELIVERED and fate == DELIVERED:
            if must:
                spared = True
            else:
                fate = refusal
    if fate == DELIVERED and release_ns > now_ns and state.link.in_flight >= program.limit:
        if must:
            spared = True
        else:
            fate = OVERFLOWED
    if fate != DELIVERED:
        release_ns, copy_ns, bit, copy_bit = NEVER_NS, NEVER_NS, -1, -1
    elif copy_ns != NEVER_NS and copy_ns < release_ns:
        release_ns, copy_ns, bit, copy_bit = copy_ns, release_ns, copy_bit, bit
    if copy_ns > now_ns:
        room = program.limit - state.link.in_flight
        if room < (2 if release_ns > now_ns else 1):
            copy_ns, copy_bit = NEVER_NS, -1
    settle(program, state, row, packet, fate, spared, release_ns, copy_ns, bit, copy_bit,
           now_ns, verdict)  # fmt: skip


def repeat(
    program: LinkProgram,
    state: LinkMemory,
    row: int,
    packet: int,
    size_bytes: int,
    decision: RecordedDecision,
    now_ns: int,
    verdict: PacketDecision,
) -> None:
    """Decide as was decided before, and keep the guarantee all the same.

    A record keeps the guarantee by itself when datagrams come at the times of the record; when they
    come at others, what was held back then may overtake now. A datagram shorter than the recorded
    one is corrupted in another bit, and an empty one in none.
    """
    flow = state.flows[row]
    fate = decision.fate
    bit, copy_bit = within(decision.bit, size_bytes), within(decision.copy_bit, size_bytes)
    release_ns, copy_ns = NEVER_NS, NEVER_NS
    spared = fate == FORCED
    intact = bit < 0 or (decision.copy_delay_ns >= 0 and copy_bit < 0)
    if must_pass(flow, program.mansd) and not (fate in (DELIVERED, FORCED) and intact):
        spared = True
        fate, bit, copy_bit = FORCED, -1, -1
    if fate in (DELIVERED, FORCED, CORRUPTED):
        fate = DELIVERED
        release_ns = now_ns + max(decision.delay_ns, 0)
        if decision.copy_delay_ns >= 0:
            copy_ns = max(now_ns + decision.copy_delay_ns, release_ns)
    settle(program, state, row, packet, fate, spared, release_ns, copy_ns, bit, copy_bit,
           now_ns, verdict)  # fmt: skip


def within(bit: int, size_bytes: int) -> int:
    """Return a bit that a payload has, for one of a payload of another size; −1 is none."""
    if bit < 0 or size_bytes == 0:
        return -1
    return bit % (size_bytes * 8)


def settle(
    program: LinkProgram,
    state: LinkMemory,
    row: int,
    packet: int,
    fate: int,
    spared: bool,
    release_ns: int,
    copy_ns: int,
    bit: int,
    copy_bit: int,
    now_ns: int,
    verdict: PacketDecision,
) -> None:
    """Keep the guarantee for a datagram whose way is known, count it, and fill in the verdict."""
    flow, recent_ns, counters = (
        state.flows[row],
        state.recent_ns[row],
        state.counters,
    )
    effective_ns = NEVER_NS
    if fate == DELIVERED:
        if bit < 0:
            effective_ns = release_ns
        elif copy_ns != NEVER_NS and copy_bit < 0:
            effective_ns = copy_ns
        else:
            fate = CORRUPTED
    hold_back_ns, makes_stale = 0, 0
    if effective_ns != NEVER_NS:
        if program.tracks:
            needed_ns = needed_until_ns(flow, recent_ns, program.mansd, packet)
            if needed_ns > effective_ns:
                hold_back_ns = needed_ns - effective_ns
                effective_ns = needed_ns
                if bit < 0:
                    release_ns = needed_ns
                if copy_ns != NEVER_NS:
                    copy_ns = max(copy_ns, needed_ns)
                counters.held_back += 1
            makes_stale = overtake(recent_ns, program.mansd, packet, effective_ns)
        if spared:
            fate = FORCED
        if flow.forced_first != 0:
            flow.forced_first = 0
            flow.first_release_ns = effective_ns
        flow.run = 0
    else:
        flow.run += 1
        run = min(flow.run, packet + 1 - flow.since)
        flow.longest_loss_burst = max(flow.longest_loss_burst, run)
        counters.longest_loss_burst = max(counters.longest_loss_burst, run)
    if program.tracks and program.mansd >= 0:
        recent_ns[packet % (program.mansd + 1)] = effective_ns
    count(counters, fate)
    if copy_ns != NEVER_NS:
        counters.duplicated += 1
    if release_ns > now_ns:
        state.link.in_flight += 1
    if copy_ns > now_ns:
        state.link.in_flight += 1
    counters.most_in_flight = max(counters.most_in_flight, state.link.in_flight)
    verdict.fate = fate
    verdict.packet = packet
    verdict.run = flow.run
    verdict.release_ns = release_ns
    verdict.copy_ns = copy_ns
    verdict.bit = bit
    verdict.copy_bit = copy_bit
    verdict.hold_back_ns = hold_back_ns
    verdict.makes_stale = makes_stale


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
    """Take note that a datagram, or a copy, leaves; return whether it is stale.

    This looks at what really leaves, and knows nothing of what was decided.

    Args:
        state: what the link remembers.
        row: of its flow.
        packet: its number in the flow.
        size_bytes: of the payload.
        delayed: whether it was under way.
        counts: whether it is the first intact copy.
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
            run = packet - max(flow.newest, flow.since - 1) - 1
            flow.newest = packet
            flow.longest_loss_burst = max(flow.longest_loss_burst, run)
            counters.longest_loss_burst = max(counters.longest_loss_burst, run)
    return stale
