"""The offset between the clocks of two hosts, as an interval that contains it.

A process whose monotonic clock is not the coordinator's, the reference, bounds the offset of both
by exchanges of four timestamps. The offset θ is the reference's reading minus the own reading, as a
function of the own clock. In an exchange a request is sent at t1 (own) and received at t2
(reference), the reply is sent at t3 (reference) and received at t4 (own). A clock does not run
backward, and nothing arrives before it is sent, so at these instants

    θ(t1) <= t2 - t1        θ(t4) >= t3 - t4

whatever the delays of the two ways are. With |dθ/dt| <= ρ, at any later time t

    t3 - t4 - ρ (t - t4)  <=  θ(t)  <=  t2 - t1 + ρ (t - t1)

All upper limits have the same slope, so one number keeps the smallest of them; likewise the lower
ones. Send times are read before sending. Receive times may be late, but not early: this only
widens the bound. A reading is a whole number of nanoseconds, rounded down, of which the bound takes
account. ``docs/derivations.md`` has the proof. The applied offset moves towards the estimate
without a jump (:class:`SlewedClock`).
"""

import time
from collections.abc import Callable
from enum import StrEnum
from typing import TYPE_CHECKING, NamedTuple

from noack.core.clock import RunClock

if TYPE_CHECKING:
    from noack.core.core_library import CData  # loads the core

RELATIVE_RATE_PPB = 1_201_000
"""Default of ρ: two crystals of ±100 ppm, and both clocks slewed by at most 500 ppm, as ntpd and
adjtime do: 1.0006 / 0.9994 - 1. chronyd slews by up to 83,333 ppm unless its ``maxslewrate`` is
500."""
_PPB = 10**9
SLEW_PPB = 5_000_000
"""Default of the slew rate: 0.5 % of the rate of the process's own clock."""


class Exchange(NamedTuple):
    """The four timestamps: t1 and t4 of the own clock, t2 and t3 of the reference."""

    sent_ns: int
    reference_received_ns: int
    reference_sent_ns: int
    received_ns: int


class OffsetInterval(NamedTuple):
    """Contains the offset: reference minus own clock."""

    lower_ns: int
    upper_ns: int

    @property
    def midpoint_ns(self) -> int:
        """The estimate of the offset."""
        return (self.lower_ns + self.upper_ns) // 2

    @property
    def error_ns(self) -> int:
        """Largest error of the estimate."""
        return self.upper_ns - self.midpoint_ns


class RestartCause(StrEnum):
    """Reasons for which a bound begins again."""

    CONTRADICTION = "contradiction"
    """No offset agrees with all exchanges and the assumed rate."""
    OTHER_CLOCK = "other_clock"
    """The reference has another clock than before, for example after a reboot."""


class Restart(NamedTuple):
    """A bound that began again. Until then it may have been wrong since ``since_ns``."""

    cause: RestartCause
    since_ns: int
    """Own time: the assumption was violated after it."""
    now_ns: int
    """Own time of the exchange that showed it."""


class _Limits(NamedTuple):
    """Limits of the offset as lines over the own time, in 10⁻⁹ ns; the times are of their origin.

    The upper limit is ``upper + ρ t``, the lower ``lower - ρ t``.
    """

    upper: int
    upper_since_ns: int
    lower: int
    lower_since_ns: int

    @property
    def newest_ns(self) -> int:
        return max(self.upper_since_ns, self.lower_since_ns)


