"""Corruption: one bit of the payload is flipped."""

from typing import ClassVar, Literal

from noack.impairments.clauses import Clause
from noack.impairments.feature import CHANCE, CorrelatedChance, Impairment
from noack.impairments.words import brief_percent
from noack.settings.section import Probability


class Corrupt(CorrelatedChance, Impairment):
    """Flips one bit of the payload, at random."""

    kind: Literal["corrupt"] = "corrupt"
    probability: Probability
    """Probability of a flipped bit."""

    clauses: ClassVar = (Clause("corrupt", "corrupt 1%", *CHANCE),)
    behaviour: ClassVar = "corrupt"
    action: ClassVar = "corrupt"
    flips_bits: ClassVar = True

    def meaning(self) -> str:
        correlation = self.correlation_meaning
        return f"flips one bit in {brief_percent(self.probability)} of the packets{correlation}"
