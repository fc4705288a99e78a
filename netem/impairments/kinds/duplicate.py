"""Duplicates: a packet is sent twice. Each copy passes the later impairments by itself."""

from typing import ClassVar, Literal

from netem.core.settings_section import Probability
from netem.impairments.clauses import Clause
from netem.impairments.feature import CHANCE, CorrelatedChance, Impairment
from netem.impairments.words import brief_percent


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
