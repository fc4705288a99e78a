"""Checks the claims of all loops during a run: violated assumptions, and states that grow.

A turn takes little time: of many loops, it checks as many as fit. More than ``MOST_CHECKED`` loops
are checked after the run only; which of them diverge is reported for any number.
"""

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from cosim.analysis.claims.condition_reader import READ, AssumptionMonitor
from cosim.analysis.claims.observed_conditions import SCHEDULE, AssumptionViolation, worst_time
from cosim.record.divergence import GrowthMonitor
from cosim.record.record_source import Rows, rows_by_loop
from noack.core.clock import NS_PER_S
from noack.protocol.record_tables import LOOP, SENSOR_MEASUREMENT
from noack.protocol.roles import Notice
from noack.scenario.resolution import resolved_loops, tables_of
from noack.scenario.scenario import Scenario, phases_ns
from noack.theory.certificates.conditions import allowed_conditions
from noack.theory.certificates.network_limits import network_limit
from noack.theory.certificates.region import scopes

MOST_CHECKED = 100
_TURN_S = 0.01
"""CPU time of a turn; the recorder makes ten a second."""
_LIMITS_S = 0.5
"""CPU time for the largest certified times of a run; one takes about 0.1 s."""


class Finding(NamedTuple):
    """What a run has shown about its claims."""

    notice: Notice
    """For the log of the loop, in the loop's time."""
    text: str
    """For the log of the run: the name of the loop, and the time of the run."""


class ClaimMonitor:
    """Reports each violated assumption and each divergence of a loop once."""

    def __init__(self, scenario: Scenario) -> None:
        self._loops = loops = resolved_loops(scenario)
        self._limits_s = 0.0
        self._names = [loop.name for loop in loops]
        self._phases_ns, self._types = phases_ns(scenario), [tables_of(loop) for loop in loops]
        self._stopped: str | None = None
        self._until_s = np.inf
        checked = loops if len(loops) <= MOST_CHECKED else ()
        self._monitors = [AssumptionMonitor(checked_loop) for checked_loop in checked]
        if not checked:
            self.stop(f"the run has {len(loops)} loops; up to {MOST_CHECKED} are checked during it")
        self._growth = GrowthMonitor(loops)
        self._findings: list[Finding] = []
        self._waiting: dict[str, list[Rows]] = {}
        self._due: list[int] = []
        """The loops that are still to be checked in this round."""

    @property
    def stopped(self) -> str | None:
        """Reason why assumptions are checked no longer; None while they are."""
        ended = (monitor.stopped for monitor in self._monitors if monitor.stopped is not None)
        return self._stopped or next(ended, None)

    def stop(self, why: str) -> None:
        """Report no more violations: rows are missing, so the conditions cannot be determined."""
        self._stopped = self._stopped or why
        self._waiting = {}

    def end_at(self, t_s: float) -> None:
        """Ignore what happens after a change of settings at a time of the run."""
        self._until_s = min(self._until_s, t_s)
        for monitor, phase_ns in zip(self._monitors, self._phases_ns, strict=False):
            monitor.end_at(t_s - phase_ns / NS_PER_S)

    def take(self, table: str, rows: Rows) -> None:
        """Add rows of a table, in their order."""
        if table == SENSOR_MEASUREMENT:
            for loop, t_ns, text in self._growth.take(rows[LOOP], rows["t_ns"], rows["x"]):
                if self._of_run_s(loop, t_ns) < self._until_s:
                    self._add(loop, t_ns, "diverges", "diverges", text)
        if table in READ and self.stopped is None:
            self._waiting.setdefault(table, []).append(rows)

    def advance(self) -> list[Finding]:
        """Return what was found since the last call, in the order of time."""
        if self.stopped is None:
            began_s, first = time.thread_time(), True
            if not self._due:
                self._hand_out()
            while self._due and (first or time.thread_time() - began_s < _TURN_S):
                self._check(self._due.pop(0), AssumptionMonitor.advance)
                first = False
        return self._take_findings()

    def end(self) -> list[Finding]:
        """Return the findings from the rows that were still waiting; no more rows follow."""
        if self.stopped is None:
            self._hand_out()
            for loop in range(len(self._monitors)):
                self._check(loop, AssumptionMonitor.end)
        return self._take_findings()

    def _hand_out(self) -> None:
        """Begin a round: give each loop its rows."""
        waiting, self._waiting = self._waiting, {}
        for table, batches in waiting.items():
            for loop, rows in rows_by_loop(table, np.concatenate(batches), self._phases_ns, self._types):
                self._monitors[loop].take(table, rows)
        self._due = [*range(len(self._monitors))]

    def _check(self, loop: int, check: Callable[[AssumptionMonitor], Sequence[AssumptionViolation]]) -> None:
        for violation in check(self._monitors[loop]):
            t_ns = round(violation.t_s * NS_PER_S)
            text = violation.text + worst_time(violation.t_s, violation.worst_at_s)
            if violation.cause in SCHEDULE:
                limit = self._limit(loop, violation.cause)
                self._add(loop, t_ns, "late", "later than allowed", f"{text}{limit}")
            else:
                self._add(loop, t_ns, "void", "void (assumption violated)", text)

    def _limit(self, loop: int, cause: str) -> str:
        """Return up to which time there are certificates, in words, while there is time for it.

        That of a nonlinear plant on its region takes seconds, and is left out.
        """
        if self._limits_s > _LIMITS_S or not self._loops[loop].coverage.linear_certificates_apply:
            return ""
        began_s = time.thread_time()
        try:
            scheduled = allowed_conditions(self._loops[loop])
            limit_s = network_limit(scopes(self._loops[loop])[0], scheduled, cause)
        except Exception:  # the claims report it
            return ""
        finally:
            self._limits_s += time.thread_time() - began_s
        if not limit_s:
            return ""
        return f"; there are certificates for up to {limit_s:.4g} s, if nothing else is later than allowed"

    def _add(self, loop: int, t_ns: int, level: str, event: str, why: str) -> None:
        own = f"{event} from {t_ns / NS_PER_S:.3f} s on: {why}"
        of_run = f"{event} from {self._of_run_s(loop, t_ns):.3f} s on: {why}"
        if len(self._names) > 1:
            of_run = f"{self._names[loop]}: {of_run}"
        self._findings.append(Finding(Notice(t_ns, level, own, loop), of_run))

    def _of_run_s(self, loop: int, t_ns: int) -> float:
        return (t_ns + self._phases_ns[loop]) / NS_PER_S

    def _take_findings(self) -> list[Finding]:
        findings, self._findings = self._findings, []
        return sorted(findings, key=lambda finding: finding.notice.t_ns)
