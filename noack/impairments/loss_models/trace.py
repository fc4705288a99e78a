"""Losses from a text file."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from noack.impairments.feature import LossModel, StageTables, Table, Word
from noack.impairments.loss_models.scripted import MAX_SCRIPT, ScriptedLoss
from noack.impairments.markov_chain import NotPredictableError, Pattern
from noack.impairments.words import WordReader
from noack.settings.user_files import NamedFile

_SPACES = b" \t\r\n\v\f"


def _read(reader: WordReader) -> Table:
    return {"file": reader.file("a file of zeros and ones"), "repeat": not reader.accept("once")}


class TraceLoss(LossModel):
    """Losses from a text file: 1 for a lost packet, 0 for a delivered packet."""

    model: Literal["trace"] = "trace"
    file: Annotated[str, Field(min_length=1)]
    """The file; it contains only 0, 1 and white space."""
    repeat: bool = True
    """true: repeat the trace; false: deliver all packets after its end."""

    words: ClassVar = (
        Word("trace", "loss trace FILE", _read, grammar="trace FILE [once]"),
        Word("once", "loss trace FILE once", after="loss trace FILE"),
    )
    tc_missing: ClassVar = "losses by the packets' numbers"

    @classmethod
    def examples(cls) -> Sequence[Self]:
        return [cls(file="trace.txt"), cls(file="a trace.txt", repeat=False)]

    def text(self) -> str:
        return f"trace {shlex.quote(self.file)}{'' if self.repeat else ' once'}"

    def meaning(self) -> str:
        return f"loses the packets that {self.file} marks with a 1{'' if self.repeat else ', once'}"

    def stage(self, tables: StageTables) -> None:
        raise ValueError(f"{self.file}: the trace has not been read")

    def chains(self) -> Sequence[Pattern]:
        raise NotPredictableError(f"{self.file} has not been read")

    def without_files(self, folder: Path, place: str) -> ScriptedLoss:
        file = NamedFile(self.file, folder, place)
        marks = np.frombuffer(file.content().translate(None, _SPACES), np.uint8)
        wrong = np.flatnonzero((marks != ord("0")) & (marks != ord("1")))
        if wrong.size:
            file.wrong(f"has a {chr(marks[wrong[0]])!r}; a trace is of 0 and 1, and white space")
        if not marks.size:
            file.wrong("is empty; a trace has a 1 for each lost packet and a 0 for each other")
        lost = np.flatnonzero(marks == ord("1"))
        if lost.size > MAX_SCRIPT:
            file.wrong(f"loses {lost.size} packets; at most {MAX_SCRIPT} can be")
        repeat_every = marks.size if self.repeat else 0
        return ScriptedLoss(lost=tuple(lost.tolist()), repeat_every=repeat_every)
