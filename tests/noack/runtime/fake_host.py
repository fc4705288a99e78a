"""A host with known clocks: the real-time clock may be set, and each reading takes some time."""

import socket
import struct
from random import Random

from noack.runtime.host_clocks.time_exchange import HostClocks

PS = 1000  # per ns


class FakeHost(HostClocks):
    """Its time is that of the monotonic clock, in whole picoseconds; readings are rounded down.

    ``settings`` are (time, change) of the real-time clock.
    """

    def __init__(self, random: Random, settings_ps: list[tuple[int, int]]) -> None:
        self.now_ps = random.randint(0, 10**6 * PS)
        self._random = random
        self._real_ps = random.randint(10**18, 10**18 + PS) * PS
        self._settings_ps = settings_ps

    def difference_ps(self, time_ps: int) -> int:
        """Real-time minus monotonic clock."""
        return self._real_ps + sum(change for at, change in self._settings_ps if at <= time_ps)

    def wait(self, most_ns: int) -> None:
        self.now_ps += self._random.randint(0, most_ns * PS)

    def monotonic_ns(self) -> int:
        self.wait(self._random.choice((0, 100, 100, 10**6)))
        return self.now_ps // PS

    def realtime_ns(self) -> int:
        self.wait(100)
        return (self.now_ps + self.difference_ps(self.now_ps)) // PS

    def kernel_stamp_ns(self) -> int:
        """The stamp of a datagram that arrives now."""
        return (self.now_ps + self.difference_ps(self.now_ps)) // PS


def stamp_of(time_ns: int) -> tuple[int, int, bytes]:
    """The ancillary data with a kernel stamp."""
    return socket.SOL_SOCKET, 35, struct.pack("@ll", *divmod(time_ns, 10**9))
