"""Checks the assumptions of a run's claims during the run.

It reports the same violations as :class:`cosim.analysis.claims.claim_evaluation.ClaimEvaluation`,
which runs after the run, from the same limits and the same
:class:`~cosim.analysis.claims.condition_reader.ConditionReader`, as soon as the rows arrive.
"""

import math

import numpy as np

from cosim.analysis.claims.condition_reader import ConditionReader
from cosim.analysis.claims.observed_conditions import (
    AssumptionViolation,
    ObservedConditions,
    causes_of,
)
from cosim.record.run_record import Rows
from noack.config.scenario import Scenario
from noack.theory.certificates.conditions import allowed_conditions

_MOST_WAITING = 100_000
"""Largest number of rows that wait for a process without output (some minutes of a run). If there
are more, the monitor stops."""


class AssumptionMonitor:
    """Reports each assumption of a run's claims once, when the run first violates it."""

    def __init__(self, scenario: Scenario) -> None:
        self._reader = ConditionReader(scenario)
        self._conditions = allowed_conditions(scenario)
        self._causes = {*causes_of(scenario)}
        """The assumptions that the run has not violated yet."""
        self._states: dict[str, int] = {}
        """States of the rules of the guarantee."""
        self._until_s = math.inf
        self.stopped: str | None = None
        """Reason why the monitor stopped; None while it is active."""

    def take(self, table: str, rows: Rows) -> None:
        """Add rows of a table, in their order."""
        if self.stopped is None:
            self._reader.take(table, rows)

    def stop(self, why: str) -> None:
        """Stop reporting: rows are missing, so the conditions cannot be determined."""
        self.stopped = self.stopped or why

    def end_at(self, t_s: float) -> None:
        """Ignore violations after a change of settings.

        The claims after a change depend on the state at that time; they are checked after the run.
        """
        self._until_s = min(self._until_s, t_s)

    def advance(self) -> list[AssumptionViolation]:
        """Return the assumptions that were violated for the first time since the last call."""
        if self.stopped is not None:
            return []
        found = self._new_violations(self._reader.observed())
        if self.waiting > _MOST_WAITING:
            self.stop("a process has sent no rows for too long")
        return found

    def end(self) -> list[AssumptionViolation]:
        """Return the violations from the rows that were still waiting; no more rows follow."""
        return [] if self.stopped is not None else self._new_violations(self._reader.end())

    @property
    def waiting(self) -> int:
        """The number of rows that wait for others."""
        return self._reader.waiting

    @np.errstate(all="ignore")  # a run may diverge
    def _new_violations(self, seen: ObservedConditions) -> list[AssumptionViolation]:
        found = seen.violations(self._conditions, self._causes, self._states)
        new = [one for one in found if one.t_s < self._until_s]
        self._causes -= {one.cause for one in new}
        return new
