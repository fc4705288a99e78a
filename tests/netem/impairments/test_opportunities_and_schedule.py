"""Delivery opportunities as in mahimahi, and the slots of a schedule, one by one."""

from collections import deque
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from netem.core.packet_rows import Fate
from netem.impairments.kinds.opportunities import Opportunities
from netem.impairments.kinds.schedule import Schedule
from netem.impairments.link_settings import LinkSettings
from netem.tc_words import settings_of
from tests.netem.stepped_link import Link

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

    def enqueue(self, number: int, size_bytes: int, now_ns: int, *, must_pass: bool) -> bool:
        self.run_until(now_ns)
        size, (packets, most_bytes) = size_bytes + OVERHEAD_BYTES, self.limits
        waiting = sum(size for _, size in self.queue)
        enters = len(self.queue) < packets and (most_bytes is None or waiting + size <= most_bytes)
        if enters or must_pass:
            self.queue.append((number, size))
        else:
            self.departures[number] = -1
        return enters or must_pass


@given(st.integers(0, 2**32 - 1), st.sampled_from([None, 1, 2]))
def test_each_packet_leaves_as_in_mahimahi(seed: int, mansd: int | None) -> None:
    """With a cap, packets that must pass enter a full queue, too, and count as others do."""
    rng = np.random.default_rng(seed)
    times_ms = sorted(rng.integers(0, 13, rng.integers(1, 9)).tolist())
    times_ms[-1] += times_ms[-1] == 0
    offset_ms, queue = int(rng.integers(times_ms[-1])), int(rng.integers(1, 10))
    queue_bytes = int(rng.integers(1, 9001)) if rng.random() < 0.3 else None
    settings = Opportunities(
        times_ms=tuple(times_ms), queue=queue, queue_bytes=queue_bytes, offset_s=offset_ms / 1e3
    )
    link = Link(LinkSettings(impairments=(settings,), mansd=mansd, limit=1000), 0, "test")
    model = Mahimahi(times_ms, queue, queue_bytes)
    now_ns, releases_ns, lost = 0, [], [0, 0, 0]
    for number in range(40):
        now_ns += int(rng.choice([0, MS, rng.integers(3 * MS)]))
        size, flow = int(rng.choice([0, 1472, rng.integers(4001)])), number % 3
        must_pass = lost[flow] == mansd
        passes = model.enqueue(number, size, now_ns + offset_ms * MS, must_pass=must_pass)
        lost[flow] = 0 if passes else lost[flow] + 1
        releases_ns.append(link.decide(flow, size, now_ns).release_ns)
    model.run_until(now_ns + 2_000 * MS)  # 40 packets need at most 120 opportunities
    expected = [model.departures[number] for number in range(40)]
    assert releases_ns == [-1 if at < 0 else at - offset_ms * MS for at in expected]


def test_the_last_byte_of_an_opportunity_and_of_the_queue_is_used() -> None:
    """An opportunity carries 1504 bytes; packets have 32 more bytes on the link."""
    link = Link(LinkSettings(impairments=(Opportunities(times_ms=(1,), queue=9),)), 0, "test")
    sizes = (1503, 32, 1473)  # one byte is left, which the second uses; then 1473 of the next are left
    assert [link.decide(0, size - OVERHEAD_BYTES, 1).release_ns for size in sizes] == [MS, 2 * MS, 2 * MS]
    settings = Opportunities(times_ms=(1,), queue=9, queue_bytes=100)
    link = Link(LinkSettings(impairments=(settings,)), 0, "test")
    fates = [link.decide(0, size - OVERHEAD_BYTES, 1).fate for size in (50, 50, 32)]
    assert fates == [Fate.DELIVERED, Fate.DELIVERED, Fate.OVERFLOWED]


