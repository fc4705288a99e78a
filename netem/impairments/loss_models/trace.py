"""Losses from a text file."""

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from netem.core.named_file import NamedFile
from netem.impairments.clauses import Clause, file_name, flag
from netem.impairments.feature import FileFeature, LossModel, StageTables
from netem.impairments.loss_models.scripted import MAX_SCRIPT, ScriptedLoss
from netem.impairments.markov_chain import NotPredictableError, PeriodicLosses

_SPACES = b" \t\r\n\v\f"


class TraceLoss(FileFeature, LossModel):
    """Losses from a text file: 1 for a lost packet, 0 for a delivered packet."""

    model: Literal["trace"] = "trace"
    file: Annotated[str, Field(min_length=1)]
    """The file; it contains only 0, 1 and white space."""
    repeat: bool = True
    """true: repeat the trace; false: deliver all packets after its end."""

    clauses: ClassVar = (
        Clause(
            "trace",
            "loss trace FILE",
            file_name("a file of zeros and ones"),
            flag("once", "loss trace FILE once", "repeat", False),
        ),
    )
    tc_missing: ClassVar = "losses by the packets' numbers"

    def meaning(self) -> str:
        return f"loses the packets that {self.file} marks with a 1{'' if self.repeat else ', once'}"

    def stage(self, tables: StageTables) -> None:
        self.require_content()

    def chains(self) -> Sequence[PeriodicLosses]:
        self.require_content(NotPredictableError)
        return ()

    def read_file(self, file: NamedFile) -> ScriptedLoss:
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
