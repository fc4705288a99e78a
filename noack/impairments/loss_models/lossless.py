"""No losses."""

from collections.abc import Sequence
from typing import ClassVar, Literal, Self

from noack.impairments.feature import LossModel, StageTables, Word


class NoLoss(LossModel):
    """Nothing is lost."""

    model: Literal["lossless"] = "lossless"

    words: ClassVar = (Word("none", "loss none", lambda reader: {}),)

    @classmethod
    def examples(cls) -> Sequence[Self]:
        return (cls(),)

    def text(self) -> str:
        return "none"

    def meaning(self) -> str:
        return "loses nothing"

    def stage(self, tables: StageTables) -> None:
        """Return None: there is no effect."""

    def tc_text(self) -> str:
        return ""
