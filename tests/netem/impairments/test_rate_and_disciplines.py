"""A link's rate in fractions, CoDel by RFC 8289, and what is sent first of what waits."""

import math
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from math import ceil
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from netem.core.core_library import core
from netem.impairments.disciplines.codel import Codel
from netem.impairments.disciplines.earliest_deadline import EarliestDeadline
from netem.impairments.disciplines.maximum_error import MaximumError
from netem.impairments.disciplines.priority import Priority
from netem.impairments.disciplines.tail_drop import TailDrop
from netem.impairments.feature import Scheduler
from netem.impairments.kinds.rate import Rate
from netem.impairments.link_settings import LinkSettings
from netem.link_state import LinkState
from netem.tc_words import settings_of, words_of
from noack.machines.channel import Channel
from tests.netem.stepped_link import Link
from tests.noack.machines.stepped_channel import send

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
    leaves_ns: list[int | None] = []
    for t_ns, size_bytes, forced in arrivals:
        waiting = [leaves for leaves in waiting if leaves > t_ns]
        if len(waiting) == rate.queue and not forced:
            leaves_ns.append(None)
            continue
        # The emulator compares in whole nanoseconds whether the line is busy.
        begin = free if int(free) >= t_ns else Fraction(t_ns)
        free = begin + Fraction(bits(rate, size_bytes) * NS, rate.rate_bps)
        if len(waiting) == rate.queue:
            waiting.pop()
        waiting.append(int(free))
        leaves_ns.append(int(free))
    return leaves_ns


@given(
    rates,
    st.lists(
        st.tuples(st.sampled_from([0, 0, 1, 1000, 10**6, 10**9]), st.integers(0, 2000),
                  st.booleans()),
        max_size=40,
    ),
)  # fmt: skip
def test_a_rate_serves_packets_as_a_queue(rate: Rate, steps: list[tuple[int, int, bool]]) -> None:
    times = np.cumsum([step[0] for step in steps]).tolist()
    arrivals = [(t, size, forced) for t, (_, size, forced) in zip(times, steps, strict=True)]
    other = Rate(rate_bps=1000, queue=3)  # so that the ring buffer's offset is not 0
    state = LinkState(LinkSettings(impairments=(other, rate)), 0, "a")
    link = state.core
    leaves_ns: list[int | None] = []
    for t_ns, size_bytes, forced in arrivals:
        room = core.noack_queue_enters(link, 1, t_ns)
        leaves_ns.append(core.noack_queue_serve(link, 1, size_bytes) if room or forced else None)
    assert leaves_ns == departures(rate, arrivals)
    assert core.noack_queue_enters(link, 0, 0)  # the other queue was empty
    assert [core.noack_queue_serve(link, 0, 125)] == departures(other, [(0, 125, False)])


