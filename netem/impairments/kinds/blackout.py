"""Blackouts: intervals of time in which all packets are lost."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, FiniteFloat, model_validator

from netem.core.clock import NS_PER_S
from netem.core.errors import shortened
from netem.core.named_file import NamedFile
from netem.impairments.clauses import Clause, Part, file_name
from netem.impairments.feature import FileFeature, Impairment, Stage, StageTables, add_numbers
from netem.impairments.markov_chain import Chain, NotPredictableError
from netem.impairments.words import OWN_TIME_S, Quantity, time_text

MOST_INTERVALS = 1_000_000
LATEST_S = 1e9
"""Latest time of an interval: 32 years."""
_TimeS = Annotated[FiniteFloat, Field(ge=0, le=LATEST_S)]


def _read_intervals(word: str) -> list[tuple[float, float]]:
    parts = (part.partition("-") for part in word.split(","))
    return [(OWN_TIME_S.read(begin), OWN_TIME_S.read(end)) for begin, _, end in parts]


def _write_intervals(intervals_s: Sequence[tuple[float, float]]) -> str:
    return ",".join(f"{time_text(begin_s)}-{time_text(end_s)}" for begin_s, end_s in intervals_s)


_INTERVALS = Quantity("intervals of time, e.g. 2s-3s,5s-5500ms", _read_intervals, _write_intervals)


def _every(example: str) -> Part:
    return Part("every_s", OWN_TIME_S, "T", "every", example)


class Blackout(FileFeature, Impairment):
    """All packets that arrive during given intervals of time are lost."""

    kind: Literal["blackout"] = "blackout"
    intervals_s: (
        Annotated[tuple[tuple[_TimeS, _TimeS], ...], Field(min_length=1, max_length=MOST_INTERVALS)] | None
    ) = None
    """Begin and end of each, in seconds from the emulator's start (in a run: its epoch)."""
    file: Annotated[str, Field(min_length=1)] | None = None
    """Instead: a text file with begin and end of an interval on each line, e.g. 2s 3500ms."""
    every_s: Annotated[FiniteFloat, Field(ge=1e-6, le=1e9)] | None = None
    """The intervals repeat after this time."""

    clauses: ClassVar = (
        Clause(
            "blackout",
            "blackout 2s-3s",
            Part("intervals_s", _INTERVALS, "T-T[,T-T...]"),
            _every("blackout 2s-3s every 10s"),
        ),
        Clause(
            "outages",
            "outages outages.txt",
            file_name("a file of outages"),
            _every("outages outages.txt every 60s"),
        ),
    )
    tc_missing: ClassVar = "blackouts"

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.file is None) == (self.intervals_s is None):
            raise ValueError("intervals_s: a blackout needs intervals_s, or a file")
        if self.intervals_s is not None:
            _require_order(self.intervals_s, self.every_s)
        return self

    def meaning(self) -> str:
        period = "" if self.every_s is None else f", every {time_text(self.every_s)}"
        if self.intervals_s is None:
            return f"loses every packet in the intervals of {self.file}{period}"
        parts = [f"{time_text(begin)} to {time_text(end)}" for begin, end in self.intervals_s[:4]]
        ending = ", ..." if len(self.intervals_s) > 4 else ""
        return f"loses every packet from {', '.join(parts)}{ending} after the start{period}"

    def stage(self, tables: StageTables) -> Stage:
        self.require_content()
        begins_and_ends = zip(*(self.intervals_s or ()), strict=True)
        times_ns = [round(t_s * NS_PER_S) for times_s in begins_and_ends for t_s in times_s]
        begin, end = add_numbers(tables.integers, times_ns)
        period_ns = round((self.every_s or 0) * NS_PER_S)
        return Stage(self.kind, {"begin": begin, "end": end, "period_ns": period_ns})

    def chains(self) -> Sequence[Chain]:
        raise NotPredictableError("losses in a blackout depend on when packets arrive")

    def read_file(self, file: NamedFile) -> Self:
        intervals_s = []
        for number, line in file.lines():
            try:
                begin_s, end_s = map(OWN_TIME_S.read, line.split())
            except ValueError:
                excerpt = shortened(line, 40)
                file.wrong(f"line {number}: {excerpt!r}: expected begin and end with units, e.g. 2s 3500ms")
            intervals_s.append((begin_s, end_s))
            try:
                _require_order(intervals_s[-2:], self.every_s)
            except ValueError as error:
                file.wrong(f"line {number}: {str(error).partition(': ')[2]}")
        if not 1 <= len(intervals_s) <= MOST_INTERVALS:
            file.wrong(f"has {len(intervals_s)} intervals; expected 1 to {MOST_INTERVALS}")
        return self.model_copy(update={"intervals_s": tuple(intervals_s), "file": None})


def _require_order(intervals_s: Sequence[tuple[float, float]], every_s: float | None) -> None:
    """Raise ValueError if intervals overlap, are empty or out of range, or exceed the period."""
    ends = [t_s for interval in intervals_s for t_s in interval]
    if any(a >= b for a, b in pairwise(ends)):
        raise ValueError("intervals_s: each must end after it begins, and before the next")
    if not 0 <= ends[0] <= ends[-1] <= LATEST_S:
        raise ValueError(f"intervals_s: must lie between 0 and {LATEST_S:g} s")
    if every_s is not None and ends[-1] > every_s:
        raise ValueError(f"every_s: the intervals last longer, until {ends[-1]:g} s")
