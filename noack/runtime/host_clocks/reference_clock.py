"""The coordinator's clock, as a process on another host knows it: an estimate with a bound.

Each process records the bound every 50 ms, and a line when it is lost or found again.
"""

import select
from collections.abc import Callable, Sequence
from time import monotonic_ns
from typing import NamedTuple

from noack.core.clock import NS_PER_S, RunClock, clock_identity
from noack.core.errors import PeerError
from noack.protocol.record_tables import LOST_NS, clock_table
from noack.protocol.roles import Notice, Record
from noack.runtime.address import Address, address_text
from noack.runtime.host_clocks.clock_offset import SLEW_PPB, ClockOffset, Restart, RestartCause, SlewedClock
from noack.runtime.host_clocks.time_exchange import HostClocks, TimeClient
from noack.runtime.run_descriptor import RunDescriptor
from noack.scenario.run_sections import ClocksSection

LOST_AFTER_NS = 500_000_000
"""Without an answer of the reference for this time, the bound counts as lost."""
_LEAST_EXCHANGES = 8
"""Before a process joins: the first exchanges are slow, since the code is not in the caches."""
_WAIT_S = 10.0
"""Longest wait for the first offset."""
_POLL_S = 0.005
_PPB_PER_PPM = 1000
_NS_PER_US = 1000
_PPB = 10**9
_CAUSES = {
    RestartCause.CONTRADICTION: "the exchanges contradict each other or the assumed rate",
    RestartCause.OTHER_CLOCK: "the reference has another clock than before",
}


class ClockReport(NamedTuple):
    """The bound of a clock's error since the report before; times are of the own clock.

    After a restart of the bound it is from the time since when the bound may have been wrong.
    """

    since_ns: int
    now_ns: int
    offset_ns: int
    """Applied offset: time of the reference minus own clock."""
    error_ns: int | None
    """Largest difference to the reference from ``since_ns`` to ``now_ns``; None: it is lost."""
    exchanges: int = 0
    lost: str | None = None
    """The reason why it is lost."""


