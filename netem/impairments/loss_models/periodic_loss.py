"""Periodic losses, according to the packet's number in its flow."""

import re
from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from netem.impairments.clauses import Clause, Part
from netem.impairments.feature import LossModel, Stage, StageTables
from netem.impairments.markov_chain import LONGEST_PATTERN, PeriodicLosses, pattern
from netem.impairments.words import COUNT, Quantity


def _read_share(word: str) -> list[int]:
    if re.fullmatch("[0-9]+/[0-9]+", word) is None:
        raise ValueError
    return list(map(int, word.split("/")))


_SHARE = Quantity("losses per packets, e.g. 2/100", _read_share, lambda numbers: "/".join(map(str, numbers)))


class PeriodicLoss(LossModel):
    """Of every ``period`` packets of a flow, ``burst`` consecutive ones are lost."""

    model: Literal["periodic"] = "periodic"
    period: Annotated[int, Field(ge=1, le=2**40)]
    """Packets in a period."""
    burst: Annotated[int, Field(ge=0, le=2**40)] = 1
    """Losses in a period."""
    first: Annotated[int, Field(ge=0, le=2**40)] = 0
    """Number of the first packet that is lost."""

    clauses: ClassVar = (
        Clause(
            "periodic",
            "loss periodic 2/100",
            Part("burst period", _SHARE, "B/N"),
            Part("first", COUNT, "K", "from", "loss periodic 2/100 from 3"),
        ),
    )
    tc_missing: ClassVar = "losses by the packets' numbers"

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.burst > self.period:
            raise ValueError(f"burst: must not exceed the period, {self.period}")
        return self

    def meaning(self) -> str:
        first = f", from number {self.first} on" if self.first else ""
        return f"loses {self.burst} consecutive packets of every {self.period} of a flow{first}"

    def stage(self, tables: StageTables) -> Stage:
        return Stage(self.model, self.model_dump(exclude={"model"}))

    def chains(self) -> Sequence[PeriodicLosses]:
        lost = range(self.first, self.first + min(self.burst, LONGEST_PATTERN))
        begin = self.first if lost.stop > self.period else 0
        return (pattern(self.period, (number % self.period for number in lost), begin),)
