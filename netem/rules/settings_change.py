"""A change of settings under way: what a link remembers goes on under the new program."""

from collections.abc import MutableSequence, Sequence

from netem.rule_records import FlowState, QueueState, RateSettings, RuleStage
from netem.rules.link_rules import RATE, LinkMemory, LinkProgram


def carry(
    old: LinkProgram,
    before: LinkMemory,
    new: LinkProgram,
    after: LinkMemory,
    latest_ns: Sequence[int],
) -> None:
    """Fill what ``new`` remembers from what ``old`` remembered.

    A stage goes on if the new program has one of its kind and name. Flows, counters and what is
    under way are the link's own and stay as they are; but the longest run begins anew, as it is to
    be held against another cap.

    Args:
        old: the program so far.
        before: what is remembered.
        new: the program from now on.
        after: a fresh state with as many rows, which shares ``before.flows``.
        latest_ns: (rows,) when the last that is under way leaves, of each row's flow; −1 if nothing
            is.
    """
    for place in range(len(new.stages)):
        stage = new.stages[place]
        was = _place_of(old, stage)
        if was < 0:
            continue
        if stage.kind == RATE:
            old_place = old.stages[was].place
            _carry_queue(
                old.bottlenecks[old_place], before.queues[old_place], before.departures_ns,
                new.bottlenecks[stage.place], after.queues[stage.place], after.departures_ns,
            )  # fmt: skip
        for row in range(len(before.flows)):
            after.memory[row][place].phase = before.memory[row][was].phase
            after.memory[row][place].score = before.memory[row][was].score
    for row in range(len(before.flows)):
        before.flows[row].since = before.flows[row].packets
        before.flows[row].longest_loss_burst = 0
    after.counters.longest_loss_burst = 0
    if new.tracks and new.mansd >= 0:
        for row in range(len(before.flows)):
            _carry_releases(
                before.flows[row], old, before.recent_ns[row], new, after.recent_ns[row],
                latest_ns[row],
            )  # fmt: skip


def _place_of(program: LinkProgram, stage: RuleStage) -> int:
    """Place of the stage with the same kind and name; −1 if there is none."""
    for place in range(len(program.stages)):
        other = program.stages[place]
        if (other.kind, other.key0, other.key1) == (stage.kind, stage.key0, stage.key1):
            return place
    return -1


def _carry_queue(
    old: RateSettings,
    queue: QueueState,
    departures_ns: Sequence[int],
    new: RateSettings,
    new_queue: QueueState,
    new_departures_ns: MutableSequence[int],
) -> None:
    """Keep the queue; a shorter one forgets who leaves first, so that it counts as full."""
    kept = min(queue.count, new.queue)
    first = queue.head + queue.count - kept
    for k in range(kept):
        new_departures_ns[new.begin + k] = departures_ns[old.begin + (first + k) % old.queue]
    new_queue.head = 0
    new_queue.count = kept
    new_queue.entry_ns = queue.entry_ns
    new_queue.busy_until_ns = queue.busy_until_ns
    new_queue.carry = queue.carry if new.rate_bps == old.rate_bps else 0


def _carry_releases(
    flow: FlowState,
    old: LinkProgram,
    old_ns: Sequence[int],
    new: LinkProgram,
    new_ns: MutableSequence[int],
    latest_ns: int,
) -> None:
    """Keep what the guarantee needs to know of the datagrams before the change.

    With another cap, or where none was kept, nothing overtakes what is under way at the change.
    """
    width = new.mansd + 1
    if old.tracks:
        if old.mansd >= 0:
            old_width = old.mansd + 1
            for number in range(max(flow.packets - min(width, old_width), 0), flow.packets):
                new_ns[number % width] = old_ns[number % old_width]
        if old.mansd != new.mansd:
            flow.first_release_ns = max(flow.first_release_ns, latest_ns)
    else:
        delivered = flow.packets - 1 - flow.run
        if delivered >= 0 and flow.run < width:
            new_ns[delivered % width] = 0
