"""No losses."""

from typing import ClassVar, Literal

from netem.impairments.clauses import Clause
from netem.impairments.feature import LossModel, StageTables


class NoLoss(LossModel):
    """Nothing is lost."""

    model: Literal["lossless"] = "lossless"

    clauses: ClassVar = (Clause("none", "loss none", least=0),)

    def meaning(self) -> str:
        return "loses nothing"

    def stage(self, tables: StageTables) -> None:
        """Return None: there is no effect."""

    def tc_text(self) -> str:
        return ""
