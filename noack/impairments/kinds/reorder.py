"""Reordering: a packet leaves at once instead of being delayed."""

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from noack.impairments.clauses import Clause, Part
from noack.impairments.feature import CHANCE, CorrelatedChance, Impairment, PacketOrder, Stage, StageTables
from noack.impairments.words import COUNT, brief_percent
from noack.settings.section import Probability


class Reorder(CorrelatedChance, Impairment):
    """Lets a packet leave at once, before packets that arrived earlier and are delayed."""

    kind: Literal["reorder"] = "reorder"
    probability: Probability = 1.0
    """Probability of reordering, for every ``gap``-th packet."""
    gap: Annotated[int, Field(ge=1, le=2**40)] = 1
    """Only every ``gap``-th packet can be reordered."""

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
        packets = f"{brief_percent(self.probability)} of the packets"
        if self.gap != 1:
            packets = f"every {self.gap}th packet"
            if self.probability < 1:
                packets += f", with probability {brief_percent(self.probability)},"
        correlation = self.correlation_meaning
        return f"sends {packets} at once, before those that are delayed{correlation}"

    def stage(self, tables: StageTables) -> Stage:
        stage = super().stage(tables)
        return stage._replace(numbers={**stage.numbers, "gap": self.gap})

    def tc_lacks(self, earlier: Sequence[Impairment]) -> str:
        delayed = any(getattr(impairment, "delay_s", 0) for impairment in earlier)
        return "" if delayed else "reordering without a delay before it"
