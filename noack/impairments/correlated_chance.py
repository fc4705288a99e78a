"""Random events with a given probability and a correlation between successive packets.

The latent variable z_i = ρ z_{i−1} + √(1 − ρ²) g_i is a stationary Gaussian process. The event
happens to packet i if z_i exceeds the normal quantile of 1 − p, hence with probability p exactly,
for every ρ.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from noack.impairments.feature import Feature, StageTables
from noack.impairments.link_records import RuleStage, StageMemory
from noack.impairments.normal import score
from noack.impairments.quantities import CORRELATION, PERCENT, brief_percent, percent_text
from noack.impairments.word_reader import WordReader
from noack.settings.section import Correlation, Probability


@dataclass(slots=True, kw_only=True)
class ChanceStage(RuleStage):
    """A probability and a correlation, as numbers."""

    probability: float
    threshold: float
    """z with 1 − Φ(z) = probability; infinite if that is 0 or 1."""
    correlation: float
    innovation: float
    """√(1 − correlation²)."""
    gap: int = 1
    """Only every ``gap``-th packet can be affected."""
    scored: int = 0
    """1: a later delay is correlated with this event."""


class Chance(Protocol):
    """Settings with a probability and a correlation."""

    @property
    def probability(self) -> float:
        """Probability."""

    @property
    def correlation(self) -> float:
        """Between the latent variables of successive packets."""


def latent(correlation: float, innovation: float, memory: StageMemory, u: float) -> float:
    """Advance a latent process by one packet and return z, standard normal.

    Args:
        correlation: ρ.
        innovation: √(1 − ρ²).
        memory: the stage's memory of the flow.
        u: a uniform number.
    """
    z = -score(u)
    if correlation != 0.0:
        if memory.phase != 0:
            z = correlation * memory.score + innovation * z
        memory.phase = 1
        memory.score = z
    return z


def happens(stage: ChanceStage, memory: StageMemory, u: float) -> bool:
    """Whether the event happens to the next packet; ``u`` is a uniform number."""
    if stage.correlation == 0.0:
        return u < stage.probability
    return latent(stage.correlation, stage.innovation, memory, u) > stage.threshold


def chance_stage(chance: Chance, *, gap: int = 1, scored: bool = False) -> ChanceStage:
    """Return a probability and a correlation as numbers."""
    p, correlation = chance.probability, chance.correlation
    return ChanceStage(
        probability=p,
        threshold=-score(p) if 0 < p < 1 else math.copysign(math.inf, 0.5 - p),
        correlation=correlation,
        innovation=math.sqrt(1 - correlation**2),
        gap=gap,
        scored=int(scored),
    )


def read_chance(reader: WordReader) -> dict[str, float]:
    """Read ``PERCENT [CORRELATION]``."""
    table = {"probability": reader.value(PERCENT)}
    if reader.number_follows():
        table["correlation"] = reader.value(CORRELATION)
    return table


def chance_text(chance: Chance) -> str:
    """Return the words that :func:`read_chance` reads."""
    correlation = f" {percent_text(chance.correlation)}" if chance.correlation else ""
    return percent_text(chance.probability) + correlation


def correlation_meaning(correlation: float) -> str:
    """Return the explanation of a correlation."""
    return f", correlation {brief_percent(correlation)}" if correlation else ""


TC_CORRELATION = "its correlation changes the probability, or the spread, of what it is given"
"""What ``tc netem`` does differently."""


class CorrelatedChance(Feature):
    """Settings of a feature that draws a correlated random event for each packet."""

    probability: Probability
    """Probability of the event."""
    correlation: Correlation = 0.0
    """Between successive packets."""

    def stage(self, tables: StageTables) -> ChanceStage:
        """Return the probability and the correlation as numbers."""
        return chance_stage(self)

    def tc_notes(self) -> Sequence[str]:
        """Return the difference that a correlation makes to ``tc netem``."""
        return (TC_CORRELATION,) if self.correlation else ()
