"""A bottleneck: packets leave one after the other, at a rate, from a finite queue.

The queue serves in the order of arrival. Its state depends on arrival times only, not on the
emulator's own lateness: the begin and the end of a packet's service are known on its arrival.
"""

from collections.abc import MutableSequence
from dataclasses import dataclass

from noack.impairments.link_records import QueueState, RuleStage

_NS = 1_000_000_000
_LATEST_NS = 2**61
"""73 years: limit against overflow, since packets that must pass may exceed the queue's size."""


@dataclass(slots=True, kw_only=True)
class BottleneckStage(RuleStage):
    """A rate limit as numbers; ``queue_places`` of the stage is the size of the queue."""

    rate_bps: int
    overhead_bytes: int
    cell_bytes: int
    cell_overhead_bytes: int


def enters(
    stage: BottleneckStage, queue: QueueState, departures_ns: MutableSequence[int], now_ns: int
) -> bool:
    """Whether the queue has a free place at ``now_ns``; removes packets that have left until then.

    ``departures_ns``: the rings of departure times of all queues.
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
    """Put a packet into the queue, after :func:`enters`; return its departure time in ns."""
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
    """Occupy a place in the queue until a time; a packet that must pass may exceed the size."""
    place = (queue.head + queue.count) % stage.queue_places
    if queue.count == stage.queue_places:
        place = (queue.head + queue.count - 1) % stage.queue_places
    else:
        queue.count += 1
    departures_ns[stage.queue_begin + place] = until_ns
