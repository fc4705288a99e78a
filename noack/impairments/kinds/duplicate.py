"""Duplicates: a packet is sent twice."""

from typing import ClassVar, Literal

from noack.impairments.correlated_chance import ChanceStage, CorrelatedChance, happens, read_chance
from noack.impairments.feature import Behaviour, Impairment, Word
from noack.impairments.link_records import PacketContext, StageMemory
from noack.impairments.philox import draw
from noack.impairments.quantities import brief_percent
from noack.settings.section import Probability


def apply(packet: PacketContext, stage: ChanceStage, memory: StageMemory) -> None:
    """Draw whether the packet is duplicated."""
    decision = packet.decision
    u, _ = draw(packet, stage, 0)
    if happens(stage, memory, u):
        decision.copy_ns = decision.release_ns
        decision.copy_bit = decision.bit


class Duplicate(CorrelatedChance, Impairment):
    """Sends a packet twice."""

    kind: Literal["duplicate"] = "duplicate"
    probability: Probability
    """Probability of a copy."""

    words: ClassVar = (
        Word("duplicate", "duplicate 1%", read_chance, grammar="duplicate P [CORR]"),
    )
    behaviour: ClassVar = Behaviour(ChanceStage, apply)
    action: ClassVar = "duplicate"
    copies: ClassVar = True

    def text(self) -> str:
        return f"duplicate {self.chance_text}"

    def meaning(self) -> str:
        how = self.correlation_meaning
        return f"sends {brief_percent(self.probability)} of the packets twice{how}"
