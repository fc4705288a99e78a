"""What a process records about its clock: a row every 50 ms, and a line when the bound is lost."""

from collections.abc import Sequence
from time import monotonic_ns

from noack.core.clock import RunClock
from noack.protocol.machine_interface import Notice, Record, Start
from noack.protocol.record_tables import LOST_NS, clock_table
from noack.runtime.reference_clock import ClockReport, ReferenceClock

LOST, FOUND = "clock lost", "clock found"
"""Levels of the notices."""


class ClockRecord:
    """Rows and notices about the clock of a process.

    Args:
        role: the process.
        start: where in the run it begins; a restarted process numbers its rows above all others.
        clock: its clock in the run.
        reference: what follows the coordinator's clock; None if the process reads that clock.
        has_table: whether the run has the table.
    """

    def __init__(
        self,
        role: str,
        start: Start,
        clock: RunClock,
        reference: ReferenceClock | None,
        *,
        has_table: bool,
    ) -> None:
        self._role, self._clock, self._reference = role, clock, reference
        self._has_table = has_table
        self._number = start.first_number
        self._since_ns = monotonic_ns()
        self._lost: str | None = None
        self._largest_ns = 0

    def news(self, now_ns: int) -> Sequence[Record | Notice]:
        """Compare the clocks; return the row, and a notice if the bound was lost or found again."""
        report = self._direct() if self._reference is None else self._reference.poll()
        outputs: list[Record | Notice] = []
        if self._has_table:
            outputs.append(self._row(report, now_ns))
        if report.lost != self._lost:
            self._lost = report.lost
            level, text = (
                (FOUND, "the bound of its clock's error is known again") if report.lost is None
                else (LOST, f"the bound of its clock's error is lost: {report.lost}")
            )  # fmt: skip
            outputs.append(Notice(now_ns, level, text))
        self._largest_ns = max(self._largest_ns, report.error_ns or 0)
        return outputs

    def summary(self) -> dict[str, object]:
        """Return what the final report says about the clock; empty if it is the coordinator's."""
        if self._reference is None:
            return {}
        return {"clock": {"largest_error_ns": self._largest_ns, **self._reference.counts()}}

    def _direct(self) -> ClockReport:
        since_ns, self._since_ns = self._since_ns, monotonic_ns()
        return ClockReport(since_ns, self._since_ns, 0, 0)

    def _row(self, report: ClockReport, now_ns: int) -> Record:
        number, self._number = self._number, self._number + 1
        now_ns = max(now_ns, self._clock.now_ns())
        age_ns = round((report.now_ns - report.since_ns) * self._clock.speed)
        error_ns = LOST_NS if report.error_ns is None else report.error_ns
        row = (
            number, report.exchanges, now_ns - age_ns, now_ns,
            report.now_ns, report.offset_ns, error_ns,
        )  # fmt: skip
        return Record(clock_table(self._role), row)