def test_the_longest_delay_is_that_of_a_full_queue() -> None:
    for times_ms, queue in (((7,), 1), ((0, 3, 4, 20), 5), ((1, 1, 1, 9, 30), 11)):
        settings = Opportunities(times_ms=times_ms, queue=queue)
        longest = 0
        for first_ns in range(1, times_ms[-1] * MS, MS // 2):
            link = Link(LinkSettings(impairments=(settings,)), 0, "test")
            left_ns = [link.decide(0, 1472, first_ns).release_ns for _ in range(queue + 1)]
            longest = max(longest, max(left_ns) - first_ns)
        assert longest / 1e9 <= settings.longest_s <= (longest + 3 * times_ms[-1] * MS) / 1e9


class Slots:
    """A channel with a schedule, slot by slot, with a list of waiting packets for each flow."""

    def __init__(self, order: tuple[int, ...], slot_ns: int, places: int) -> None:
        self.order, self.slot_ns, self.places, self.slot = order, slot_ns, places, 0
        self.queues: dict[int, list[int]] = {flow: [] for flow in order if flow}
        self.departures: dict[int, int] = {}
        self.sent_ns: dict[int, int] = {}

    def run_before(self, now_ns: int) -> None:
        while self.slot * self.slot_ns < now_ns:
            flow = self.order[self.slot % len(self.order)]
            if self.queues.get(flow):
                number = self.queues[flow].pop(0)
                self.departures[number] = self.sent_ns[flow] = self.slot * self.slot_ns
            self.slot += 1

    def enqueue(self, flow: int, number: int, now_ns: int, must_pass: bool) -> bool:
        """Return whether it is lost; nothing waits for a slot that begins now, and is free."""
        self.run_before(now_ns)
        begins = self.slot * self.slot_ns == now_ns
        own = begins and self.order[self.slot % len(self.order)] == flow
        queue = self.queues.get(flow)
        if queue is None:
            self.departures[number] = now_ns if must_pass else -1
        elif must_pass or len(queue) - (own and bool(queue)) < self.places:
            queue.append(number)
        else:
            self.departures[number] = -1
        return self.departures.get(number) == -1


@given(
    st.lists(st.integers(0, 4), min_size=1, max_size=9).filter(any),
    st.sampled_from([1000, MS, 5 * MS + 1]),
    st.lists(
        st.tuples(st.integers(1, 5), st.sampled_from([0, 0, 1, 999, 1000, MS, 5 * MS, 20 * MS])),
        max_size=80,
    ),
    st.integers(1, 4),
    st.sampled_from([None, 0, 1, 3]),
)
def test_a_packet_leaves_in_its_flows_next_free_slot(
    order: list[int], slot_ns: int, steps: Any, places: int, mansd: int | None
) -> None:
    """Against slots one by one; at most mansd successive packets of a flow are lost."""
    order = [sorted({0, *order}).index(flow) for flow in order]  # every flow up to the last has slots
    schedule = Schedule(order=tuple(flow - 1 for flow in order), slot_s=slot_ns / 1e9, queue=places)
    link = Link(LinkSettings(impairments=(schedule,), mansd=mansd, limit=1000), 0, "a")
    model, losses, releases_ns, now_ns = Slots(tuple(order), slot_ns, places), [0] * 6, [], 0
    names: dict[int, int] = {}
    for number, (name, gap_ns) in enumerate(steps):
        now_ns += gap_ns
        flow = names.setdefault(name, len(names) + 1)  # in the order of the first packets
        decision = link.decide(flow - 1, 100, now_ns)
        releases_ns.append(decision.release_ns)
        lost = model.enqueue(flow, number, now_ns, losses[flow] == mansd)
        losses[flow] = (losses[flow] + 1) * lost
        assert decision.consecutive_losses == losses[flow] <= (80 if mansd is None else mansd)
    model.run_before(now_ns + 81 * len(order) * slot_ns)
    assert releases_ns == [model.departures[number] for number in range(len(steps))]


def test_copies_take_slots_and_a_changed_schedule_goes_on_after_those_that_are_taken() -> None:
    link = Link(settings_of("duplicate 100% schedule 0,1 slot 1ms queue 4"), 0, "a")
    decisions = []
    for now_ns in (0, 0, 0):
        decision = link.decide(0, 100, now_ns)
        decisions.append((decision.fate, decision.release_ns // MS, decision.copy_ns // MS))
    assert decisions == [(0, 0, 2), (0, 4, 6), (0, 8, -1)]
    link.change(settings_of("duplicate 0% schedule 1,0 slot 3ms queue 9"))
    assert link.decide(0, 100, 1).release_ns == 9 * MS
