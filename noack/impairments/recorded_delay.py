"""Replays a packet trace: the recorded loss and delay of each packet.

By packet, packet k of a flow gets record k. By time, a packet gets the loss of the last record that
was sent before it. Its receiving time is interpolated between those of the two records around it,
so that a network that keeps the order of the recorded packets keeps the order of all packets.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from noack.impairments.link_records import (
    DROPPED,
    NEVER_NS,
    PacketContext,
    RuleStage,
    StageMemory,
    refuse,
)
from noack.impairments.sorted_numbers import first_above


@dataclass(slots=True, kw_only=True)
class ReplayStage(RuleStage):
    """A trace as numbers in the program's table of integers."""

    begin: int
    """Begin of the delays in ns; −1 − d for a lost packet that takes d if it must pass."""
    end: int
    times_begin: int
    """Begin of the sending times in ns, which do not descend."""
    offset: int
    """First record; by time, the first time in ns."""
    period_ns: int
    """Length of the trace; 0: by packet."""
    once: int


def apply(packet: PacketContext, stage: ReplayStage, memory: StageMemory) -> None:
    """Lose or delay the packet, and its copy, as recorded."""
    decision, table = packet.decision, packet.program.integers
    delay_ns = 0
    if stage.period_ns > 0:
        elapsed_ns = decision.arrival_ns + stage.offset
        if stage.once == 0 or 0 <= elapsed_ns < stage.period_ns:
            delay_ns = delay_at(stage, table, elapsed_ns % stage.period_ns)
    else:
        record, count = decision.packet + stage.offset, stage.end - stage.begin
        if stage.once == 0 or record < count:
            delay_ns = table[stage.begin + record % count]
    if delay_ns < 0:
        refuse(decision, DROPPED)
        delay_ns = -1 - delay_ns
    decision.release_ns += delay_ns
    if decision.copy_ns != NEVER_NS:
        decision.copy_ns += delay_ns


def delay_at(stage: ReplayStage, table: Sequence[int], elapsed_ns: int) -> int:
    """Return the delay of a packet by its time in the trace, or −1 − d for a lost packet."""
    count = stage.end - stage.begin
    later = first_above(table, stage.times_begin, stage.times_begin + count, elapsed_ns)
    high = later - stage.times_begin
    low = max(high - 1, 0)  # the last record that is not later
    delay_ns = table[stage.begin + low]
    if delay_ns < 0 or high == count or table[stage.begin + high] < 0:
        return delay_ns
    sent_ns = table[stage.times_begin + low]
    gap_ns = table[stage.times_begin + high] - sent_ns
    return delay_ns + part_of(table[stage.begin + high] - delay_ns, elapsed_ns - sent_ns, gap_ns)


def part_of(change_ns: int, elapsed_ns: int, gap_ns: int) -> int:
    """Return change · elapsed / gap for 0 ≤ elapsed < gap; it ascends with elapsed + result.

    Whole numbers, without overflow: of gaps beyond 2 s, some low bits are ignored.
    """
    each, part = change_ns // gap_ns, change_ns % gap_ns
    whole_ns = each * elapsed_ns
    unit_ns = 1
    while gap_ns >= 2147483648:
        unit_ns, part, elapsed_ns, gap_ns = 2 * unit_ns, part // 2, elapsed_ns // 2, gap_ns // 2
    return whole_ns + part * elapsed_ns // gap_ns * unit_ns
