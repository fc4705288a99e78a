"""A change of settings: transfers a link's state to the new program."""

from collections.abc import MutableSequence, Sequence

from noack.impairments.bottleneck import BottleneckStage
from noack.impairments.link_records import (
    FlowState,
    LinkMemory,
    LinkProgram,
    QueueState,
    RuleStage,
)


def carry(
    old: LinkProgram,
    before: LinkMemory,
    new: LinkProgram,
    after: LinkMemory,
    latest_ns: Sequence[int],
) -> None:
    """Transfer the state under the program ``old`` to the program ``new``.

    A stage keeps its state if the new program has a stage of the same kind and name; a queue keeps
    its state under another discipline, too. Flows, counters and packets in flight do not change,
    except that the count of the longest loss burst starts again, since another cap may apply.

    Args:
        old: the program so far.
        before: its state.
        new: the program from now on.
        after: a new state with as many rows, which shares ``before.flows``; it is filled.
        latest_ns: (rows,) last departure time of the packets in flight of each flow; −1 if none is.
    """
    for place in range(len(new.stages)):
        stage = new.stages[place]
        was = _place_of(old, stage)
        if was < 0:
            continue
        if stage.queue_places > 0:
            if stage.kind == old.stages[was].kind:
                after.queues[place] = before.queues[was]  # type: ignore[index]
            _carry_queue(
                old.stages[was], before.queues[was], before.departures_ns,
                stage, after.queues[place], after.departures_ns,
            )  # fmt: skip
        if stage.kind == old.stages[was].kind:
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
    """Return the place of the stage with this name and the same kind, or with a queue; −1: none."""
    for place in range(len(program.stages)):
        other = program.stages[place]
        alike = other.kind == stage.kind or (other.queue_places > 0 and stage.queue_places > 0)
        if alike and (other.key0, other.key1) == (stage.key0, stage.key1):
            return place
    return -1


def _carry_queue(
    old: BottleneckStage,
    queue: QueueState,
    departures_ns: Sequence[int],
    new: BottleneckStage,
    new_queue: QueueState,
    new_departures_ns: MutableSequence[int],
) -> None:
    """Transfer a queue; a shorter one drops the earliest departure times, and is full then."""
    kept = min(queue.count, new.queue_places)
    first = queue.head + queue.count - kept
    for k in range(kept):
        place = old.queue_begin + (first + k) % old.queue_places
        new_departures_ns[new.queue_begin + k] = departures_ns[place]
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
    """Transfer the release times that the guarantee needs.

    If the cap differs, or no release times were stored, later packets leave only after the packets
    that are in flight at the change.
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
        delivered = flow.packets - 1 - flow.consecutive_losses
        if delivered >= 0 and flow.consecutive_losses < width:
            new_ns[delivered % width] = 0
