"""At most m losses among any K consecutive packets: the (m, K) constraint."""

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from noack.impairments.feature import Constraint, Table, Word
from noack.impairments.loss_guarantee import LossesInWindow
from noack.impairments.words import COUNT, WordReader


def _read(reader: WordReader) -> Table:
    losses = reader.value(COUNT)
    if not reader.accept("in"):
        reader.wrong(f"the number of packets is missing, e.g. atmost {losses} in 10")
    return {"losses": losses, "window": reader.value(COUNT)}


class AtMost(Constraint):
    """At most ``losses`` of any ``window`` consecutive packets of a flow are lost."""

    kind: Literal["at_most"] = "at_most"
    losses: Annotated[int, Field(ge=0, lt=10_000)]
    """m: maximum number of losses."""
    window: Annotated[int, Field(ge=1, le=10_000)]
    """K: number of consecutive packets; more than ``losses``."""

    words: ClassVar = (
        Word("atmost", "atmost 3 in 10", _read, grammar="atmost M in K"),
        Word("in", "atmost 3 in 10", after="atmost M"),
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.losses >= self.window:
            raise ValueError(
                f"losses: must be less than the window, {self.window}, else any loss is allowed"
            )
        return self

    @classmethod
    def examples(cls) -> Sequence[Self]:
        pairs = ((0, 1), (1, 2), (1, 3), (2, 5), (3, 10), (5, 7))
        return [cls(losses=losses, window=window) for losses, window in pairs]

    @property
    def rule(self) -> LossesInWindow:
        return LossesInWindow(self.losses, self.window)

    @property
    def scope(self) -> str:
        return f"maximum for {self.window} packets"

    def text(self) -> str:
        return f"atmost {self.losses} in {self.window}"

    def meaning(self) -> str:
        return (
            f"of any {self.window} consecutive packets of a flow, at most {self.losses} are not "
            "delivered"
        )
