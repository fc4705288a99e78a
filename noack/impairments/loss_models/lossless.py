"""No losses."""

from typing import ClassVar, Literal

from noack.impairments.feature import LossModel, StageTables, Word


class NoLoss(LossModel):
    """Nothing is lost."""

    model: Literal["lossless"] = "lossless"

    words: ClassVar = (Word("none", "loss none", lambda reader: {}, grammar="none"),)

    def text(self) -> str:
        return "none"

    def meaning(self) -> str:
        return "loses nothing"

    def stage(self, tables: StageTables) -> None:
        """Return None: there is no effect."""

    def tc_text(self) -> str:
        return ""
