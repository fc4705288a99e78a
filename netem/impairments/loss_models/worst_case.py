"""The worst case: as many losses as the cap allows."""

from collections.abc import Sequence
from typing import ClassVar, Literal

import numpy as np

from netem.impairments.clauses import Clause
from netem.impairments.feature import LossModel, Stage, StageTables
from netem.impairments.markov_chain import PeriodicLosses


class WorstCaseLoss(LossModel):
    """Every packet is lost, except those that the MANSD cap delivers."""

    model: Literal["worst_case"] = "worst_case"

    clauses: ClassVar = (Clause("worst", "loss worst mansd 4", least=0),)
    tc_missing: ClassVar = "a worst case"

    def meaning(self) -> str:
        return "loses every packet that the cap allows to be lost"

    def stage(self, tables: StageTables) -> Stage:
        return Stage(self.model, {})

    def chains(self) -> Sequence[PeriodicLosses]:
        return (PeriodicLosses(np.ones(1, bool)),)
