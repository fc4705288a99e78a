"""Reordering: a packet leaves at once instead of being delayed."""

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from netem.core.settings_section import Probability
from netem.impairments.clauses import Clause, Part
from netem.impairments.feature import CHANCE, CorrelatedChance, Impairment, PacketOrder, Stage, StageTables
from netem.impairments.words import COUNT, brief_percent


class Reorder(CorrelatedChance, Impairment):
    """Lets a packet leave at once, before packets that arrived earlier and are delayed.

    As in tc: after a packet that left at once, ``gap`` − 1 are delayed, and then each is a candidate
    until a draw succeeds. With probability P the share of packets that leave at once is
    1/(``gap`` − 1 + 1/P), whatever the correlation between the draws.
    """

    kind: Literal["reorder"] = "reorder"
    probability: Probability = 1.0
    """Probability of reordering, for each candidate."""
    gap: Annotated[int, Field(ge=1, le=2**40)] = 1
    """After a packet that left at once, ``gap`` − 1 packets are no candidates."""

    clauses: ClassVar = (
        Clause(
            "reorder",
            "delay 10ms reorder 5%",
            *CHANCE,
            Part("gap", COUNT, "N", "gap", "delay 10ms reorder 5% gap 5"),
        ),
        Clause("gap", "delay 10ms gap 5", Part("gap", COUNT, "N")),
    )
    behaviour: ClassVar = "reorder"

    def order_after(self, before: PacketOrder) -> PacketOrder:
        reorders = before.delayed and self.probability > 0
        return before._replace(reordered=before.reordered or reorders)

    def meaning(self) -> str:
        chance, correlation = brief_percent(self.probability), self.correlation_meaning
        packets = f"{chance} of the packets" if self.gap == 1 else f"every {self.gap}th packet"
        if self.gap == 1 or self.probability == 1:
            return f"sends {packets} at once, before those that are delayed{correlation}"
        share = 1 / (self.gap - 1 + 1 / self.probability) if self.probability else 0.0
        return (
            f"sends {brief_percent(share)} of the packets at once, before those that are delayed: "
            f"after one of them {self.gap - 1} are delayed, then each leaves at once with "
            f"probability {chance}{correlation}, until one does"
        )

    def stage(self, tables: StageTables) -> Stage:
        stage = super().stage(tables)
        return stage._replace(numbers={**stage.numbers, "gap": self.gap})

    def tc_lacks(self, earlier: Sequence[Impairment]) -> str:
        delayed = any(getattr(impairment, "delay_s", 0) for impairment in earlier)
        return "" if delayed else "reordering without a delay before it"
