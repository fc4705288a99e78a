"""Bernoulli losses: each packet is lost with a probability, independently unless correlated."""

from collections.abc import Sequence
from typing import ClassVar, Literal, Self

from noack.impairments.correlated_chance import (
    ChanceStage,
    CorrelatedChance,
    chance_stage,
    chance_text,
    correlation_meaning,
    happens,
    read_chance,
)
from noack.impairments.feature import Behaviour, LossModel, StageTables, Word
from noack.impairments.link_records import (
    DROPPED,
    FlowState,
    LinkMemory,
    LinkProgram,
    PacketDecision,
    StageMemory,
    refuse,
)
from noack.impairments.markov_chain import Chain, chance_chain
from noack.impairments.normal import score
from noack.impairments.philox import uniforms
from noack.impairments.quantities import brief_percent
from noack.settings.section import Correlation, Probability


def apply(
    program: LinkProgram,
    state: LinkMemory,
    stage: ChanceStage,
    memory: StageMemory,
    flow: FlowState,
    decision: PacketDecision,
) -> None:
    """Draw whether the packet is lost; set the score if a delay is correlated with loss."""
    u, _ = uniforms(stage.key0, stage.key1, flow.number, decision.packet, 0)
    if happens(stage, memory, u):
        refuse(decision, DROPPED)
    if stage.scored != 0:
        flow.score = -score(u) if stage.correlation == 0.0 else memory.score


class BernoulliLoss(CorrelatedChance, LossModel):
    """Each packet is lost with a probability; independently, unless correlated."""

    model: Literal["bernoulli"] = "bernoulli"
    probability: Probability
    """Probability of loss, before the MANSD cap."""
    correlation: Correlation = 0.0
    """Between the latent variables of successive packets; 0 is independent loss."""

    words: ClassVar = (Word("random", "loss 30%", read_chance),)
    behaviour: ClassVar = Behaviour(ChanceStage, apply)
    gives_score: ClassVar = True

    @classmethod
    def examples(cls) -> Sequence[Self]:
        chances = ((0.0, 0.0), (0.1, 0.0), (0.5, 0.7), (0.9, 0.0), (1.0, 0.0))
        return [cls(probability=p, correlation=rho) for p, rho in chances]

    def text(self) -> str:
        return chance_text(self)

    def meaning(self) -> str:
        how = correlation_meaning(self.correlation) or ", each independently"
        return f"loses {brief_percent(self.probability)} of the packets{how}"

    def stage(self, tables: StageTables) -> ChanceStage:
        return chance_stage(self, scored=tables.scored)

    def chains(self) -> Sequence[Chain]:
        return (chance_chain(self.probability, self.correlation),)

    def tc_text(self) -> str:
        return f"random {chance_text(self)}"
