"""Duplicates: a packet is sent twice."""

from typing import ClassVar, Literal

from noack.impairments.clauses import Clause
from noack.impairments.feature import CHANCE, CorrelatedChance, Impairment
from noack.impairments.words import brief_percent
from noack.settings.section import Probability


class Duplicate(CorrelatedChance, Impairment):
    """Sends a packet twice."""

    kind: Literal["duplicate"] = "duplicate"
    probability: Probability
    """Probability of a copy."""

    clauses: ClassVar = (Clause("duplicate", "duplicate 1%", *CHANCE),)
    behaviour: ClassVar = "duplicate"
    action: ClassVar = "duplicate"

    def meaning(self) -> str:
        correlation = self.correlation_meaning
        return f"sends {brief_percent(self.probability)} of the packets twice{correlation}"
