"""Blackouts: intervals of time in which all packets are lost."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, FiniteFloat, model_validator

from noack.core.clock import NS_PER_S
from noack.impairments.feature import Behaviour, Impairment, StageTables, Table, Word, add_numbers
from noack.impairments.link_records import (
    BLACKED_OUT,
    PacketContext,
    RuleStage,
    StageMemory,
    refuse,
)
from noack.impairments.markov_chain import Chain, NotPredictableError
from noack.impairments.quantities import OWN_TIME_S, TIME, time_text
from noack.impairments.word_reader import WordReader

_EXPECTED = "intervals of time, e.g. 2s-3s,5s-5500ms"
_TimeS = Annotated[FiniteFloat, Field(ge=0, le=1e9)]


@dataclass(slots=True, kw_only=True)
class BlackoutStage(RuleStage):
    """Intervals in the program's table of integers: begin, end, begin, end, …, ascending."""

    begin: int
    end: int
    period_ns: int
    """0: the intervals do not repeat."""


def apply(packet: PacketContext, stage: BlackoutStage, memory: StageMemory) -> None:
    """Lose the packet if it arrives during an interval."""
    decision = packet.decision
    times_ns, now_ns = packet.program.integers, decision.arrival_ns
    if stage.period_ns > 0 and now_ns >= 0:
        now_ns %= stage.period_ns
    for place in range(stage.begin, stage.end, 2):
        if now_ns < times_ns[place]:
            return
        if now_ns < times_ns[place + 1]:
            refuse(decision, BLACKED_OUT)
            return


def _read(reader: WordReader) -> Table:
    intervals: list[tuple[float, ...]] = []
    for part in reader.word(_EXPECTED).split(","):
        found = re.fullmatch(f"({TIME})-({TIME})", part)
        if found is None:
            reader.wrong(f"expected {_EXPECTED}")
        intervals.append(tuple(reader.read(time, OWN_TIME_S) for time in found.groups()))
    table: Table = {"intervals_s": intervals}
    if reader.accept("every"):
        table["every_s"] = reader.value(OWN_TIME_S)
    return table


class Blackout(Impairment):
    """All packets that arrive during given intervals of time are lost."""

    kind: Literal["blackout"] = "blackout"
    intervals_s: Annotated[tuple[tuple[_TimeS, _TimeS], ...], Field(min_length=1)]
    """Begin and end of each, in seconds from the emulator's start (in a run: its epoch)."""
    every_s: Annotated[FiniteFloat, Field(ge=1e-6, le=1e9)] | None = None
    """The intervals repeat after this time."""

    words: ClassVar = (
        Word("blackout", "blackout 2s-3s", _read, grammar="blackout T-T[,T-T...] [every T]"),
        Word("every", "blackout 2s-3s every 10s", after="blackout BEGIN-END"),
    )
    behaviour: ClassVar = Behaviour(BlackoutStage, apply)
    tc_missing: ClassVar = "blackouts"

    @model_validator(mode="after")
    def _check(self) -> Self:
        ends = [t_s for interval in self.intervals_s for t_s in interval]
        if any(a >= b for a, b in pairwise(ends)):
            raise ValueError("intervals_s: each must end after it begins, and before the next")
        if self.every_s is not None and ends[-1] > self.every_s:
            raise ValueError(f"every_s: the intervals last longer, until {ends[-1]:g} s")
        return self

    @classmethod
    def examples(cls) -> Sequence[Self]:
        return [cls(intervals_s=((0.0, 0.01), (0.02, 0.03)), every_s=0.05),
                cls(intervals_s=((0.001, 0.02),))]  # fmt: skip

    def text(self) -> str:
        parts = (f"{time_text(a)}-{time_text(b)}" for a, b in self.intervals_s)
        every = "" if self.every_s is None else f" every {time_text(self.every_s)}"
        return f"blackout {','.join(parts)}{every}"

    def meaning(self) -> str:
        parts = [f"{time_text(begin)} to {time_text(end)}" for begin, end in self.intervals_s[:4]]
        more = ", ..." if len(self.intervals_s) > 4 else ""
        every = "" if self.every_s is None else f", every {time_text(self.every_s)}"
        return f"loses every packet from {', '.join(parts)}{more} after the start{every}"

    def stage(self, tables: StageTables) -> BlackoutStage:
        times_ns = [round(t_s * NS_PER_S) for interval in self.intervals_s for t_s in interval]
        begin, end = add_numbers(tables.integers, times_ns)
        return BlackoutStage(begin=begin, end=end, period_ns=round((self.every_s or 0) * NS_PER_S))

    def chains(self) -> Sequence[Chain]:
        raise NotPredictableError("losses in a blackout depend on when packets arrive")
