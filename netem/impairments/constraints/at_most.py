"""At most m losses among any K consecutive packets: the (m, K) constraint."""

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from netem.guarantee.loss_guarantee import LossesInWindow
from netem.impairments.clauses import Clause, Part
from netem.impairments.feature import Constraint
from netem.impairments.words import COUNT


class AtMost(Constraint):
    """At most ``losses`` of any ``window`` consecutive packets of a flow are lost."""

    kind: Literal["at_most"] = "at_most"
    losses: Annotated[int, Field(ge=0, lt=10_000)]
    """m: maximum number of losses."""
    window: Annotated[int, Field(ge=1, le=10_000)]
    """K: number of consecutive packets; more than ``losses``."""

    clauses: ClassVar = (
        Clause(
            "atmost",
            "atmost 3 in 10",
            Part("losses", COUNT, "N"),
            Part("window", COUNT, "K", "in", "atmost 3 in 10"),
        ),
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.losses >= self.window:
            raise ValueError(f"losses: must be less than the window, {self.window}, else any loss is allowed")
        return self

    @property
    def rule(self) -> LossesInWindow:
        return LossesInWindow(self.losses, self.window)

    @property
    def scope(self) -> str:
        return f"maximum for {self.window} packets"

    def meaning(self) -> str:
        return f"of any {self.window} consecutive packets of a flow, at most {self.losses} are not delivered"
