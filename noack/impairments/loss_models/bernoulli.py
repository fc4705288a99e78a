"""Bernoulli losses: each packet is lost with a probability, independently unless correlated."""

from typing import ClassVar, Literal

from noack.impairments.correlated_chance import ChanceStage, CorrelatedChance, happens, read_chance
from noack.impairments.feature import Behaviour, LossModel, Word
from noack.impairments.link_records import DROPPED, PacketContext, StageMemory, refuse
from noack.impairments.normal import score
from noack.impairments.philox import draw
from noack.impairments.quantities import brief_percent
from noack.settings.section import Correlation, Probability


def apply(packet: PacketContext, stage: ChanceStage, memory: StageMemory) -> None:
    """Draw whether the packet is lost; set the score if a delay is correlated with loss."""
    u, _ = draw(packet, stage, 0)
    if happens(stage, memory, u):
        refuse(packet.decision, DROPPED)
    if stage.scored != 0:
        packet.flow.score = -score(u) if stage.correlation == 0.0 else memory.score


class BernoulliLoss(CorrelatedChance, LossModel):
    """Each packet is lost with a probability; independently, unless correlated."""

    model: Literal["bernoulli"] = "bernoulli"
    probability: Probability
    """Probability of loss, before the MANSD cap."""
    correlation: Correlation = 0.0
    """Between the latent variables of successive packets; 0 is independent loss."""

    words: ClassVar = (Word("random", "loss 30%", read_chance, grammar="P [CORR]"),)
    behaviour: ClassVar = Behaviour(ChanceStage, apply)
    action: ClassVar = "lose"
    gives_score: ClassVar = True

    def text(self) -> str:
        return self.chance_text

    def meaning(self) -> str:
        how = self.correlation_meaning or ", each independently"
        return f"loses {brief_percent(self.probability)} of the packets{how}"

    def tc_text(self) -> str:
        return f"random {self.chance_text}"