class ReferenceClock:
    """Follows the coordinator's clock; its time never runs backward and is never set.

    Args:
        reference: where the coordinator's host answers requests for the time.
        key: the run's key.
        settings: the assumed rate and the largest error.
        clocks: the clocks of this host.

    Raises:
        CallerError: the address cannot be used.
    """

    def __init__(
        self,
        reference: Address,
        key: bytes,
        settings: ClocksSection,
        clocks: HostClocks | None = None,
    ) -> None:
        self._clocks = HostClocks() if clocks is None else clocks
        self._where = address_text(reference)
        self._largest_ns = round(settings.largest_error_us * _NS_PER_US)
        self._offset = ClockOffset(round(settings.relative_rate_ppm * _PPB_PER_PPM))
        self._client = TimeClient(reference, key, self._offset, clocks=self._clocks)
        self._slewed: SlewedClock | None = None
        self.slew_ppb = max(SLEW_PPB, 2 * self._offset.rate_ppb)
        self._accepted = 0
        self._answered_ns = self._since_ns = self._clocks.monotonic_ns()
        self._error_ns: int | None = None
        """Bound of the error just after the poll before."""

    def close(self) -> None:
        """Close the socket."""
        self._client.close()

    def wait_until_known(self, give_up: Callable[[], bool] = lambda: False, wait_s: float = _WAIT_S) -> None:
        """Exchange times until the error is small enough to begin.

        Raise PeerError if it is not after ``wait_s``, or ``give_up`` is true.
        """
        until_ns = self._clocks.monotonic_ns() + round(wait_s * NS_PER_S)
        while True:
            self._client.poll()
            now_ns = self._clocks.monotonic_ns()
            interval = self._offset.interval(now_ns)
            enough = self._client.accepted >= _LEAST_EXCHANGES
            if interval is not None and enough and interval.error_ns <= self._largest_ns:
                self._slewed = SlewedClock(self._offset, now_ns, self.slew_ppb)
                self._error_ns = self._slewed.error_ns(now_ns)
                self._answered_ns, self._since_ns = now_ns, now_ns
                self._accepted = self._client.accepted
                return
            if give_up() or now_ns > until_ns:
                state = (
                    f"no answer from {self._where}; do firewalls pass UDP to this port?"
                    if interval is None
                    else f"known within {interval.error_ns / _NS_PER_US:.0f} µs, "
                    f"{self._largest_ns / _NS_PER_US:g} µs allowed"
                )
                raise PeerError(f"cannot compare this host's clock with the coordinator's: {state}")
            select.select([self._client], (), (), _POLL_S)

    @property
    def slewed(self) -> SlewedClock:
        """The estimate of the coordinator's monotonic clock, once it is known."""
        assert self._slewed is not None
        return self._slewed

    def monotonic_ns(self) -> int:
        """Return the estimate of the coordinator's monotonic clock; it never decreases."""
        return self.slewed.now_ns(self._clocks.monotonic_ns())

    def poll(self) -> ClockReport:
        """Exchange times; return the bound since the report before. Call it every 50 ms."""
        slewed, before_ns = self.slewed, self._clocks.monotonic_ns()
        error_ns = slewed.error_ns(before_ns)
        restarts = self._client.poll()
        now_ns = self._clocks.monotonic_ns()
        if error_ns is not None:
            # Both rates together change the error during the poll.
            rate_ppb = self._offset.rate_ppb + self.slew_ppb
            error_ns += -(-rate_ppb * (now_ns - before_ns) // _PPB) + 1
        largest_ns = None if error_ns is None or self._error_ns is None else (max(self._error_ns, error_ns))
        slewed.follow(now_ns)
        self._error_ns = slewed.error_ns(now_ns)
        if self._client.accepted > self._accepted:
            self._accepted, self._answered_ns = self._client.accepted, now_ns
        lost = self._why_lost(restarts, now_ns)
        since_ns = min([self._since_ns, *(restart.since_ns for restart in restarts)])
        self._since_ns = now_ns
        return ClockReport(
            since_ns,
            now_ns,
            slewed.now_ns(now_ns) - now_ns,
            None if lost else largest_ns,
            self._offset.exchanges,
            lost,
        )

    def counts(self) -> dict[str, object]:
        """Return how many exchanges succeeded, and how often the bound began again."""
        client = self._client
        return {
            "exchanges": self._offset.exchanges,
            "restarts": self._offset.restarts,
            "rejected": dict(client.rejected),
            "send_errors": dict(client.send_errors),
        }

    def _why_lost(self, restarts: list[Restart], now_ns: int) -> str | None:
        if restarts:
            return _CAUSES[restarts[0].cause]
        if now_ns - self._answered_ns > LOST_AFTER_NS:
            return f"no answer from {self._where} for {LOST_AFTER_NS / NS_PER_S:g} s"
        return None


def reference_clock(descriptor: RunDescriptor) -> ReferenceClock | None:
    """Return the clock of the run's coordinator; None if this process reads that clock itself.

    Raise PeerError if it is another clock, and nobody answers requests for its time.
    """
    if descriptor.clock == clock_identity():
        return None
    if descriptor.time_reference is None:
        raise PeerError(
            "this process and the run's coordinator have different clocks, and the coordinator's "
            "host answers no requests for the time; it does with `noack record --listen`"
        )
    settings = descriptor.scenario.clocks or ClocksSection()
    return ReferenceClock(descriptor.time_reference, descriptor.key, settings)


LOST, FOUND = "clock lost", "clock found"
"""Levels of the notices."""


class ClockRecord:
    """Rows and notices about the clock of a process.

    Args:
        role: the process.
        clock: its clock in the run.
        reference: what follows the coordinator's clock; None if the process reads that clock.
        has_table: whether the run has the table.
    """

    def __init__(
        self,
        role: str,
        clock: RunClock,
        reference: ReferenceClock | None,
        *,
        has_table: bool,
    ) -> None:
        self._role, self._clock, self._reference = role, clock, reference
        self._has_table = has_table
        self._number = 0
        self._since_ns = monotonic_ns()
        self._lost: str | None = None
        self._largest_ns = 0

    def compare(self, now_ns: int) -> Sequence[Record | Notice]:
        """Compare the clocks; return the row, and a notice if the bound was lost or found again."""
        report = self._direct() if self._reference is None else self._reference.poll()
        outputs: list[Record | Notice] = []
        if self._has_table:
            outputs.append(self._row(report, now_ns))
        if report.lost != self._lost:
            self._lost = report.lost
            level, text = (
                (FOUND, "the bound of its clock's error is known again")
                if report.lost is None
                else (LOST, f"the bound of its clock's error is lost: {report.lost}")
            )
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
            number,
            report.exchanges,
            now_ns - age_ns,
            now_ns,
            report.now_ns,
            report.offset_ns,
            error_ns,
        )
        return Record(clock_table(self._role), row)
