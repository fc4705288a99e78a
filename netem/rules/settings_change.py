"""A change of settings: transfers a link's state to the new program."""

from collections.abc import Sequence

from netem.rules.guarantee import counts_losses
from noack.impairments.bottleneck import BottleneckStage
from noack.impairments.link_records import LinkMemory, LinkProgram, RuleStage


def carry(
    old: LinkProgram,
    before: LinkMemory,
    new: LinkProgram,
    after: LinkMemory,
    latest_ns: Sequence[int],
) -> None:
    """Transfer the state ``before`` of a program to the state ``after`` of a new program.

    A stage keeps its state if the new program has a stage of the same kind and name; a queue keeps
    its state under another discipline, too. Flows, counters and packets in flight do not change,
    except that the count of the longest loss burst starts again, since another guarantee may apply.

    Args:
        old: the program so far.
        before: its state.
        new: the program from now on.
        after: a new state with as many rows, which shares ``before.flows``.
        latest_ns: (rows,) last departure time of the packets in flight of each flow; −1 if none is.
    """
    for stage in new.stages:
        place, was = stage.place, _place_of(old, stage)
        if was < 0:
            continue
        same = stage.kind == old.stages[was].kind
        if same:
            after.queues[place] = before.queues[was]  # type: ignore[index]
        if stage.queue_places > 0:
            _carry_queue(old.stages[was], before, stage, after)
        if same:
            for row in range(len(before.flows)):
                after.memory[row][place].phase = before.memory[row][was].phase
                after.memory[row][place].score = before.memory[row][was].score
    for row in range(len(before.flows)):
        before.flows[row].since = before.flows[row].packets
        before.flows[row].longest_loss_burst = 0
        if counts_losses(new):
            _carry_losses(row, old, before, after)
        if new.tracks:
            _carry_releases(row, old, before, new, after, latest_ns[row])
    after.counters.longest_loss_burst = 0


def _place_of(program: LinkProgram, stage: RuleStage) -> int:
    """Return the place of the stage with this name and the same kind, or with a queue; −1: none."""
    for other in program.stages:
        alike = other.kind == stage.kind or (other.queue_places > 0 and stage.queue_places > 0)
        if alike and (other.key0, other.key1) == (stage.key0, stage.key1):
            return int(other.place)
    return -1


def _carry_queue(
    old: BottleneckStage, before: LinkMemory, new: BottleneckStage, after: LinkMemory
) -> None:
    """Transfer a queue; a shorter one drops the earliest departure times, and is full then."""
    queue, new_queue = before.queues[old.place], after.queues[new.place]
    count = min(queue.count, new.queue_places)
    first = queue.head + queue.count - count
    for k in range(count):
        place = old.queue_begin + (first + k) % old.queue_places
        after.departures_ns[new.queue_begin + k] = before.departures_ns[place]
    new_queue.head = 0
    new_queue.count = count
    new_queue.entry_ns = queue.entry_ns
    new_queue.busy_until_ns = queue.busy_until_ns
    new_queue.carry = queue.carry if new.rate_bps == old.rate_bps else 0


def _carry_losses(row: int, old: LinkProgram, before: LinkMemory, after: LinkMemory) -> None:
    """Transfer the outcomes of the last packets; an unknown outcome counts as a delivery."""
    flow, known, losses = before.flows[row], before.losses[row], after.losses[row]
    packets, mask = flow.packets, len(losses) - 1
    times_ns = before.recent_ns[row]
    counted, listed = counts_losses(old), old.tracks and old.mansd >= 0
    if counted:
        count = len(known) - 1
        if count == mask:
            for place in range(len(losses)):
                losses[place] = known[place]
            return
    elif listed:
        count = min(old.mansd + 1, packets)
    else:
        count = flow.consecutive_losses
    so_far = 0
    for number in range(packets - min(count, mask), packets):
        lost = True
        if counted:
            lost = known[(number + 1) & count] > known[number & count]
        elif listed:
            lost = times_ns[number & (len(times_ns) - 1)] < 0
        so_far += 1 if lost else 0
        losses[(number + 1) & mask] = so_far


def _is_same_guarantee(old: LinkProgram, new: LinkProgram) -> bool:
    """Whether two programs have the same guarantee."""
    if old.mansd != new.mansd or old.recovery != new.recovery:
        return False
    if len(old.windows) != len(new.windows):
        return False
    for number in range(len(new.windows)):
        one, other = old.windows[number], new.windows[number]
        if one.losses != other.losses or one.packets != other.packets:
            return False
    return True


def _carry_releases(
    row: int, old: LinkProgram, before: LinkMemory, new: LinkProgram, after: LinkMemory,
    latest_ns: int,
) -> None:  # fmt: skip
    """Transfer the release times that the guarantee needs.

    If the guarantee differs (or there is none any more), later packets leave only after the
    packets that are in flight at the change.
    """
    flow, width = before.flows[row], new.mansd + 1
    times_ns, older_ns = after.recent_ns[row], before.recent_ns[row]
    mask = len(times_ns) - 1
    if old.tracks:
        if old.mansd >= 0 and new.mansd >= 0:
            kept = min(width, old.mansd + 1)
            for number in range(max(flow.packets - kept, 0), flow.packets):
                times_ns[number & mask] = older_ns[number & (len(older_ns) - 1)]
        if not _is_same_guarantee(old, new):
            flow.first_release_ns = max(flow.first_release_ns, latest_ns)
    elif new.mansd >= 0:
        delivered = flow.packets - 1 - flow.consecutive_losses
        if delivered >= 0 and flow.consecutive_losses < width:
            times_ns[delivered & mask] = 0
