"""Earliest deadline first; see native/impairments/earliest_deadline.c."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field, FiniteFloat

from netem.core.clock import NS_PER_S
from netem.impairments.clauses import Clause, Part
from netem.impairments.feature import MOST_FLOWS, Scheduler, numbers_text
from netem.impairments.words import OWN_TIME_S, list_of, time_text


class EarliestDeadline(Scheduler):
    """Sends first what has the earliest deadline: its arrival plus a time of its flow."""

    kind: Literal["earliest_deadline"] = "earliest_deadline"
    deadlines_s: Annotated[
        tuple[Annotated[FiniteFloat, Field(ge=0, le=3600)], ...],
        Field(min_length=1, max_length=MOST_FLOWS),
    ]
    """The time of each flow from arrival to deadline; the last is that of all further flows. In a
    run: of each loop. What misses its deadline is sent all the same."""

    clauses: ClassVar = (
        Clause(
            "earliest_deadline",
            "rate 1mbit queue 20 earliest_deadline 10ms,50ms",
            Part("deadlines_s", list_of(OWN_TIME_S, "times in s, ms, us or ns, e.g. 10ms,50ms"), "T,T,..."),
            implied={"kind": "earliest_deadline"},
        ),
    )
    tc_missing: ClassVar = "the discipline earliest_deadline"

    @property
    def numbers(self) -> tuple[int, ...]:
        return tuple(round(deadline_s * NS_PER_S) for deadline_s in self.deadlines_s)

    def meaning(self) -> str:
        times = numbers_text([time_text(deadline_s) for deadline_s in self.deadlines_s])
        return f"more are dropped; it sends first what has the earliest deadline, {times} by flow"
