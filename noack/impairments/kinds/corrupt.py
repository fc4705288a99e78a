"""Corruption: one bit of the payload is flipped."""

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
    NEVER_NS,
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
    """Draw whether a bit of the packet, and of its copy, is flipped; not of an empty payload."""
    u, v = uniforms(stage.key0, stage.key1, flow.number, decision.packet, 0)
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
        u, v = uniforms(stage.key0, stage.key1, flow.number, decision.packet, 1)
        if u < stage.probability:
            decision.copy_bit = int(v * bits)


class Corrupt(CorrelatedChance, Impairment):
    """Flips one bit of the payload, at random."""

    kind: Literal["corrupt"] = "corrupt"
    probability: Probability
    """Probability of a flipped bit."""

    words: ClassVar = (Word("corrupt", "corrupt 1%", read_chance),)
    behaviour: ClassVar = Behaviour(ChanceStage, apply)
    flips_bits: ClassVar = True

    @classmethod
    def examples(cls) -> Sequence[Self]:
        chances = ((0.0, 0.0), (0.2, 0.7), (0.8, 0.0), (1.0, 0.0))
        return [cls(probability=p, correlation=rho) for p, rho in chances]

    def text(self) -> str:
        return f"corrupt {chance_text(self)}"

    def meaning(self) -> str:
        how = correlation_meaning(self.correlation)
        return f"flips one bit in {brief_percent(self.probability)} of the packets{how}"

    def chains(self) -> Sequence[Chain]:
        chain = chance_chain(self.probability, self.correlation)
        return (chain._replace(what="corrupt", probability=self.probability),)
