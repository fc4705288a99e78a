"""Losses given by a list of packet numbers within a flow."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from netem.impairments.clauses import Clause, Part
from netem.impairments.feature import LossModel, Stage, StageTables, add_numbers
from netem.impairments.markov_chain import NotPredictableError, PeriodicLosses, pattern
from netem.impairments.words import COUNT, Quantity, list_of

MAX_SCRIPT = 10_000_000
_NUMBERS = list_of(COUNT, "the numbers of the lost packets, counted from 0, e.g. 3,4,17; or none")
_LOST = Quantity(
    _NUMBERS.expected,
    lambda word: [] if word == "none" else _NUMBERS.read(word),
    lambda lost: _NUMBERS.text(lost) or "none",
)


class ScriptedLoss(LossModel):
    """Exactly the listed packets of each flow are lost, counted from 0."""

    model: Literal["scripted"] = "scripted"
    lost: Annotated[tuple[Annotated[int, Field(ge=0, lt=2**40)], ...], Field(max_length=MAX_SCRIPT)]
    """Numbers of the lost packets."""
    repeat_every: Annotated[int, Field(ge=0, le=2**40)] = 0
    """The script repeats after this number of packets; 0: it does not repeat."""

    clauses: ClassVar = (
        Clause(
            "script",
            "loss script 3,4,17",
            Part("lost", _LOST, "N,N,..."),
            Part("repeat_every", COUNT, "N", "every", "loss script 3,4 every 20"),
        ),
    )
    tc_missing: ClassVar = "losses by the packets' numbers"

    @model_validator(mode="after")
    def _check(self) -> Self:
        if any(a >= b for a, b in pairwise(self.lost)):
            raise ValueError("lost: the numbers must ascend")
        if self.repeat_every and self.lost and self.lost[-1] >= self.repeat_every:
            raise ValueError(f"repeat_every: the script is longer, up to {self.lost[-1]}")
        return self

    def meaning(self) -> str:
        numbers = ", ".join(map(str, self.lost[:8])) + (", ..." if len(self.lost) > 8 else "")
        repetition = f", and again every {self.repeat_every}" if self.repeat_every else ""
        return f"loses the packets {numbers or '(none)'} of each flow{repetition}"

    def stage(self, tables: StageTables) -> Stage:
        begin, end = add_numbers(tables.integers, self.lost)
        return Stage(self.model, {"period": self.repeat_every, "begin": begin, "end": end})

    def chains(self) -> Sequence[PeriodicLosses]:
        if not self.repeat_every:
            raise NotPredictableError(
                "a script that is played once loses the same packets however long a flow is"
            )
        return (pattern(self.repeat_every, self.lost),)
