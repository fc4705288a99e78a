"""At least h consecutive deliveries between two loss bursts."""

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field

from noack.impairments.feature import Constraint, Word
from noack.impairments.loss_guarantee import DeliveriesBetweenBursts
from noack.impairments.words import COUNT


class Recovery(Constraint):
    """Between two loss bursts, at least ``deliveries`` consecutive packets are delivered.

    It says nothing about the length of a burst; therefore it needs ``mansd`` or ``at_most``.
    """

    kind: Literal["recovery"] = "recovery"
    deliveries: Annotated[int, Field(ge=1, le=10_000)]
    """h: minimum number of consecutive deliveries."""

    words: ClassVar = (
        Word(
            "recover", "mansd 2 recover 3", lambda reader: {"deliveries": reader.value(COUNT)},
            grammar="recover H",
        ),
    )  # fmt: skip

    @classmethod
    def examples(cls) -> Sequence[Self]:
        return [cls(deliveries=deliveries) for deliveries in (1, 2, 3, 7)]

    @property
    def rule(self) -> DeliveriesBetweenBursts:
        return DeliveriesBetweenBursts(self.deliveries)

    @property
    def scope(self) -> str:
        return "recovery"

    def text(self) -> str:
        return f"recover {self.deliveries}"

    def meaning(self) -> str:
        return (
            f"between two loss bursts, at least {self.deliveries} consecutive packets of a flow "
            "are delivered"
        )
