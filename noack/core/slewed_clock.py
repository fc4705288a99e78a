"""The reference's time at a process: its own clock plus an offset that never jumps."""

from typing import NamedTuple

from noack.core.clock_offset import ClockOffset

SLEW_PPB = 5_000_000
"""Default of the slew rate: 0.5 % of the rate of the process's own clock."""
_PPB = 10**9


class Slew(NamedTuple):
    """How the applied offset moves from a time on: native/clock.c computes the same from it."""

    slew_ppb: int
    """Largest change of the offset, in parts per 10⁹ of the own time."""
    since_ns: int
    """Reading of the own clock."""
    begun_ns: int
    """The offset then."""
    target_ns: int
    """The offset towards which it moves."""


class SlewedClock:
    """A clock that follows the reference's, never runs backward, and has a bound of its error.

    The applied offset begins at the estimate and then moves towards each new estimate at
    ``slew_ppb`` parts per 10⁹ of the own time, at most. Calls have readings of the own clock that
    do not decrease.

    Raises:
        ValueError: there is no estimate at ``own_ns``, or the slew rate is not above the rate at
            which the offset may change, so that the clock could not follow it.
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
        self._begun_at_ns = self._target_ns = interval.midpoint_ns

    def follow(self, own_ns: int) -> None:
        """Move towards the estimate at ``own_ns`` from now on; without one the offset stays."""
        applied_ns = self._applied_ns(own_ns)
        interval = self._offset.interval(own_ns)
        self._since_ns, self._begun_at_ns = own_ns, applied_ns
        self._target_ns = applied_ns if interval is None else interval.midpoint_ns

    @property
    def slew(self) -> Slew:
        """How the offset moves until the next call of :meth:`follow`."""
        return Slew(self.slew_ppb, self._since_ns, self._begun_at_ns, self._target_ns)

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
        change_ns = self._target_ns - self._begun_at_ns
        return self._begun_at_ns + min(max(change_ns, -most_ns), most_ns)
