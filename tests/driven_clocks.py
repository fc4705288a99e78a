"""Clocks of a host with another offset and rate, for tests and benchmarks."""

from noack.runtime.host_clocks.time_exchange import HostClocks


class DrivenClocks(HostClocks):
    """The clocks of this host, with an added offset and drift of the monotonic clock.

    Kernel stamps and the real-time clock have the same drift, as the clocks of a real host have.
    """

    def __init__(self, offset_ns: int = 0, drift_ppb: int = 0) -> None:
        self._begin_ns = super().monotonic_ns()
        self._real_begin_ns = super().realtime_ns()
        self._offset_ns = offset_ns
        self._drift_ppb = drift_ppb

    def added_ns(self, true_ns: int) -> int:
        """What is added to the monotonic clock at its own reading ``true_ns``."""
        return self._offset_ns + self._drift_ppb * (true_ns - self._begin_ns) // 10**9

    def monotonic_ns(self) -> int:
        """The monotonic clock, with offset and drift."""
        true_ns = super().monotonic_ns()
        return true_ns + self.added_ns(true_ns)

    def realtime_ns(self) -> int:
        """The real-time clock, with the drift."""
        return self._drifted(super().realtime_ns())

    def stamp_ns(self, stamp: bytes) -> int:
        """The time of a kernel stamp, with the drift."""
        return self._drifted(super().stamp_ns(stamp))

    def _drifted(self, real_ns: int) -> int:
        return real_ns + self._drift_ppb * (real_ns - self._real_begin_ns) // 10**9
