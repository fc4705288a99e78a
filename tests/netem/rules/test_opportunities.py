"""Delivery opportunities against a model of mahimahi's link, which runs through all of them."""

from collections import deque
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from noack.impairments.kinds.opportunities import Opportunities
from noack.impairments.link_settings import LinkSettings
from tests.oracles.link import Link

MS = 10**6
OVERHEAD_BYTES = 32


class Mahimahi:
    """Its ``LinkQueue`` with a drop-tail queue, opportunity by opportunity; times in ns."""

    def __init__(self, times_ms: list[int], packets: int, most_bytes: int | None) -> None:
        self.schedule = [t * MS for t in times_ms]
        self.next, self.base_ns = 0, 0
        self.limits = packets, most_bytes
        self.queue: deque[tuple[int, int]] = deque()
        self.in_transit: tuple[int, int] | None = None
        self.departures: dict[int, int] = {}

    def run_until(self, now_ns: int) -> None:
        while self.base_ns + self.schedule[self.next] <= now_ns:
            time_ns = self.base_ns + self.schedule[self.next]
            self.next += 1
            if self.next == len(self.schedule):
                self.next, self.base_ns = 0, self.base_ns + self.schedule[-1]
            left = 1504
            while left > 0 and (self.in_transit or self.queue):
                number, size = self.in_transit or self.queue.popleft()
                sent = min(left, size)
                left -= sent
                self.in_transit = (number, size - sent) if size > sent else None
                if self.in_transit is None:
                    self.departures[number] = time_ns

    def enqueue(self, number: int, size_bytes: int, now_ns: int) -> None:
        self.run_until(now_ns)
        size, (packets, most_bytes) = size_bytes + OVERHEAD_BYTES, self.limits
        waiting = sum(size for _, size in self.queue)
        if len(self.queue) < packets and (most_bytes is None or waiting + size <= most_bytes):
            self.queue.append((number, size))
        else:
            self.departures[number] = -1


times = st.lists(st.integers(0, 12), min_size=1, max_size=8).map(sorted).filter(lambda t: t[-1] > 0)
packets = st.lists(
    st.tuples(st.integers(0, 3 * MS) | st.sampled_from([0, MS]), st.integers(0, 4000)), max_size=40
)


@given(times, packets, st.integers(1, 9), st.none() | st.integers(1, 9000), st.integers(0, 11))
def test_each_packet_leaves_as_in_mahimahi(
    times_ms: list[int], steps: Any, queue: int, queue_bytes: int | None, offset: int
) -> None:
    offset_ms = offset % times_ms[-1]
    settings = Opportunities(
        times_ms=tuple(times_ms), queue=queue, queue_bytes=queue_bytes, offset_s=offset_ms / 1e3
    )
    link = Link(LinkSettings(impairments=(settings,), limit=1000), 0, "test")
    model = Mahimahi(times_ms, queue, queue_bytes)
    now_ns, found = 0, []
    for number, (gap_ns, size) in enumerate(steps):
        now_ns += gap_ns
        model.enqueue(number, size, now_ns + offset_ms * MS)
        found.append(link.decide(number % 3, size, now_ns).release_ns)
    model.run_until(now_ns + 2_000 * MS)  # 40 packets need at most 120 opportunities
    expected = [model.departures[number] for number in range(len(steps))]
    assert found == [-1 if at < 0 else at - offset_ms * MS for at in expected]


def test_a_packet_that_must_pass_leaves_although_the_queue_is_full() -> None:
    settings = Opportunities(times_ms=(100,), queue=1)
    decisions = []
    link = Link(LinkSettings(impairments=(settings,), mansd=1), 0, "test")
    for _ in range(5):
        decision = link.decide(0, 1472, 0)
        decisions.append((decision.fate, decision.release_ns // MS))
    assert decisions == [(0, 100), (4, -1), (2, 200), (4, -1), (2, 300)]


def test_the_queue_survives_a_change_of_the_schedule() -> None:
    """What waits has its departure; what arrives later leaves after it, by the new schedule."""
    old, new = (Opportunities(times_ms=t, queue=3) for t in ((10,), (7,)))
    link = Link(LinkSettings(impairments=(old,)), 0, "test")
    assert [link.decide(0, 1472, 0).release_ns // MS for _ in range(3)] == [10, 20, 30]
    link.change(LinkSettings(impairments=(new,)))
    assert link.decide(0, 1472, 5 * MS).fate == 4  # the queue is still full
    assert link.decide(0, 1472, 12 * MS).release_ns == 42 * MS  # 35 is the one after 30


def test_the_longest_delay_is_that_of_a_full_queue() -> None:
    for times_ms, queue in (((7,), 1), ((0, 3, 4, 20), 5), ((1, 1, 1, 9, 30), 11)):
        settings = Opportunities(times_ms=times_ms, queue=queue)
        longest = 0
        for first_ns in range(1, times_ms[-1] * MS, MS // 2):
            link = Link(LinkSettings(impairments=(settings,)), 0, "test")
            left_ns = [link.decide(0, 1472, first_ns).release_ns for _ in range(queue + 1)]
            longest = max(longest, max(left_ns) - first_ns)
        assert longest / 1e9 <= settings.longest_s <= (longest + 3 * times_ms[-1] * MS) / 1e9
