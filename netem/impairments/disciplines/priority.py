"""Priorities of flows; see native/impairments/priority.c."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from netem.impairments.clauses import Clause, Part
from netem.impairments.feature import MOST_FLOWS, Scheduler, numbers_text
from netem.impairments.words import COUNT, list_of


class Priority(Scheduler):
    """Sends first what belongs to the flow with the smallest number, in the order of arrival."""

    kind: Literal["priority"] = "priority"
    levels: Annotated[
        tuple[Annotated[int, Field(ge=0, le=1_000_000)], ...],
        Field(min_length=1, max_length=MOST_FLOWS),
    ]
    """The number of each flow, the smallest goes first; the last is that of all further flows. In a
    run: of each loop."""

    clauses: ClassVar = (
        Clause(
            "priority",
            "rate 1mbit queue 20 priority 1,2,3",
            Part("levels", list_of(COUNT, "whole numbers, e.g. 1,2,3"), "N,N,..."),
            implied={"kind": "priority"},
        ),
    )
    tc_missing: ClassVar = "the discipline priority, which is a qdisc of its own"

    @property
    def numbers(self) -> tuple[int, ...]:
        return self.levels

    def meaning(self) -> str:
        levels = numbers_text(self.levels)
        return f"more are dropped; the flow with the smallest number goes first, {levels} by flow"
