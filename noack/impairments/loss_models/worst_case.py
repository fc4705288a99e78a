"""The worst case: as many losses as the cap allows."""

from collections.abc import Sequence
from typing import ClassVar, Literal

import numpy as np

from noack.impairments.feature import Behaviour, LossModel, StageTables, Word
from noack.impairments.link_records import DROPPED, PacketContext, RuleStage, StageMemory, refuse
from noack.impairments.markov_chain import Pattern


def apply(packet: PacketContext, stage: RuleStage, memory: StageMemory) -> None:
    """Lose the packet."""
    refuse(packet.decision, DROPPED)


class WorstCaseLoss(LossModel):
    """Every packet is lost, except those that the MANSD cap delivers."""

    model: Literal["worst_case"] = "worst_case"

    words: ClassVar = (Word("worst", "loss worst mansd 4", lambda reader: {}, grammar="worst"),)
    behaviour: ClassVar = Behaviour(RuleStage, apply)
    tc_missing: ClassVar = "a worst case"

    def text(self) -> str:
        return "worst"

    def meaning(self) -> str:
        return "loses every packet that the cap allows to be lost"

    def stage(self, tables: StageTables) -> RuleStage:
        return RuleStage()

    def chains(self) -> Sequence[Pattern]:
        return (Pattern(np.ones(1, bool)),)