@dataclass
class TokenBucket:
    """A queue before a bucket of tokens, one for each byte, which a rate fills; times are in ns."""

    rate: Rate
    tokens: Fraction = Fraction(0)
    clock: Fraction = Fraction(0)
    """When there were so many tokens."""
    waiting: deque[tuple[int, int]] = field(default_factory=deque)
    """Numbers of packets, and their bytes."""
    leaves_ns: dict[int, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.tokens = Fraction(self.rate.burst_bytes or 0)

    def serve_until(self, t_ns: int) -> None:
        """Let leave what leaves until a time, in whole ns."""
        per_ns = Fraction(self.rate.rate_bps, 8 * NS)
        while self.waiting:
            number, size = self.waiting[0]
            leaves = self.clock + max((size - self.tokens) / per_ns, 0)
            if int(leaves) > t_ns:
                return
            self.waiting.popleft()
            self.tokens += (leaves - self.clock) * per_ns - size
            self.clock = leaves
            self.leaves_ns[number] = int(leaves)
        if self.clock < t_ns:
            burst = self.rate.burst_bytes or 0
            self.tokens = min(self.tokens + (t_ns - self.clock) * per_ns, Fraction(burst))
            self.clock = Fraction(t_ns)

    def enters(self, size: int) -> bool:
        """Whether there is room, and the bucket is large enough."""
        rate, most_bytes = self.rate, self.rate.queue_bytes
        if rate.queue_s is not None:
            most_bytes = int(Fraction(str(rate.queue_s)) * rate.rate_bps / 8)
        if rate.burst_bytes is not None and size > rate.burst_bytes:
            return False
        if most_bytes is None:
            return len(self.waiting) < rate.queue
        return sum(max(size, 1) for _, size in self.waiting) + max(size, 1) <= most_bytes


def bucket_departures(rate: Rate, mansd: int | None, arrivals: Sequence[tuple[int, int]]) -> list[int]:
    """Return departures in whole ns; −1 if a packet is lost; at most mansd in a row are."""
    line, losses = TokenBucket(rate), 0
    for number, (t_ns, size_bytes) in enumerate(arrivals):
        line.serve_until(t_ns)
        size = bits(rate, size_bytes) // 8
        if losses == mansd or line.enters(size):
            line.waiting.append((number, size))
            losses = 0
        else:
            losses += 1
    line.serve_until(2**62)
    return [line.leaves_ns.get(number, -1) for number in range(len(arrivals))]


queue_sizes = st.one_of(
    st.builds(dict, queue=st.integers(1, 6)),
    st.builds(dict, queue_bytes=st.sampled_from([1, 28, 100, 1500, 4000, 20_000])),
    st.builds(dict, queue_s=st.sampled_from([0.0012345, 0.05, 1.0])),
)
shaped = st.builds(
    lambda size, **others: Rate(**others, **size),
    queue_sizes,
    rate_bps=st.sampled_from([9_600, 1_000_003, 10**7, 10**9]),
    burst_bytes=st.sampled_from([None, 1, 100, 1528, 5000, 20_480]),
    overhead_bytes=st.sampled_from([-40, 0, 28]),
    cell_bytes=st.sampled_from([0, 48]),
    cell_overhead_bytes=st.just(5),
)
bursts_of_packets = st.lists(
    st.tuples(
        st.sampled_from([0, 0, 0, 1, 1000, 10**5, 10**6, 10**9]), st.sampled_from([0, 1, 40, 72, 1472, 2000])
    ),
    max_size=60,
)


def timed(steps: list[tuple[int, int]]) -> list[tuple[int, int]]:
    times = np.cumsum([gap for gap, _ in steps]).tolist()
    return [(t, size) for t, (_, size) in zip(times, steps, strict=True)]


@given(shaped, st.sampled_from([None, None, 0, 1, 3]), bursts_of_packets)
@example(Rate(rate_bps=10**7, queue_s=0.05, burst_bytes=20_480), None, [(0, 1472)] * 60)
def test_a_burst_is_a_token_bucket_and_its_queue_has_bytes_or_a_time(
    rate: Rate, mansd: int | None, steps: list[tuple[int, int]]
) -> None:
    """Each departure is that of a simulation of the bucket in fractions, and so is each loss."""
    arrivals = timed(steps)
    settings = LinkSettings(impairments=(rate,), mansd=mansd, limit=1_000_000)
    link = Link(settings, 0, "a")
    decided = [link.decide(0, size, t).release_ns for t, size in arrivals]
    assert decided == bucket_departures(rate, mansd, arrivals)
    assert settings_of(words_of(settings)) == settings


def test_a_burst_passes_at_once_and_the_rate_the_rest(decide: Any) -> None:
    """By hand: 1000 bytes take 1 ms; the bucket has 3000, the queue 2000."""
    words, sizes = "rate 8mbit 0 queue 2000b burst 3000b", 1000
    decided = decide(words, 8, sizes_bytes=sizes, arrivals_ns=[0] * 6 + [1_500_000, 99 * MS])
    assert decided.fates.tolist() == [0, 0, 0, 0, 0, 4, 0, 0]
    assert decided.delays_ns.tolist() == [0, 0, 0, MS, 2 * MS, 1_500_000, 0]
    # What is longer than the bucket is lost; if it must pass, it waits for the missing bytes.
    decided = decide(f"{words} mansd 1", 3, sizes_bytes=4000, arrivals_ns=10 * MS)
    assert decided.fates.tolist() == [4, 2, 4]
    assert decided.delays_ns.tolist() == [MS]


@given(shaped, shaped, bursts_of_packets, st.integers(0, 60))
def test_a_change_keeps_the_bucket_and_the_order(
    rate: Rate, other: Rate, steps: list[tuple[int, int]], change_at: int
) -> None:
    arrivals = timed(steps)
    for later in (rate, other):
        settings = [LinkSettings(impairments=(impairment,), limit=1_000_000) for impairment in (rate, later)]
        link, decided = Link(settings[0], 0, "a"), []
        for number, (t, size) in enumerate(arrivals):
            if number == change_at:
                link.change(settings[1])
            decided.append(link.decide(0, size, t).release_ns)
        if later is rate:
            assert decided == bucket_departures(rate, None, arrivals)
        leaves_ns = [t for t in decided if t >= 0]
        assert leaves_ns == sorted(leaves_ns)


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
    for queue in ("opportunities at 10 queue 1", "schedule 0 slot 10ms queue 1"):
        (decision,) = decide(f"duplicate 100% {queue}", 1, sizes_bytes=1000, arrivals_ns=1).decisions
        assert (decision["release_ns"], decision["copy_ns"]) == (10_000_000, -1)


def test_departures_of_forced_packets_stay_within_the_largest_time(decide: Any) -> None:
    """At 1 bit/s, packets that must all pass queue up for centuries."""
    decisions = decide("rate 1bit 28 1 1000 queue 1 mansd 0", 30, sizes_bytes=65_507).decisions
    assert np.all(np.diff(decisions["release_ns"]) >= 0)
    assert decisions["release_ns"][0] == (65_507 + 28) * 1001 * 8 * NS
    assert decisions["release_ns"][-1] == 2**61
    assert np.all(decisions["consecutive_losses"] == 0)


MS = 10**6
RATE_BPS = 8_000_000
"""Sending a byte takes 1 µs."""
PER_BYTE_NS = 1000


@dataclass
class Packet:
    number: int
    size_bytes: int
    enqueued_ns: int


@dataclass
class RfcCodel:
    """A line with CoDel: names and control flow of the RFC; ``spare`` replaces the MTU rule."""

    target_ns: int
    interval_ns: int
    spare: Callable[["RfcCodel", Packet, int], bool]
    must_pass: Callable[[int], bool]
    queue: deque[Packet] = field(default_factory=deque)
    free_ns: int = 0
    first_above: int = 0
    drop_next: int = 0
    count: int = 0
    lastcount: int = 0
    dropping: bool = False
    leaves_ns: dict[int, int | None] = field(default_factory=dict)
    burst_ns: int = 0
    """Time that the rate needs for a burst: so much earlier a packet may leave."""

    def control_law(self, t: int, count: int) -> int:
        return t + int(self.interval_ns / math.sqrt(count))

    def dodequeue(self, now: int) -> tuple[Packet | None, bool]:
        if not self.queue:
            self.first_above = 0
            return None, False
        packet = self.queue.popleft()
        sojourn = now - packet.enqueued_ns
        if sojourn < self.target_ns or self.spare(self, packet, sojourn):
            self.first_above = 0
        elif self.first_above == 0:
            self.first_above = now + self.interval_ns
        elif now >= self.first_above:
            return packet, True
        return packet, False

    def drop(self, packet: Packet) -> None:
        self.leaves_ns[packet.number] = None

    def dequeue(self, now: int) -> Packet | None:
        packet, ok_to_drop = self.dodequeue(now)
        if packet is None:
            self.dropping = False
            return None
        if self.dropping:
            if not ok_to_drop:
                self.dropping = False
            while packet and now >= self.drop_next and self.dropping:
                if self.must_pass(packet.number):
                    return packet
                self.drop(packet)
                self.count += 1
                packet, ok_to_drop = self.dodequeue(now)
                if not ok_to_drop:
                    self.dropping = False
                else:
                    self.drop_next = self.control_law(self.drop_next, self.count)
        elif ok_to_drop and not self.must_pass(packet.number):
            self.drop(packet)
            packet, _ = self.dodequeue(now)
            self.dropping = True
            delta = self.count - self.lastcount
            self.count = 1
            if delta > 1 and now - self.drop_next < 16 * self.interval_ns:
                self.count = delta
            self.drop_next = self.control_law(now, self.count)
            self.lastcount = self.count
        return packet

    def serve_until(self, t_ns: int) -> None:
        while self.free_ns <= t_ns and self.queue:
            now = max(self.free_ns, self.queue[0].enqueued_ns)
            packet = self.dequeue(now)
            if packet:
                full_ns = packet.enqueued_ns - self.burst_ns
                self.free_ns = max(self.free_ns, full_ns) + packet.size_bytes * PER_BYTE_NS
                self.leaves_ns[packet.number] = max(self.free_ns, packet.enqueued_ns)
        if self.free_ns <= t_ns and not self.queue:
            self.dequeue(self.free_ns)


def at_most_one_mtu_ahead(mtu_bytes: int) -> Callable[[RfcCodel, Packet, int], bool]:
    """The rule of this emulator: at most one MTU was before the packet on arrival."""
    return lambda line, packet, sojourn: sojourn <= mtu_bytes * PER_BYTE_NS


def codel_departures(
    arrivals: Sequence[tuple[int, int]],
    codel: Codel,
    spare: Any,
    mansd: int | None = None,
    burst_bytes: int = 0,
) -> list[int | None]:
    """Return departures in ns, None if dropped; arrivals are (ns, bytes), ascending."""
    leaves_ns: dict[int, int | None] = {}

    def must_pass(number: int) -> bool:
        before = range(number - mansd, number) if mansd is not None else range(-1, 0)
        return all(leaves_ns.get(number, 0) is None for number in before)

    line = RfcCodel(
        round(codel.target_s * 1e9), round(codel.interval_s * 1e9), spare, must_pass,
        leaves_ns=leaves_ns, burst_ns=burst_bytes * PER_BYTE_NS, free_ns=-burst_bytes * PER_BYTE_NS,
    )  # fmt: skip
    for number, (t_ns, size_bytes) in enumerate(arrivals):
        line.serve_until(t_ns)
        line.queue.append(Packet(number, size_bytes, t_ns))
    line.serve_until(2**62)
    return [leaves_ns[number] for number in range(len(arrivals))]


def emulated_departures(
    arrivals: Sequence[tuple[int, int]], codel: Codel, mansd: int | None = None, burst_bytes: int = 0
) -> list[int | None]:
    rate = Rate(
        rate_bps=RATE_BPS,
        queue=100_000,
        burst_bytes=burst_bytes or None,
        overhead_bytes=0,
        discipline=codel,
    )
    link = Link(LinkSettings(impairments=(rate,), mansd=mansd, limit=1_000_000), 0, "a")
    releases_ns = [link.decide(0, size, t).release_ns for t, size in arrivals]
    return [None if t_ns < 0 else t_ns for t_ns in releases_ns]


@given(
    st.lists(st.tuples(st.sampled_from([0, 1, 50_000, 10**6]), st.integers(1, 1500)), max_size=150),
    st.sampled_from([0.0001, 0.001, 0.005]),
    st.sampled_from([0.0001, 0.002, 0.02]),
    st.sampled_from([None, 1, 3]),
    st.sampled_from([0, 0, 1500, 20_000]),
)
def test_codel_drops_what_the_rfc_drops_and_serves_what_must_pass(
    steps: list[tuple[int, int]], target_s: float, interval_s: float, mansd: int | None, burst_bytes: int
) -> None:
    """Packets that must pass are served, and the law drops the next packet that need not pass."""
    times = np.cumsum([gap for gap, _ in steps]).tolist()
    arrivals = [(t, size) for t, (_, size) in zip(times, steps, strict=True)]
    codel = Codel(target_s=target_s, interval_s=interval_s, mtu_bytes=100)
    assert emulated_departures(arrivals, codel, mansd, burst_bytes) == codel_departures(
        arrivals, codel, at_most_one_mtu_ahead(100), mansd, burst_bytes
    )


def test_codel_drops_copies_of_delivered_packets() -> None:
    words = "duplicate 100% rate 8mbit 0 codel target 1us interval 1us mtu 0"
    link, outcomes = Link(settings_of(words), 0, "a"), set()
    for k in range(50):
        decision = link.decide(0, 100, 10_000 * k)
        outcomes.add((decision.fate, decision.copy_ns >= 0))
    assert outcomes == {(0, True), (0, False), (4, False)}


def scheduled_departures(rate: Rate, mansd: int | None, arrivals: Any) -> tuple[list[int], list[int]]:
    """Return the departures in ns, and the consecutive losses up to each packet, one by one.

    The oldest of a flow is sent; by errors, a flow counts as the largest of what it has waiting.
    """
    scheduler, free = rate.discipline, Fraction(0)
    assert isinstance(scheduler, Scheduler)
    waiting: list[tuple[int, int]] = []
    sent_bytes = 0
    leaves_ns, losses, burst = [-1] * len(arrivals), [], Counter[int]()

    def enters(now_ns: int, size: int) -> bool:
        is_sending = int(free) > now_ns
        if rate.queue_bytes is None:
            return len(waiting) + is_sending < rate.queue
        queued = [bits(rate, arrivals[number][2]) // 8 for _, number in waiting] + [sent_bytes] * is_sending
        return sum(queued) + bits(rate, size) // 8 <= rate.queue_bytes

    def serve(now_ns: int) -> None:
        nonlocal free, sent_bytes
        while waiting and int(free) <= now_ns:
            keys = {arrivals[number][1]: key for key, number in sorted(waiting, reverse=True)}
            first = min((keys[arrivals[number][1]], number) for _, number in waiting)[1]
            waiting[:] = [entry for entry in waiting if entry[1] != first]
            arrival_ns, _, size, _ = arrivals[first]
            free = max(free, Fraction(arrival_ns)) + Fraction(bits(rate, size) * NS, rate.rate_bps)
            leaves_ns[first] = int(free)
            sent_bytes = bits(rate, size) // 8

    for number, (now_ns, flow, size, level) in enumerate(arrivals):
        serve(now_ns)
        passes = burst[flow] == mansd or enters(now_ns, size)
        burst[flow] = 0 if passes else burst[flow] + 1
        losses.append(burst[flow])
        if passes:
            key = scheduler.numbers[min(flow, len(scheduler.numbers) - 1)]
            key += now_ns if isinstance(scheduler, EarliestDeadline) else 0
            key -= level if isinstance(scheduler, MaximumError) and size >= 32 else 0
            waiting.append((key, number))
        serve(now_ns)
    serve(2**60)
    return leaves_ns, losses


WAITING = (0, 9), (1, 1), (0, 200), (2, 8), (1, 127), (2, 3), (1, 128), (0, 255)
"""Flows and error levels; some of what waits counts as what comes after it."""
ON_THE_RIGHT = (3, 0), (0, 200), (1, 1), (1, 100), (2, 50)
"""The same; what counts as what comes after it is a right child in the core's heap."""


def core_departures(settings: LinkSettings, arrivals: Any) -> tuple[list[int], list[int]]:
    """Return the same of the core: the departures in ns, and the consecutive losses."""
    link = LinkState(settings, 0, "a", rows=4)
    channel = Channel([link], flows=4)
    numbers: dict[tuple[int, int], int] = {}
    leaves_ns, losses = [-1] * len(arrivals), []
    for number, (now_ns, flow, size, level) in enumerate([*arrivals, (2**60, 0, 0, 0)]):
        while (due_ns := channel.due_ns) <= now_ns:
            for packet in channel.release(due_ns):
                leaves_ns[numbers[packet.flow, packet.number]] = due_ns
        if number < len(arrivals):
            numbers[flow, number] = number
            send(channel, flow, number, size, now_ns, level)
            losses.append(link.flow(flow).consecutive_losses)
    assert link.in_flight == 0
    assert link.counters.delivered_out_of_order == 0
    return leaves_ns, losses


@pytest.mark.parametrize("kind", [Priority, EarliestDeadline, MaximumError])
@given(
    st.sampled_from([1000, 9_600, 1_000_003, 10**9]),
    st.integers(1, 6) | st.sampled_from([1000, 3000, 6000]),
    st.lists(st.integers(0, 3), min_size=1, max_size=4).map(tuple),
    st.lists(
        st.tuples(
            st.sampled_from([0, 0, 1, 1000, MS, 100 * MS, NS]),
            st.integers(0, 3),
            st.sampled_from([0, 31, 72, 1472]),
            st.sampled_from([0, 1, 127, 128, 255]),
        ),
        max_size=60,
    ),
    st.sampled_from([None, 0, 1, 3]),
)
@example(9_600, 6, (1,), [(0, flow, 72, level) for flow, level in WAITING], None)
@example(9_600, 6, (1,), [(0, flow, 72, level) for flow, level in ON_THE_RIGHT], None)
@example(9_600, 6, (2, 0), [(0, 1, 1472, 0), (0, 0, 72, 0), (100 * MS, 1, 72, 0)], None)
@example(9_600, 2, (1,), [*((0, flow, 72, 0) for flow in (0, 1, 2, 2, 3, 3)), (100 * MS, 0, 72, 0)], 1)
def test_a_scheduler_sends_the_first_of_what_waits_when_the_link_is_free(
    kind: type[Scheduler], rate_bps: int, queue: int, numbers: Any, steps: Any, mansd: int | None
) -> None:
    """Of each flow in order of arrival; at most mansd successive packets of a flow are lost."""
    discipline: Scheduler = MaximumError()
    if kind is Priority:
        discipline = Priority(levels=numbers)
    elif kind is EarliestDeadline:
        discipline = EarliestDeadline(deadlines_s=tuple(number * 0.05 for number in numbers))
    size = {"queue": queue} if queue < 1000 else {"queue_bytes": queue}
    rate = Rate(rate_bps=rate_bps, **size, discipline=discipline)
    now = np.cumsum([0, *(gap for gap, *_ in steps)])[1:].tolist()
    arrivals = [(t, *step) for t, (_, *step) in zip(now, steps, strict=True)]
    outcome = core_departures(LinkSettings(impairments=(rate,), mansd=mansd), arrivals)
    assert outcome == scheduled_departures(rate, mansd, arrivals)
    for flow in range(4):
        of_flow = [t for t, arrival in zip(outcome[0], arrivals, strict=True) if arrival[1] == flow and t > 0]
        assert of_flow == sorted(of_flow)
    # As many wait in any order: of packets of one size, the same are lost as by tail drop.
    alike = [(t, flow, 72, level) for t, flow, _, level in arrivals]
    plain = rate.model_copy(update={"discipline": TailDrop()})
    of_both = [
        core_departures(LinkSettings(impairments=(impairment,), mansd=mansd), alike)[1]
        for impairment in (rate, plain)
    ]
    assert of_both[0] == of_both[1]


def test_a_change_makes_the_order_of_what_waits_final() -> None:
    link = LinkState(settings_of("rate 8mbit 0 queue 9 priority 3,2,1"), 0, "a", rows=3)
    channel, departures = Channel([link], flows=3), []
    for flow in (0, 0, 1):
        channel.send(flow, 0, 1000, 0)
    channel.change(settings_of("rate 4mbit 0 queue 9 priority 3,2,1 delay 10ms"))
    channel.send(2, 0, 1000, 1)
    while channel.due_ns < 2**60:
        due_ns = channel.due_ns
        departures += [(packet.flow, due_ns // MS) for packet in channel.release(due_ns)]
    assert departures == [(0, 1), (1, 2), (0, 3), (2, 15)]
