"""Bursty and isolated losses: a Markov chain of four states (Salsano, Ludovici & Ordine).

It starts in state 1 and advances before each packet. From state 4 it returns to 1.
"""

from collections.abc import Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import model_validator

from netem.core.settings_section import Probability
from netem.impairments.clauses import Clause, Part
from netem.impairments.feature import LossModel, Stage, StageTables
from netem.impairments.markov_chain import Chain
from netem.impairments.words import PERCENT, brief_percent, percent_text

_NAMES = ("p13", "p31", "p32", "p23", "p14")


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

    clauses: ClassVar = (
        Clause(
            "state",
            "loss state 1% 10%",
            *tuple(Part(name, PERCENT, name.upper()) for name in _NAMES),
            complement=True,
        ),
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.p31 + self.p32 > 1:
            raise ValueError("p31: p31 + p32 must not exceed 1")
        if self.p13 + self.p14 > 1:
            raise ValueError("p13: p13 + p14 must not exceed 1")
        return self

    def meaning(self) -> str:
        return (
            "loses by a Markov chain of four states: bursts begin with probability "
            f"{brief_percent(self.p13)} and end with {brief_percent(self.p31)}; within a burst, "
            f"delivery begins with {brief_percent(self.p32)} and ends with "
            f"{brief_percent(self.p23)}; single losses occur with {brief_percent(self.p14)}"
        )

    def stage(self, tables: StageTables) -> Stage:
        return Stage(self.model, self.model_dump(include=set(_NAMES)))

    def chains(self) -> Sequence[Chain]:
        transitions = np.array(
            [
                [1 - self.p13 - self.p14, 0.0, self.p13, self.p14],
                [0.0, 1 - self.p23, self.p23, 0.0],
                [self.p31, self.p32, 1 - self.p31 - self.p32, 0.0],
                [1.0, 0.0, 0.0, 0.0],
            ]
        )
        return (Chain(np.eye(4)[0], np.maximum(transitions, 0.0), np.array([0.0, 0.0, 1.0, 1.0])),)

    def tc_text(self) -> str:
        return f"state {' '.join(percent_text(getattr(self, name)) for name in _NAMES)}"
