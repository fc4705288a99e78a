"""Bernoulli losses: each packet is lost with a probability, independently unless correlated."""

from collections.abc import Sequence
from typing import Any, ClassVar, Literal, Self

from noack.impairments.feature import CorrelatedChance, Impairment, LossModel, Word, read_chance
from noack.impairments.words import WordReader, brief_percent
from noack.settings.section import Correlation, Probability


def _read(reader: WordReader) -> dict[str, Any]:
    table: dict[str, Any] = {**read_chance(reader)}
    if reader.accept("keep"):
        table["keep"] = True
    return table


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

    words: ClassVar = (
        Word("random", "loss 30%", _read, grammar="P [CORR] [keep]"),
        Word("keep", "loss 30% keep mansd 4", after="loss P"),
    )
    behaviour: ClassVar = "bernoulli"
    action: ClassVar = "lose"
    gives_score: ClassVar = True

    @classmethod
    def examples(cls) -> Sequence[Self]:
        return [*super().examples(), cls(probability=0.1, keep=True)]

    def text(self) -> str:
        return self.chance_text + (" keep" if self.keep else "")

    def meaning(self) -> str:
        how = self.correlation_meaning or ", each independently"
        if self.keep:
            return (
                f"loses packets{self.correlation_meaning}, with the probability for which "
                f"{brief_percent(self.probability)} are lost after the guarantee"
            )
        return f"loses {brief_percent(self.probability)} of the packets{how}"

    def tc_lacks(self, before: Sequence[Impairment]) -> str:
        return "a loss rate that is kept" if self.keep else ""

    def tc_text(self) -> str:
        return f"random {self.chance_text}"
