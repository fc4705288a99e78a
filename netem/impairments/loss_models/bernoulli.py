"""Bernoulli losses: each packet is lost with a probability, independently unless correlated."""

from collections.abc import Sequence
from typing import ClassVar, Literal

from netem.core.settings_section import Correlation, Probability
from netem.impairments.clauses import Clause, flag
from netem.impairments.feature import CHANCE, CorrelatedChance, Impairment, LossModel
from netem.impairments.words import brief_percent


class BernoulliLoss(CorrelatedChance, LossModel):
    """Each packet is lost with a probability; independently, unless correlated."""

    model: Literal["bernoulli"] = "bernoulli"
    probability: Probability
    """Probability of loss, before the guarantee is applied."""
    correlation: Correlation = 0.0
    """Between the latent variables of successive packets; 0 is independent loss."""
    keep: bool = False
    """true: ``probability`` is the loss rate after the guarantee and the other impairments; the
    probability of a loss is computed from it."""

    clauses: ClassVar = (
        Clause(
            "random",
            "loss 30%",
            *CHANCE,
            flag("keep", "loss 30% keep mansd 4", "keep", True),
            is_bare=True,
        ),
    )
    behaviour: ClassVar = "bernoulli"
    action: ClassVar = "lose"
    gives_score: ClassVar = True

    def meaning(self) -> str:
        correlation = self.correlation_meaning or ", each independently"
        if self.keep:
            return (
                f"loses packets{self.correlation_meaning}, with the probability for which "
                f"{brief_percent(self.probability)} are lost after the guarantee"
            )
        return f"loses {brief_percent(self.probability)} of the packets{correlation}"

    def tc_lacks(self, earlier: Sequence[Impairment]) -> str:
        return "a loss rate that is kept" if self.keep else ""

    def tc_text(self) -> str:
        return f"random {self.model_copy(update={'keep': False}).text()}"
