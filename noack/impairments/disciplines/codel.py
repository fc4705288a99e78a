"""CoDel, controlled delay (RFC 8289): drops packets while the queue's delay stays above a target.

CoDel decides when a packet's service would begin. The bottleneck serves in the order of arrival, at
a deterministic rate, so that this time, and hence the packet's time in the queue, is known on
arrival. Therefore the control law is applied on arrival; it sees the same packets in the same order
with the same times. A packet that it drops keeps its place in the queue until that time. In the
RFC, an empty queue resets the law; here the next packet resets it, since it does not wait.

One rule differs. The RFC does not drop a packet if at most one MTU waits behind it when it leaves
the queue, which is not known on arrival. Here, a packet is not dropped if at most one MTU is before
it when it arrives. The rules differ at the end of a burst: the RFC does not drop its last packets,
this implementation may.

If the law drops a packet that must pass, the packet is served, and the law's state does not change:
it drops the next packet that need not pass.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, FiniteFloat

from noack.core.clock import NS_PER_S
from noack.impairments.bottleneck import BottleneckStage, enters, occupy, serve
from noack.impairments.feature import Behaviour, QueueDiscipline, Table, Word
from noack.impairments.link_records import (
    DELIVERED,
    NEVER_NS,
    OVERFLOWED,
    PacketContext,
    QueueState,
    StageMemory,
    refuse,
)
from noack.impairments.quantities import COUNT, OWN_TIME_S, time_text
from noack.impairments.word_reader import WordReader


@dataclass(slots=True, kw_only=True)
class CodelStage(BottleneckStage):
    """A bottleneck with CoDel as numbers."""

    target_ns: int
    interval_ns: int
    mtu_ns: int
    """Transmission time of one MTU."""


@dataclass(slots=True)
class CodelQueue(QueueState):
    """A queue, and the variables of RFC 8289, Section 5."""

    first_above_ns: int = 0
    drop_next_ns: int = 0
    drops: int = 0
    """``count_`` of the RFC."""
    last_drops: int = 0
    dropping: int = 0
    dropped_before: int = 0
    """1: the law dropped the previous packet; ``drop_next_ns`` has not been updated yet."""


def service_ns(queue: QueueState) -> int:
    """Return the time at which the service of a newly arrived packet would begin."""
    return max(queue.entry_ns, queue.busy_until_ns)


def control_law(stage: CodelStage, t_ns: int, drops: int) -> int:
    """Return t + interval/√count."""
    return t_ns + int(stage.interval_ns / math.sqrt(drops))


def is_due(stage: CodelStage, queue: CodelQueue) -> bool:
    """Whether the law drops the newly arrived packet."""
    now_ns = service_ns(queue)
    sojourn_ns = now_ns - queue.entry_ns
    above_long_enough = False
    if sojourn_ns < stage.target_ns or sojourn_ns <= stage.mtu_ns:
        queue.first_above_ns = 0
    elif queue.first_above_ns == 0:
        queue.first_above_ns = now_ns + stage.interval_ns
    else:
        above_long_enough = now_ns >= queue.first_above_ns
    if queue.dropped_before != 0:
        queue.dropped_before = 0
        if above_long_enough:
            queue.drop_next_ns = control_law(stage, queue.drop_next_ns, queue.drops)
    if not above_long_enough:
        queue.dropping = 0
        return False
    return queue.dropping == 0 or now_ns >= queue.drop_next_ns


def note_drop(stage: CodelStage, queue: CodelQueue) -> None:
    """Advance the law's state after a dropped packet."""
    now_ns = service_ns(queue)
    if queue.dropping != 0:
        queue.drops += 1
        queue.dropped_before = 1
        return
    recent = now_ns - queue.drop_next_ns < 16 * stage.interval_ns
    delta = queue.drops - queue.last_drops
    queue.dropping = 1
    queue.drops = delta if delta > 1 and recent else 1
    queue.last_drops = queue.drops
    queue.drop_next_ns = control_law(stage, now_ns, queue.drops)


