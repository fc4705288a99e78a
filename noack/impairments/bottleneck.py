"""A bottleneck: packets leave one after the other, at a rate, from a finite queue.

The queue serves in the order of arrival. Its state follows from arrival times alone, so that it
does not depend on how late the emulator itself is: when a packet arrives, the time at which its
service begins and ends is known.
"""

from collections.abc import MutableSequence
from dataclasses import dataclass

from noack.impairments.link_records import QueueState, RuleStage

_NS = 1_000_000_000
_LATEST_NS = 2**61
"""73 years. More packets may have to pass than the queue takes, and integers have an end."""


@dataclass(slots=True, kw_only=True)
class BottleneckStage(RuleStage):
    """A rate limit as numbers; the queue's places are those of the stage."""

    rate_bps: int
    overhead_bytes: int
    cell_bytes: int
    cell_overhead_bytes: int


def enters(
    stage: BottleneckStage, queue: QueueState, departures_ns: MutableSequence[int], now_ns: int
) -> bool:
    """Whether the queue has a free place at ``now_ns``; removes what has left until then.

    Args:
        stage: the bottleneck's settings.
        queue: its state.
        departures_ns: the rings of departure times.
        now_ns: when the packet comes to the queue.
    """
    queue.entry_ns = max(queue.entry_ns, now_ns)
    while queue.count > 0 and departures_ns[stage.queue_begin + queue.head] <= queue.entry_ns:
        queue.head = (queue.head + 1) % stage.queue_places
        queue.count -= 1
    return queue.count < stage.queue_places


def serve(
    stage: BottleneckStage,
    queue: QueueState,
    departures_ns: MutableSequence[int],
    size_bytes: int,
) -> int:
    """Put a packet into the queue, after :func:`enters`; return when it leaves, in ns."""
    line_bytes = max(size_bytes + stage.overhead_bytes, 0)
    if stage.cell_bytes > 0:
        cells = (line_bytes + stage.cell_bytes - 1) // stage.cell_bytes
        line_bytes = cells * (stage.cell_bytes + stage.cell_overhead_bytes)
    if queue.busy_until_ns < queue.entry_ns:
        queue.busy_until_ns = queue.entry_ns
        queue.carry = 0
    work = line_bytes * 8 * _NS + queue.carry
    queue.busy_until_ns = min(queue.busy_until_ns + work // stage.rate_bps, _LATEST_NS)
    queue.carry = work % stage.rate_bps
    occupy(stage, queue, departures_ns, queue.busy_until_ns)
    return queue.busy_until_ns


def occupy(
    stage: BottleneckStage,
    queue: QueueState,
    departures_ns: MutableSequence[int],
    until_ns: int,
) -> None:
    """Take a place in the queue until a time; a packet that must pass needs none in a full one."""
    place = (queue.head + queue.count) % stage.queue_places
    if queue.count == stage.queue_places:
        place = (queue.head + queue.count - 1) % stage.queue_places
    else:
        queue.count += 1
    departures_ns[stage.queue_begin + place] = until_ns
