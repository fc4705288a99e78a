"""Duplicates: a packet is sent twice."""

from collections.abc import Sequence
from typing import ClassVar, Literal, Self

from noack.impairments.correlated_chance import (
    ChanceStage,
    CorrelatedChance,
    chance_text,
    correlation_meaning,
    happens,
    read_chance,
)
from noack.impairments.feature import Behaviour, Impairment, Word
from noack.impairments.link_records import (
    FlowState,
    LinkMemory,
    LinkProgram,
    PacketDecision,
    StageMemory,
)
from noack.impairments.markov_chain import Chain, chance_chain
from noack.impairments.philox import uniforms
from noack.impairments.quantities import brief_percent
from noack.settings.section import Probability


def apply(
    program: LinkProgram,
    state: LinkMemory,
    stage: ChanceStage,
    memory: StageMemory,
    flow: FlowState,
    decision: PacketDecision,
) -> None:
    """Draw whether the packet is duplicated."""
    u, _ = uniforms(stage.key0, stage.key1, flow.number, decision.packet, 0)
    if happens(stage, memory, u):
        decision.copy_ns = decision.release_ns
        decision.copy_bit = decision.bit


class Duplicate(CorrelatedChance, Impairment):
    """Sends a packet twice."""

    kind: Literal["duplicate"] = "duplicate"
    probability: Probability
    """Probability of a copy."""

    words: ClassVar = (Word("duplicate", "duplicate 1%", read_chance),)
    behaviour: ClassVar = Behaviour(ChanceStage, apply)

    @classmethod
    def examples(cls) -> Sequence[Self]:
        chances = ((0.0, 0.0), (0.5, 0.7), (0.9, 0.0), (1.0, 0.0))
        return [cls(probability=p, correlation=rho) for p, rho in chances]

    def text(self) -> str:
        return f"duplicate {chance_text(self)}"

    def meaning(self) -> str:
        how = correlation_meaning(self.correlation)
        return f"sends {brief_percent(self.probability)} of the packets twice{how}"

    def chains(self) -> Sequence[Chain]:
        chain = chance_chain(self.probability, self.correlation)
        return (chain._replace(what="duplicate", probability=self.probability),)
