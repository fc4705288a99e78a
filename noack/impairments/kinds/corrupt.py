"""Corruption: one bit of the payload is flipped."""

from typing import ClassVar, Literal

from noack.impairments.correlated_chance import ChanceStage, CorrelatedChance, happens, read_chance
from noack.impairments.feature import Behaviour, Impairment, Word
from noack.impairments.link_records import NEVER_NS, PacketContext, StageMemory
from noack.impairments.philox import draw
from noack.impairments.quantities import brief_percent
from noack.settings.section import Probability


def apply(packet: PacketContext, stage: ChanceStage, memory: StageMemory) -> None:
    """Draw whether a bit of the packet, and of its copy, is flipped; not of an empty payload."""
    decision = packet.decision
    u, v = draw(packet, stage, 0)
    corrupts = happens(stage, memory, u)
    bits = decision.size_bytes * 8
    if bits == 0:
        return
    if decision.must_pass != 0:
        if corrupts:
            decision.spared = 1
        return
    if corrupts:
        decision.bit = int(v * bits)
    if decision.copy_ns != NEVER_NS:
        u, v = draw(packet, stage, 1)
        if u < stage.probability:
            decision.copy_bit = int(v * bits)


class Corrupt(CorrelatedChance, Impairment):
    """Flips one bit of the payload, at random."""

    kind: Literal["corrupt"] = "corrupt"
    probability: Probability
    """Probability of a flipped bit."""

    words: ClassVar = (Word("corrupt", "corrupt 1%", read_chance, grammar="corrupt P [CORR]"),)
    behaviour: ClassVar = Behaviour(ChanceStage, apply)
    action: ClassVar = "corrupt"
    flips_bits: ClassVar = True

    def text(self) -> str:
        return f"corrupt {self.chance_text}"

    def meaning(self) -> str:
        how = self.correlation_meaning
        return f"flips one bit in {brief_percent(self.probability)} of the packets{how}"
