"""At least h consecutive deliveries between two loss bursts."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from netem.guarantee.loss_guarantee import DeliveriesBetweenBursts
from netem.impairments.clauses import Clause, Part
from netem.impairments.feature import Constraint
from netem.impairments.words import COUNT


class Recovery(Constraint):
    """Between two loss bursts, at least ``deliveries`` consecutive packets are delivered.

    It says nothing about the length of a burst; therefore it needs ``mansd`` or ``at_most``.
    """

    kind: Literal["recovery"] = "recovery"
    deliveries: Annotated[int, Field(ge=1, le=10_000)]
    """h: minimum number of consecutive deliveries."""

    clauses: ClassVar = (Clause("recover", "mansd 2 recover 3", Part("deliveries", COUNT, "H")),)

    @property
    def rule(self) -> DeliveriesBetweenBursts:
        return DeliveriesBetweenBursts(self.deliveries)

    @property
    def scope(self) -> str:
        return "recovery"

    def meaning(self) -> str:
        return (
            f"between two loss bursts, at least {self.deliveries} consecutive packets of a flow are delivered"
        )
