"""Random events with a given probability and a correlation between successive packets.

The latent variable z_i = ρ z_{i−1} + √(1 − ρ²) g_i is a stationary Gaussian process. The event
happens to packet i if z_i exceeds the normal quantile of 1 − p, hence with probability p exactly,
for every ρ.
"""

import math
from collections.abc import Sequence
from typing import ClassVar, Self

from noack.core.core_library import core
from noack.impairments.feature import Stage, StageFeature, StageTables
from noack.impairments.markov_chain import Chain, chance_chain
from noack.impairments.quantities import CORRELATION, PERCENT, brief_percent, percent_text
from noack.impairments.word_reader import WordReader
from noack.settings.section import Correlation, Probability


def read_chance(reader: WordReader) -> dict[str, float]:
    """Read ``PERCENT [CORRELATION]``."""
    table = {"probability": reader.value(PERCENT)}
    if reader.number_follows():
        table["correlation"] = reader.value(CORRELATION)
    return table


TC_CORRELATION = "its correlation changes the probability, or the spread, of what it is given"
"""What ``tc netem`` does differently."""


class CorrelatedChance(StageFeature):
    """Settings of a feature that draws a correlated random event for each packet."""

    probability: Probability
    """Probability of the event."""
    correlation: Correlation = 0.0
    """Between successive packets."""

    behaviour: ClassVar[str]
    """See :class:`noack.impairments.feature.Stage`."""
    action: ClassVar[str] = ""
    """Its action as a Markov chain; see :class:`Chain`; empty: it does not change the loss rate."""

    @classmethod
    def examples(cls) -> Sequence[Self]:
        chances = ((0.0, 0.0), (0.1, 0.0), (0.5, 0.7), (0.9, 0.0), (1.0, 0.0))
        return [cls(probability=p, correlation=correlation) for p, correlation in chances]

    @property
    def chance_text(self) -> str:
        """The words that :func:`read_chance` reads."""
        correlation = f" {percent_text(self.correlation)}" if self.correlation else ""
        return percent_text(self.probability) + correlation

    @property
    def correlation_meaning(self) -> str:
        """The explanation of the correlation."""
        return f", correlation {brief_percent(self.correlation)}" if self.correlation else ""

    def stage(self, tables: StageTables) -> Stage:
        p = self.probability
        certain = math.copysign(math.inf, 0.5 - p)
        numbers = {
            "probability": p,
            "threshold": -core.noack_normal_score(p) if 0 < p < 1 else certain,
            "correlation": self.correlation,
            "innovation": math.sqrt(1 - self.correlation**2),
            "gap": 1,
            "scored": int(tables.scored),
        }
        return Stage(self.behaviour, numbers, "chance")

    def chains(self) -> Sequence[Chain]:
        if not self.action:
            return ()
        return (chance_chain(self.probability, self.correlation, self.action),)

    def tc_notes(self) -> Sequence[str]:
        return (TC_CORRELATION,) if self.correlation else ()
