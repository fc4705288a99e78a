"""Reordering: a packet leaves at once instead of being delayed."""

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field

from noack.impairments.feature import (
    CorrelatedChance,
    Impairment,
    Stage,
    StageTables,
    Table,
    Word,
    read_chance,
)
from noack.impairments.words import COUNT, WordReader, brief_percent
from noack.settings.section import Probability


def _read(reader: WordReader) -> Table:
    table: Table = {**read_chance(reader)}
    if reader.accept("gap"):
        table["gap"] = reader.value(COUNT)
    return table


class Reorder(CorrelatedChance, Impairment):
    """Lets a packet leave at once, before packets that arrived earlier and are delayed."""

    kind: Literal["reorder"] = "reorder"
    probability: Probability = 1.0
    """Probability of reordering, for every ``gap``-th packet."""
    gap: Annotated[int, Field(ge=1, le=2**40)] = 1
    """Only every ``gap``-th packet can be reordered."""

    words: ClassVar = (
        Word("reorder", "delay 10ms reorder 5%", _read, grammar="reorder P [CORR] [gap N]"),
        Word(
            "gap", "delay 10ms gap 5", lambda reader: {"gap": reader.value(COUNT)}, grammar="gap N"
        ),
    )

    behaviour: ClassVar = "reorder"

    @classmethod
    def examples(cls) -> Sequence[Self]:
        chances = ((0.0, 1), (0.5, 1), (0.9, 2), (1.0, 4))
        alone = [cls(probability=p, gap=gap) for p, gap in chances]
        return [*alone, cls(probability=0.5, correlation=0.7, gap=3)]

    def reorders(self, delayed: bool, reordered: bool) -> tuple[bool, bool]:
        return delayed, reordered or (delayed and self.probability > 0)

    def delay_range_s(self, least_s: float, largest_s: float) -> tuple[float, float]:
        return 0.0, largest_s

    def text(self) -> str:
        gap = f" gap {self.gap}" if self.gap != 1 else ""
        return f"reorder {self.chance_text}{gap}"

    def meaning(self) -> str:
        which = f"{brief_percent(self.probability)} of the packets"
        if self.gap != 1:
            which = f"every {self.gap}th packet"
            if self.probability < 1:
                which += f", with probability {brief_percent(self.probability)},"
        how = self.correlation_meaning
        return f"sends {which} at once, before those that are delayed{how}"

    def stage(self, tables: StageTables) -> Stage:
        stage = super().stage(tables)
        return stage._replace(numbers={**stage.numbers, "gap": self.gap})

    def tc_lacks(self, before: Sequence[Impairment]) -> str:
        delayed = any(getattr(impairment, "delay_s", 0) for impairment in before)
        return "" if delayed else "reordering without a delay before it"
