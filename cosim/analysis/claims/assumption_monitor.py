"""Watches over the conditions of a run's claims while it goes on.

It reports what :mod:`cosim.analysis.claims.claim_evaluation` reports after the run, from the same
limits and with the same :class:`~cosim.analysis.claims.condition_reader.ConditionReader`, as soon
as the rows that show it are in.
"""

import math
from collections.abc import Collection

import numpy as np

from cosim.analysis.claims.condition_reader import ConditionReader
from cosim.analysis.claims.observed_conditions import (
    CAUSES,
    AssumptionViolation,
    Left,
    ObservedConditions,
    earliest,
)
from cosim.record.run_record import Rows
from noack.config.scenario import Scenario
from noack.theory.run_conditions import allowed_conditions

_MOST_WAITING = 100_000
"""Minutes of rows that wait for a process that says nothing: then nobody should keep them."""


class AssumptionMonitor:
    """Says when a run leaves the conditions of its claims, once for each way of leaving them.

    Args:
        scenario: the resolved scenario.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._observer = ConditionReader(scenario)
        self._conditions = allowed_conditions(scenario)
        self._causes = causes_of(scenario)
        self._run = 0
        self._found: dict[str, AssumptionViolation] = {}
        self._until_s = math.inf
        self.blind: str | None = None
        """Why it can say no more; None as long as it can."""

    def take(self, table: str, rows: Rows) -> None:
        """Take rows that follow those of the table that were taken before."""
        if self.blind is None:
            self._observer.take(table, rows)

    def give_up(self, why: str) -> None:
        """Say no more: rows are missing, which cannot be told from what did not happen."""
        self.blind = self.blind or why

    def end_at(self, t_s: float) -> None:
        """Say no more of what happens from a time on, when settings are changed.

        What is then claimed depends on where the run is; it is judged after the run.
        """
        self._until_s = min(self._until_s, t_s)

    def advance(self) -> list[AssumptionViolation]:
        """In which respects the run has now left the conditions for the first time."""
        if self.blind is not None:
            return []
        found = self._judge(self._observer.observed())
        if self.waiting > _MOST_WAITING:
            self.give_up("a process has not been heard of for too long")
        return found

    def end(self) -> list[AssumptionViolation]:
        """The same, of what was still waiting for rows; no more come."""
        return [] if self.blind is not None else self._judge(self._observer.end())

    @property
    def left(self) -> Left:
        """When and how the run first left the conditions, so far as known."""
        return earliest(self._found.values())

    @property
    def waiting(self) -> int:
        """How many things wait for rows that are still to come."""
        return self._observer.waiting

    @np.errstate(all="ignore")  # a run may diverge
    def _judge(self, seen: ObservedConditions) -> list[AssumptionViolation]:
        new = []
        for one in seen.departures(self._conditions, self._causes, self._run):
            if one.t_s >= self._until_s:
                continue
            before = self._found.get(one.cause)
            if before is None:
                new.append(one)
            self._found[one.cause] = (before or one)._replace(
                worst=max(one.worst, before.worst) if before else one.worst
            )
        runs = seen.losses.runs(self._conditions.delay_s, self._run).value
        self._run = int(runs[-1]) if len(runs) else self._run
        return new


def causes_of(scenario: Scenario) -> Collection[str]:
    """In which respects leaving the conditions makes claims about a resolved scenario void.

    What is certified is so of the paper's trigger; what follows from (I1) needs the measurements
    only; and of the acknowledgement baseline nothing is claimed.
    """
    if scenario.is_acknowledged:
        return ()
    return tuple(CAUSES) if scenario.coverage.is_certifiable else ("sampling",)
