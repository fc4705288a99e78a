"""Compare CoDel with the pseudocode of RFC 8289, Section 5, on an event-driven queue."""

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from netem.tc_words import settings_of
from noack.impairments.disciplines.codel import Codel
from noack.impairments.kinds.rate import Rate
from noack.impairments.link_settings import LinkSettings
from tests.oracles.link import Link

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
class Reference:
    """A line with CoDel: names and control flow of the RFC; ``spare`` replaces the MTU rule."""

    target_ns: int
    interval_ns: int
    spare: Callable[["Reference", Packet, int], bool]
    must_pass: Callable[[int], bool]
    queue: deque[Packet] = field(default_factory=deque)
    free_ns: int = 0
    first_above: int = 0
    drop_next: int = 0
    count: int = 0
    lastcount: int = 0
    dropping: bool = False
    leaves_ns: dict[int, int | None] = field(default_factory=dict)

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
                self.free_ns = now + packet.size_bytes * PER_BYTE_NS
                self.leaves_ns[packet.number] = self.free_ns
        if self.free_ns <= t_ns and not self.queue:
            self.dequeue(self.free_ns)


def ahead(mtu_bytes: int) -> Callable[[Reference, Packet, int], bool]:
    """The rule of this emulator: at most one MTU was before the packet on arrival."""
    return lambda line, packet, sojourn: sojourn <= mtu_bytes * PER_BYTE_NS


def behind(mtu_bytes: int) -> Callable[[Reference, Packet, int], bool]:
    """The rule of the RFC: at most one MTU waits when the packet leaves the queue."""
    return lambda line, _packet, _sojourn: sum(p.size_bytes for p in line.queue) <= mtu_bytes


def reference(
    arrivals: Sequence[tuple[int, int]], codel: Codel, spare: Any, mansd: int | None = None
) -> list[int | None]:
    """Return departures in ns, None if dropped; arrivals are (ns, bytes), ascending."""
    leaves_ns: dict[int, int | None] = {}

    def must_pass(number: int) -> bool:
        before = range(number - mansd, number) if mansd is not None else range(-1, 0)
        return all(leaves_ns.get(one, 0) is None for one in before)

    line = Reference(
        round(codel.target_s * 1e9), round(codel.interval_s * 1e9), spare, must_pass,
        leaves_ns=leaves_ns,
    )  # fmt: skip
    for number, (t_ns, size_bytes) in enumerate(arrivals):
        line.serve_until(t_ns)
        line.queue.append(Packet(number, size_bytes, t_ns))
    line.serve_until(2**62)
    return [leaves_ns[number] for number in range(len(arrivals))]


def emulated(
    arrivals: Sequence[tuple[int, int]], codel: Codel, mansd: int | None = None
) -> list[int | None]:
    rate = Rate(rate_bps=RATE_BPS, queue=100_000, overhead_bytes=0, discipline=codel)
    link = Link(LinkSettings(impairments=(rate,), mansd=mansd, limit=1_000_000), 0, "a")
    found = [link.decide(0, size, t).release_ns for t, size in arrivals]
    return [None if t_ns < 0 else t_ns for t_ns in found]


@given(
    st.lists(st.tuples(st.sampled_from([0, 1, 50_000, 10**6]), st.integers(1, 1500)), max_size=150),
    st.sampled_from([0.0001, 0.001, 0.005]),
    st.sampled_from([0.0001, 0.002, 0.02]),
    st.sampled_from([None, 1, 3]),
)
def test_any_arrivals_and_any_cap(
    steps: list[tuple[int, int]], target_s: float, interval_s: float, mansd: int | None
) -> None:
    """Packets that must pass are served, and the law drops the next packet that need not pass."""
    times = np.cumsum([gap for gap, _ in steps]).tolist()
    arrivals = [(t, size) for t, (_, size) in zip(times, steps, strict=True)]
    codel = Codel(target_s=target_s, interval_s=interval_s, mtu_bytes=100)
    assert emulated(arrivals, codel, mansd) == reference(arrivals, codel, ahead(100), mansd)


def test_random_arrivals_with_pauses() -> None:
    """Packets of 100 to 1500 bytes that overload the line."""
    rng, count, codel = np.random.default_rng(2), 6000, Codel()
    sizes = rng.integers(100, 1501, count)
    gaps = rng.exponential(800 * PER_BYTE_NS / 1.1, count)
    gaps[rng.integers(0, count, 16)] += 300 * MS
    arrivals = list(zip(np.cumsum(gaps).astype(int).tolist(), sizes.tolist(), strict=True))
    expected = reference(arrivals, codel, ahead(1500))
    assert emulated(arrivals, codel) == expected
    assert expected.count(None) > 20


def test_under_a_standing_queue_the_mtu_rule_is_that_of_the_rfc() -> None:
    """Until the burst ends; the RFC's rule does not drop the last packets of a burst."""
    arrivals, codel = [(k * 500_000, 1000) for k in range(4000)], Codel()
    found, of_rfc = emulated(arrivals, codel), reference(arrivals, codel, behind(1500))
    last = max(k for k in range(4000) if (of_rfc[k] or 0) <= arrivals[-1][0])
    assert found[: last + 1] == of_rfc[: last + 1]
    assert of_rfc[-1] is not None


def test_the_law_drops_copies_of_delivered_packets() -> None:
    words = "duplicate 100% rate 8mbit 0 codel target 1us interval 1us mtu 0"
    link, found = Link(settings_of(words), 0, "a"), set()
    for k in range(50):
        decision = link.decide(0, 100, 10_000 * k)
        found.add((decision.fate, decision.copy_ns >= 0))
    assert found == {(0, True), (0, False), (4, False)}
