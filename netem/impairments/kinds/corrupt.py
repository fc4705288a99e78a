"""Corruption: one bit of the payload is flipped."""

from typing import ClassVar, Literal

from netem.core.settings_section import Probability
from netem.impairments.clauses import Clause
from netem.impairments.feature import CHANCE, CorrelatedChance, Impairment
from netem.impairments.words import brief_percent


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
