"""The worst case: as many losses as the cap allows."""

from collections.abc import Sequence
from typing import ClassVar, Literal, Self

import numpy as np

from noack.impairments.feature import Behaviour, Impairment, LossModel, StageTables, Word
from noack.impairments.link_records import (
    DROPPED,
    FlowState,
    LinkMemory,
    LinkProgram,
    PacketDecision,
    RuleStage,
    StageMemory,
    refuse,
)
from noack.impairments.markov_chain import Pattern


def apply(
    program: LinkProgram,
    state: LinkMemory,
    stage: RuleStage,
    memory: StageMemory,
    flow: FlowState,
    decision: PacketDecision,
) -> None:
    """Lose the packet."""
    refuse(decision, DROPPED)


class WorstCaseLoss(LossModel):
    """Every packet is lost, except those that the MANSD cap delivers."""

    model: Literal["worst_case"] = "worst_case"

    words: ClassVar = (Word("worst", "loss worst mansd 4", lambda reader: {}),)
    behaviour: ClassVar = Behaviour(RuleStage, apply)

    @classmethod
    def examples(cls) -> Sequence[Self]:
        return (cls(),)

    def text(self) -> str:
        return "worst"

    def meaning(self) -> str:
        return "loses every packet that the cap allows to be lost"

    def stage(self, tables: StageTables) -> RuleStage:
        return RuleStage()

    def chains(self) -> Sequence[Pattern]:
        return (Pattern(np.ones(1, bool)),)

    def tc_lacks(self, before: Sequence[Impairment]) -> str:
        return "a worst case"
