"""Duplicates: a packet is sent twice."""

from typing import ClassVar, Literal

from noack.impairments.feature import CorrelatedChance, Impairment, Word, read_chance
from noack.impairments.words import brief_percent
from noack.settings.section import Probability


class Duplicate(CorrelatedChance, Impairment):
    """Sends a packet twice."""

    kind: Literal["duplicate"] = "duplicate"
    probability: Probability
    """Probability of a copy."""

    words: ClassVar = (
        Word("duplicate", "duplicate 1%", read_chance, grammar="duplicate P [CORR]"),
    )
    behaviour: ClassVar = "duplicate"
    action: ClassVar = "duplicate"
    copies: ClassVar = True

    def text(self) -> str:
        return f"duplicate {self.chance_text}"

    def meaning(self) -> str:
        how = self.correlation_meaning
        return f"sends {brief_percent(self.probability)} of the packets twice{how}"
