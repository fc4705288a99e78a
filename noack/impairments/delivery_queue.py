"""A queue that packets leave at recorded delivery opportunities: the link model of mahimahi.

An opportunity carries up to 1504 bytes: several small packets, or a part of one, which leaves at
the opportunity that carries its last byte. What an empty queue does not use is lost, and so is an
opportunity at the very time of an arrival (mahimahi, ``link_queue.cc``: ``rationalize`` and
``use_a_delivery_opportunity``). The schedule repeats from its last time on. As in its
``DroppingPacketQueue``, the limits count the packets that no opportunity has begun to carry.

The times of all departures are known on arrival, as those of a bottleneck are. The queue's ring has
two numbers for each waiting packet: when an opportunity begins to carry it, and how many bytes were
put into the queue before it.
"""

from collections.abc import MutableSequence, Sequence
from dataclasses import dataclass

from noack.impairments.link_records import QueueState, RuleStage
from noack.impairments.sorted_numbers import first_above

OPPORTUNITY_BYTES = 1504
_NS_PER_MS = 1_000_000
_LATEST_NS = 2**61
"""73 years: limit against overflow, since packets that must pass may exceed the queue's size."""


@dataclass(slots=True, kw_only=True)
class OpportunityStage(RuleStage):
    """A schedule as numbers: its times in ms, in the program's table of integers."""

    begin: int
    end: int
    offset_ns: int
    """Time in the schedule at time 0."""
    overhead_bytes: int
    queue_bytes: int
    """0: no limit in bytes."""
    rate_bps: int = 0
    """There is none; see :func:`netem.rules.settings_change.carry`."""


@dataclass(slots=True)
class OpportunityQueue(QueueState):
    """The queue's state; ``busy_until_ns`` is the time of the last opportunity that was used."""

    used: int = 0
    """Which of the opportunities at that time it was, from 1."""
    left_bytes: int = 0
    """What it can still carry."""
    total_bytes: int = 0
    """All bytes that were put into the queue."""


def opportunity_after(stage: OpportunityStage, times_ms: Sequence[int], now_ns: int) -> int:
    """Return the number of the first opportunity after a time, counted over all repetitions."""
    period_ns = times_ms[stage.end - 1] * _NS_PER_MS
    elapsed_ns = now_ns + stage.offset_ns
    cycle = elapsed_ns // period_ns
    elapsed_ns -= cycle * period_ns
    place = first_above(times_ms, stage.begin, stage.end - 1, elapsed_ns // _NS_PER_MS)
    return cycle * (stage.end - stage.begin) + place - stage.begin


def opportunity_ns(stage: OpportunityStage, times_ms: Sequence[int], number: int) -> int:
    """Return the time of an opportunity."""
    count = stage.end - stage.begin
    elapsed_ms = number // count * times_ms[stage.end - 1] + times_ms[stage.begin + number % count]
    return min(elapsed_ms, _LATEST_NS // _NS_PER_MS) * _NS_PER_MS - stage.offset_ns


def has_room(
    stage: OpportunityStage,
    queue: OpportunityQueue,
    ring: MutableSequence[int],
    line_bytes: int,
    now_ns: int,
) -> bool:
    """Whether a packet may enter at ``now_ns``; removes packets that are carried until then."""
    queue.entry_ns = max(queue.entry_ns, now_ns)
    while queue.count > 0 and ring[stage.queue_begin + queue.head] <= queue.entry_ns:
        queue.head = (queue.head + 2) % stage.queue_places
        queue.count -= 2
    waiting_bytes = 0
    if queue.count > 0:
        waiting_bytes = queue.total_bytes - ring[stage.queue_begin + queue.head + 1]
    return queue.count < stage.queue_places and (
        stage.queue_bytes == 0 or waiting_bytes + line_bytes <= stage.queue_bytes
    )


def carry_packet(
    stage: OpportunityStage,
    times_ms: Sequence[int],
    queue: OpportunityQueue,
    ring: MutableSequence[int],
    line_bytes: int,
) -> int:
    """Put a packet into the queue, after :func:`has_room`; return its departure time in ns."""
    if queue.busy_until_ns <= queue.entry_ns:  # the queue is empty, and that opportunity is over
        number = opportunity_after(stage, times_ms, queue.entry_ns)
        queue.left_bytes = OPPORTUNITY_BYTES
    else:
        number = opportunity_after(stage, times_ms, queue.busy_until_ns - 1) + queue.used - 1
        if queue.left_bytes == 0:
            number += 1
            queue.left_bytes = OPPORTUNITY_BYTES
    begin_ns = opportunity_ns(stage, times_ms, number)
    more = max(line_bytes - queue.left_bytes + OPPORTUNITY_BYTES - 1, 0) // OPPORTUNITY_BYTES
    number += more
    queue.left_bytes += more * OPPORTUNITY_BYTES - line_bytes
    queue.busy_until_ns = opportunity_ns(stage, times_ms, number)
    queue.used = number - opportunity_after(stage, times_ms, queue.busy_until_ns - 1) + 1
    place = (queue.head + queue.count) % stage.queue_places
    if queue.count == stage.queue_places:  # a packet that must pass may exceed the size
        place = (queue.head + queue.count - 2) % stage.queue_places
    else:
        queue.count += 2
    ring[stage.queue_begin + place] = begin_ns
    ring[stage.queue_begin + place + 1] = queue.total_bytes
    queue.total_bytes += line_bytes
    return queue.busy_until_ns
