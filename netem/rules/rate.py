"""A bottleneck: datagrams leave one after the other, at a rate, from a finite queue.

The queue serves in the order of arrival. Its state follows from arrival times alone, so that it is
the same however late the emulator itself is.
"""

from collections.abc import MutableSequence

from netem.rule_records import QueueState, RateSettings

_NS = 1_000_000_000
_LATEST_NS = 2**61
"""73 years. Those that must pass may be more than any queue holds, and integers have an end."""


def enters(
    bottleneck: RateSettings, queue: QueueState, departures_ns: MutableSequence[int], now_ns: int
) -> bool:
    """Whether the queue has room at ``now_ns``; takes out what has left until then.

    Args:
        bottleneck: its settings.
        queue: its state.
        departures_ns: the ring of departure times, from ``bottleneck.begin`` on.
        now_ns: when the datagram comes to the queue.
    """
    queue.entry_ns = max(queue.entry_ns, now_ns)
    while queue.count > 0 and departures_ns[bottleneck.begin + queue.head] <= queue.entry_ns:
        queue.head = (queue.head + 1) % bottleneck.queue
        queue.count -= 1
    return queue.count < bottleneck.queue


def serve(
    bottleneck: RateSettings,
    queue: QueueState,
    departures_ns: MutableSequence[int],
    size_bytes: int,
) -> int:
    """Put a datagram into the queue; return when it leaves, in ns.

    One that must pass takes no place in a full queue, but its turn.
    """
    line_bytes = max(size_bytes + bottleneck.overhead_bytes, 0)
    if bottleneck.cell_bytes > 0:
        cells = (line_bytes + bottleneck.cell_bytes - 1) // bottleneck.cell_bytes
        line_bytes = cells * (bottleneck.cell_bytes + bottleneck.cell_overhead_bytes)
    if queue.busy_until_ns < queue.entry_ns:
        queue.busy_until_ns = queue.entry_ns
        queue.carry = 0
    work = line_bytes * 8 * _NS + queue.carry
    queue.busy_until_ns = min(queue.busy_until_ns + work // bottleneck.rate_bps, _LATEST_NS)
    queue.carry = work % bottleneck.rate_bps
    place = (queue.head + queue.count) % bottleneck.queue
    if queue.count == bottleneck.queue:
        place = (queue.head + queue.count - 1) % bottleneck.queue
    else:
        queue.count += 1
    departures_ns[bottleneck.begin + place] = queue.busy_until_ns
    return queue.busy_until_ns
