"""Tail drop: a packet that finds the queue full is lost."""

from collections.abc import Mapping
from typing import ClassVar, Literal

from noack.impairments.bottleneck import BottleneckStage, enters, serve
from noack.impairments.feature import Behaviour, QueueDiscipline
from noack.impairments.link_records import (
    DELIVERED,
    NEVER_NS,
    OVERFLOWED,
    PacketContext,
    StageMemory,
    refuse,
)


def apply(packet: PacketContext, stage: BottleneckStage, memory: StageMemory) -> None:
    """Put the packet and then its copy into the queue; ignore a packet that is lost already."""
    decision = packet.decision
    if decision.fate != DELIVERED:
        return
    queue, ring_ns = packet.state.queues[stage.place], packet.state.departures_ns
    if not enters(stage, queue, ring_ns, decision.release_ns):
        refuse(decision, OVERFLOWED)
    if decision.fate == DELIVERED:
        decision.release_ns = serve(stage, queue, ring_ns, decision.size_bytes)
    if decision.copy_ns != NEVER_NS:
        if decision.fate == DELIVERED and enters(stage, queue, ring_ns, decision.copy_ns):
            decision.copy_ns = serve(stage, queue, ring_ns, decision.size_bytes)
        else:
            decision.copy_ns = NEVER_NS


class TailDrop(QueueDiscipline):
    """A packet that finds the queue full is lost."""

    kind: Literal["tail_drop"] = "tail_drop"

    behaviour: ClassVar = Behaviour(BottleneckStage, apply)

    def text(self) -> str:
        return ""

    def meaning(self) -> str:
        return "more are dropped"

    def queue_stage(self, bottleneck: Mapping[str, int]) -> BottleneckStage:
        return BottleneckStage(**bottleneck)
