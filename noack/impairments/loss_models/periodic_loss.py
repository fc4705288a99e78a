"""Periodic losses, according to the packet's number in its flow."""

import re
from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from noack.impairments.feature import LossModel, Stage, StageTables, Table, Word
from noack.impairments.markov_chain import LONGEST_PATTERN, Pattern, pattern
from noack.impairments.words import COUNT, WordReader

_EXPECTED = "losses per packets, e.g. 2/100"


def _read(reader: WordReader) -> Table:
    match = re.fullmatch("([0-9]+)/([0-9]+)", reader.word(_EXPECTED))
    if match is None:
        reader.wrong(f"expected {_EXPECTED}")
    burst, period = (reader.read(part, COUNT) for part in match.groups())
    table: Table = {"burst": burst, "period": period}
    if reader.accept("from"):
        table["first"] = reader.value(COUNT)
    return table


class PeriodicLoss(LossModel):
    """Of every ``period`` packets of a flow, ``burst`` consecutive ones are lost."""

    model: Literal["periodic"] = "periodic"
    period: Annotated[int, Field(ge=1, le=2**40)]
    """Packets in a period."""
    burst: Annotated[int, Field(ge=0, le=2**40)] = 1
    """Losses in a period."""
    first: Annotated[int, Field(ge=0, le=2**40)] = 0
    """Number of the first packet that is lost."""

    words: ClassVar = (
        Word(
            "periodic", "loss periodic 2/100", _read,
            grammar="periodic B/N [from K]  (B consecutive datagrams of every N, from number K on)",
        ),
        Word("from", "loss periodic 2/100 from 3", after="loss periodic BURST/PERIOD"),
    )  # fmt: skip
    tc_missing: ClassVar = "losses by the packets' numbers"

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.burst > self.period:
            raise ValueError(f"burst: must not exceed the period, {self.period}")
        return self

    @classmethod
    def examples(cls) -> Sequence[Self]:
        numbers = ((3, 1, 0), (9, 3, 5), (4, 0, 0), (2, 2, 7))
        return [cls(period=period, burst=burst, first=first) for period, burst, first in numbers]

    def text(self) -> str:
        first = f" from {self.first}" if self.first else ""
        return f"periodic {self.burst}/{self.period}{first}"

    def meaning(self) -> str:
        first = f", from number {self.first} on" if self.first else ""
        return f"loses {self.burst} consecutive packets of every {self.period} of a flow{first}"

    def stage(self, tables: StageTables) -> Stage:
        numbers = {"period": self.period, "burst": self.burst, "first": self.first}
        return Stage(self.model, numbers)

    def chains(self) -> Sequence[Pattern]:
        lost = range(self.first, self.first + min(self.burst, LONGEST_PATTERN))
        return (pattern(self.period, (number % self.period for number in lost)),)