class ClockOffset:
    """An interval that contains the offset of two clocks at any time after the newest exchange.

    ``rate_ppb`` is ρ, in parts per 10⁹ of the own time. If the assumption is violated, the interval
    may be wrong until exchanges contradict each other; :meth:`add` then returns a :class:`Restart`.
    """

    def __init__(self, rate_ppb: int = RELATIVE_RATE_PPB) -> None:
        if not 0 <= rate_ppb < _PPB:
            raise ValueError(f"the relative rate must be from 0 to 10⁹ ppb, not {rate_ppb}")
        self.rate_ppb = rate_ppb
        self.exchanges = 0
        self.restarts = 0
        self._limits: _Limits | None = None

    def add(self, exchange: Exchange) -> Restart | None:
        """Take account of an exchange; exchanges may be added in any order.

        Raise ValueError if a reply was sent or received before its request.
        """
        sent_ns, reference_received_ns, reference_sent_ns, received_ns = exchange
        if received_ns < sent_ns or reference_sent_ns < reference_received_ns:
            raise ValueError(f"timestamps in the wrong order: {exchange}")
        self.exchanges += 1
        new = _Limits(
            (reference_received_ns + 1 - sent_ns) * _PPB - self.rate_ppb * sent_ns,
            sent_ns,
            (reference_sent_ns - received_ns - 1) * _PPB + self.rate_ppb * received_ns,
            received_ns,
        )
        common = new if self._limits is None else _intersection(self._limits, new)
        if self._possible(common):
            self._limits = common
            return None
        self._limits = new if self._possible(new) else None
        self.restarts += 1
        since_ns = min(common.upper_since_ns, common.lower_since_ns)
        return Restart(RestartCause.CONTRADICTION, since_ns, received_ns)

    def begin_again(self, now_ns: int) -> Restart | None:
        """Forget all exchanges, which were with another clock; None if there were none."""
        limits, self._limits = self._limits, None
        if limits is None:
            return None
        self.restarts += 1
        return Restart(RestartCause.OTHER_CLOCK, limits.newest_ns, now_ns)

    def interval(self, now_ns: int) -> OffsetInterval | None:
        """Return the interval at a reading of the own clock; None without an exchange.

        Raise ValueError if the newest exchange is from after ``now_ns``.
        """
        limits = self._limits
        if limits is None:
            return None
        if now_ns < limits.newest_ns:
            raise ValueError(f"{now_ns} ns is before the newest exchange, {limits.newest_ns} ns")
        change = self.rate_ppb * (now_ns + 1)
        return OffsetInterval((limits.lower - change) // _PPB, -(-(limits.upper + change) // _PPB))

    def _possible(self, limits: _Limits) -> bool:
        width = limits.upper - limits.lower + 2 * self.rate_ppb * (limits.newest_ns + 1)
        return width >= 0


def _intersection(first: _Limits, second: _Limits) -> _Limits:
    """Return the stricter limits; of equal ones the newer."""
    upper = min((first.upper, -first.upper_since_ns), (second.upper, -second.upper_since_ns))
    lower = max((first.lower, first.lower_since_ns), (second.lower, second.lower_since_ns))
    return _Limits(upper[0], -upper[1], lower[0], lower[1])


class Slew(NamedTuple):
    """The motion of the applied offset from a time on: native/clock.c computes the same from it."""

    slew_ppb: int
    """Largest change of the offset, in parts per 10⁹ of the own time."""
    since_ns: int
    """Reading of the own clock."""
    first_offset_ns: int
    """The offset then, from which it moves."""
    target_offset_ns: int
    """The offset towards which it moves."""


class SlewedClock:
    """A clock that follows the reference's, never runs backward, and has a bound of its error.

    The applied offset begins at the estimate and then moves towards each new estimate at
    ``slew_ppb`` parts per 10⁹ of the own time, at most. Calls have readings of the own clock that
    do not decrease. Raise ValueError if there is no estimate at ``own_ns``, or the slew rate is not
    above the rate at which the offset may change, so that the clock could not follow it.
    """

    def __init__(self, offset: ClockOffset, own_ns: int, slew_ppb: int = SLEW_PPB) -> None:
        if not offset.rate_ppb < slew_ppb < _PPB:
            raise ValueError(
                f"the slew rate must be above {offset.rate_ppb} and below 10⁹ ppb, not {slew_ppb}"
            )
        interval = offset.interval(own_ns)
        if interval is None:
            raise ValueError("the offset of the clocks is unknown: no exchange has succeeded")
        self._offset = offset
        self.slew_ppb = slew_ppb
        self._since_ns = own_ns
        self._first_offset_ns = self._target_offset_ns = interval.midpoint_ns

    def follow(self, own_ns: int) -> None:
        """Move towards the estimate at ``own_ns`` from now on; without one the offset stays."""
        applied_ns = self._applied_ns(own_ns)
        interval = self._offset.interval(own_ns)
        self._since_ns, self._first_offset_ns = own_ns, applied_ns
        self._target_offset_ns = applied_ns if interval is None else interval.midpoint_ns

    @property
    def slew(self) -> Slew:
        """The motion of the offset until the next call of :meth:`follow`."""
        return Slew(self.slew_ppb, self._since_ns, self._first_offset_ns, self._target_offset_ns)

    def now_ns(self, own_ns: int) -> int:
        """Return the time of this clock at a reading of the own clock."""
        return own_ns + self._applied_ns(own_ns)

    def error_ns(self, own_ns: int) -> int | None:
        """Return a bound of the difference to the reference, which includes what slewing lags.

        None if the offset is unknown.
        """
        interval = self._offset.interval(own_ns)
        if interval is None:
            return None
        applied_ns = self._applied_ns(own_ns)
        # Readings are rounded down: the reference may be 1 ns further.
        return max(interval.upper_ns + 1 - applied_ns, applied_ns - interval.lower_ns)

    def _applied_ns(self, own_ns: int) -> int:
        """In one nanosecond of the own time it changes by at most one."""
        most_ns = self.slew_ppb * (own_ns - self._since_ns) // _PPB
        change_ns = self._target_offset_ns - self._first_offset_ns
        return self._first_offset_ns + min(max(change_ns, -most_ns), most_ns)


class SlewedRunClock(RunClock):
    """Simulated time tied to another host's clock, as this host knows it.

    Args:
        epoch_ns: the other clock's reading at simulated time 0.
        speed: simulated seconds per second of the other clock.
        slewed: the other clock, as this host knows it.
        own_ns: this host's monotonic clock.
    """

    def __init__(
        self,
        epoch_ns: int,
        speed: float,
        slewed: SlewedClock,
        own_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        super().__init__(epoch_ns, speed, lambda: slewed.now_ns(own_ns()))
        self._slewed = slewed

    def set_core(self, clock: "CData") -> None:
        """Let a ``noack_clock`` of the core read as this clock does, until the next estimate."""
        super().set_core(clock)
        slew = self._slewed.slew
        clock.slew_ppb, clock.since_ns = slew.slew_ppb, slew.since_ns
        clock.first_offset_ns, clock.target_offset_ns = slew.first_offset_ns, slew.target_offset_ns