def apply(packet: PacketContext, stage: CodelStage, memory: StageMemory) -> None:
    """Put the packet and then its copy into the queue; ignore a packet that is lost already."""
    decision = packet.decision
    if decision.fate != DELIVERED:
        return
    queue, ring_ns = packet.state.queues[stage.place], packet.state.departures_ns
    if not enters(stage, queue, ring_ns, decision.release_ns):
        refuse(decision, OVERFLOWED)
    if decision.fate == DELIVERED:
        if is_due(stage, queue):
            refuse(decision, OVERFLOWED)
        if decision.fate == DELIVERED:
            decision.release_ns = serve(stage, queue, ring_ns, decision.size_bytes)
        else:
            occupy(stage, queue, ring_ns, service_ns(queue))
            note_drop(stage, queue)
    if decision.copy_ns == NEVER_NS:
        return
    if decision.fate != DELIVERED or not enters(stage, queue, ring_ns, decision.copy_ns):
        decision.copy_ns = NEVER_NS
    elif is_due(stage, queue):
        occupy(stage, queue, ring_ns, service_ns(queue))
        note_drop(stage, queue)
        decision.copy_ns = NEVER_NS
    else:
        decision.copy_ns = serve(stage, queue, ring_ns, decision.size_bytes)


def _read(reader: WordReader) -> Table:
    table: Table = {}
    for word, key in (("target", "target_s"), ("interval", "interval_s")):
        if reader.accept(word):
            table[key] = reader.value(OWN_TIME_S)
    if reader.accept("mtu"):
        table["mtu_bytes"] = reader.value(COUNT)
    return table


_TimeS = Annotated[FiniteFloat, Field(ge=1e-6, le=3600)]
_EXAMPLE = "rate 10mbit queue 1000 codel target 5ms interval 100ms"


class Codel(QueueDiscipline):
    """Drops packets while the delay of the queue stays above a target (RFC 8289)."""

    kind: Literal["codel"] = "codel"
    target_s: _TimeS = 0.005
    """Delay that the queue may have."""
    interval_s: _TimeS = 0.1
    """The delay must be above the target for this long before the first packet is dropped."""
    mtu_bytes: Annotated[int, Field(ge=0, le=65_535)] = 1500
    """A packet with at most this number of bytes before it in the queue is not dropped."""

    words: ClassVar = (
        Word("codel", _EXAMPLE, _read, grammar="codel [target T] [interval T] [mtu BYTES]"),
        *(Word(name, _EXAMPLE, after="rate RATE codel") for name in ("target", "interval")),
        Word("mtu", f"{_EXAMPLE} mtu 1200", after="rate RATE codel"),
    )
    behaviour: ClassVar = Behaviour(CodelStage, apply, CodelQueue)
    tc_missing: ClassVar = "the discipline codel, which is a qdisc of its own"

    @property
    def prediction_note(self) -> str:
        return "as long as no queue overflows or CoDel drops"

    @classmethod
    def examples(cls) -> Sequence[Self]:
        return [cls(), cls(target_s=1e-5, interval_s=1e-4, mtu_bytes=0)]

    def text(self) -> str:
        words = f"codel target {time_text(self.target_s)} interval {time_text(self.interval_s)}"
        return words if self.mtu_bytes == 1500 else f"{words} mtu {self.mtu_bytes}"

    def meaning(self) -> str:
        return (
            "more are dropped; CoDel drops packets while the delay of the queue stays above "
            f"{time_text(self.target_s)} for {time_text(self.interval_s)} or longer"
        )

    def queue_stage(self, bottleneck: Mapping[str, int]) -> CodelStage:
        return CodelStage(
            **bottleneck,
            target_ns=round(self.target_s * NS_PER_S),
            interval_ns=round(self.interval_s * NS_PER_S),
            mtu_ns=self.mtu_bytes * 8 * NS_PER_S // bottleneck["rate_bps"],
        )
