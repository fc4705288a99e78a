"""Duplicates: a packet is sent twice. Each copy passes the later impairments by itself."""

from typing import ClassVar, Literal

from noack.impairments.clauses import Clause
from noack.impairments.feature import CHANCE, CorrelatedChance, Impairment
from noack.impairments.words import brief_percent
from noack.settings.section import Probability


class Duplicate(CorrelatedChance, Impairment):
    """Sends a packet twice; each copy passes the later impairments by itself."""

    kind: Literal["duplicate"] = "duplicate"
    probability: Probability
    """Probability of a copy."""

    clauses: ClassVar = (Clause("duplicate", "duplicate 1%", *CHANCE),)
    behaviour: ClassVar = "duplicate"
    action: ClassVar = "duplicate"

    def meaning(self) -> str:
        packets = brief_percent(self.probability)
        return f"sends {packets} of the packets twice, each with its own fate{self.correlation_meaning}"
