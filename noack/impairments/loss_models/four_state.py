"""Bursty and isolated losses: a Markov chain of four states (Salsano, Ludovici & Ordine).

It starts in state 1 and advances before each packet. From state 4 it returns to 1.
"""

from collections.abc import Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import model_validator

from noack.impairments.feature import LossModel, Stage, StageTables, Table, Word
from noack.impairments.markov_chain import Chain
from noack.impairments.words import PERCENT, WordReader, brief_percent, percent_text, percents_text
from noack.settings.section import Probability


def _read(reader: WordReader) -> Table:
    """Read the transitions; p13 alone makes independent losses, as in tc."""
    p13 = reader.value(PERCENT)
    table: Table = {"p13": p13, "p31": 1 - p13}
    for key in ("p31", "p32", "p23", "p14"):
        if not reader.number_follows():
            break
        table[key] = reader.value(PERCENT)
    return table


class FourStateLoss(LossModel):
    """Markov loss with four states (Salsano et al., GI model; ``loss state`` of tc).

    State 1: gap, delivered. 2: delivered within a burst. 3: lost within a burst. 4: a single loss
    within a gap.
    """

    model: Literal["four_state"] = "four_state"
    p13: Probability
    """Probability of a transition from a gap into a burst."""
    p31: Probability
    """Probability of a transition from a burst back to a gap."""
    p32: Probability = 0.0
    """Probability of a transition from lost to delivered within a burst."""
    p23: Probability = 1.0
    """Probability of a transition from delivered to lost within a burst."""
    p14: Probability = 0.0
    """Probability of a single loss within a gap."""

    words: ClassVar = (
        Word("state", "loss state 1% 10%", _read, grammar="state P13 [P31 [P32 [P23 [P14]]]]"),
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.p31 + self.p32 > 1:
            raise ValueError("p31: p31 + p32 must not exceed 1")
        if self.p13 + self.p14 > 1:
            raise ValueError("p13: p13 + p14 must not exceed 1")
        return self

    @property
    def _shares(self) -> tuple[float, ...]:
        return (self.p13, self.p31, self.p32, self.p23, self.p14)

    @classmethod
    def examples(cls) -> Sequence[Self]:
        return [cls(p13=0.3, p31=0.4, p32=0.2, p23=0.7, p14=0.1), cls(p13=0.1, p31=0.3)]

    def text(self) -> str:
        return f"state {percents_text(self._shares, (None, None, 0.0, 1.0, 0.0))}"

    def meaning(self) -> str:
        return (
            "loses by a Markov chain of four states: bursts begin with probability "
            f"{brief_percent(self.p13)} and end with {brief_percent(self.p31)}; within a burst, "
            f"delivery begins with {brief_percent(self.p32)} and ends with "
            f"{brief_percent(self.p23)}; single losses occur with {brief_percent(self.p14)}"
        )

    def stage(self, tables: StageTables) -> Stage:
        names = ("p13", "p31", "p32", "p23", "p14")
        return Stage(self.model, dict(zip(names, self._shares, strict=True)))

    def chains(self) -> Sequence[Chain]:
        moves = np.array([
            [1 - self.p13 - self.p14, 0.0, self.p13, self.p14],
            [0.0, 1 - self.p23, self.p23, 0.0],
            [self.p31, self.p32, 1 - self.p31 - self.p32, 0.0],
            [1.0, 0.0, 0.0, 0.0],
        ])  # fmt: skip
        return (Chain(np.eye(4)[0], np.maximum(moves, 0.0), np.array([0.0, 0.0, 1.0, 1.0])),)

    def tc_text(self) -> str:
        return f"state {' '.join(map(percent_text, self._shares))}"
