"""Compare with a queue in exact fractions, computed by Lindley's recursion."""

from collections.abc import Sequence
from fractions import Fraction
from math import ceil
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from netem.link_state import LinkState
from noack.core.core_library import core
from noack.impairments.kinds.rate import Rate
from noack.impairments.link_settings import LinkSettings

NS = 10**9

rates = st.builds(
    Rate,
    rate_bps=st.sampled_from([1, 7, 1000, 9_600, 1_000_003, 10**9, 10**12]),
    queue=st.integers(1, 6),
    overhead_bytes=st.sampled_from([-40, 0, 28]),
    cell_bytes=st.sampled_from([0, 48]),
    cell_overhead_bytes=st.sampled_from([0, 5]),
)


def bits(rate: Rate, size_bytes: int) -> int:
    line = max(size_bytes + rate.overhead_bytes, 0)
    if rate.cell_bytes:
        line = ceil(Fraction(line, rate.cell_bytes)) * (rate.cell_bytes + rate.cell_overhead_bytes)
    return 8 * line


def departures(rate: Rate, arrivals: Sequence[tuple[int, int, bool]]) -> list[int | None]:
    """Return departures in whole ns; None if the queue is full and the packet need not pass.

    A forced packet in a full queue shares the last place.
    """
    free = Fraction(0)
    waiting: list[int] = []
    found: list[int | None] = []
    for t_ns, size_bytes, forced in arrivals:
        waiting = [leaves for leaves in waiting if leaves > t_ns]
        if len(waiting) == rate.queue and not forced:
            found.append(None)
            continue
        # The emulator compares in whole nanoseconds whether the line is busy.
        begin = free if int(free) >= t_ns else Fraction(t_ns)
        free = begin + Fraction(bits(rate, size_bytes) * NS, rate.rate_bps)
        if len(waiting) == rate.queue:
            waiting.pop()
        waiting.append(int(free))
        found.append(int(free))
    return found


@given(
    rates,
    st.lists(
        st.tuples(st.sampled_from([0, 0, 1, 1000, 10**6, 10**9]), st.integers(0, 2000),
                  st.booleans()),
        max_size=40,
    ),
)  # fmt: skip
def test_it_is_a_queue(rate: Rate, steps: list[tuple[int, int, bool]]) -> None:
    times = np.cumsum([step[0] for step in steps]).tolist()
    arrivals = [(t, size, forced) for t, (_, size, forced) in zip(times, steps, strict=True)]
    other = Rate(rate_bps=1000, queue=3)  # so that the ring buffer's offset is not 0
    state = LinkState(LinkSettings(impairments=(other, rate)), 0, "a")
    link = state.core
    found: list[int | None] = []
    for t_ns, size_bytes, forced in arrivals:
        room = core.noack_queue_enters(link, 1, t_ns)
        found.append(core.noack_queue_serve(link, 1, size_bytes) if room or forced else None)
    assert found == departures(rate, arrivals)
    assert list(link.departures_ns[0:3]) == [0, 0, 0]


def test_packets_lost_before_the_queue_and_dropped_copies_use_no_line_time(decide: Any) -> None:
    for words, last_s in (("loss worst rate 8kbit 0", 3), ("rate 8kbit 0 loss worst", 5)):
        decided = decide(f"{words} mansd 1 first", 5, sizes_bytes=1000, arrivals_ns=0)
        assert decided.fates.tolist() == [2, 1, 2, 1, 2]
        assert decided.delays_ns[-1] == last_s * NS
    words, arrivals = "duplicate 100% rate 8kbit 0 queue 3", [0, 0, 0, NS, 10 * NS]
    decisions = decide(words, 5, sizes_bytes=1000, arrivals_ns=arrivals).decisions
    assert decisions["fate"].tolist() == [0, 0, 4, 0, 0]
    assert (decisions["release_ns"] // NS).tolist() == [1, 3, -1, 4, 11]
    assert (decisions["copy_ns"] // NS).tolist() == [2, -1, -1, -1, 12]


def test_departures_of_forced_packets_stay_within_the_largest_time(decide: Any) -> None:
    """At 1 bit/s, packets that must all pass queue up for centuries."""
    decisions = decide("rate 1bit 28 1 1000 queue 1 mansd 0", 30, sizes_bytes=65_507).decisions
    assert np.all(np.diff(decisions["release_ns"]) >= 0)
    assert decisions["release_ns"][0] == (65_507 + 28) * 1001 * 8 * NS
    assert decisions["release_ns"][-1] == 2**61
    assert np.all(decisions["consecutive_losses"] == 0)
