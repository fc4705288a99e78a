"""Two clocks whose true offset is known, exchanges between them, and checks of the bound.

Times are whole picoseconds of the own clock, offsets whole 10⁻⁹ ps, so that nothing is rounded but
the readings.
"""

from bisect import bisect_right
from collections.abc import Iterator
from heapq import heappop, heappush
from random import Random

from noack.core.clock import ClockOffset, Exchange, OffsetInterval

PS, PPB = 1000, 10**9
SCALE = PS * PPB
DELAYS_NS = (0, 1, 10**3, 10**5, 10**7, 10**9)


class TrueOffset:
    """Reference minus own clock: pieces with slopes from -rate to rate, often at the limits."""

    def __init__(self, random: Random, begin_ns: int, offset_ns: int, rate_ppb: int) -> None:
        self._random = random
        self._rate_ppb = rate_ppb
        self._begin_ps = [begin_ns * PS]
        self._value = [offset_ns * SCALE]
        self._slope_ppb = [self._drawn()]

    def _drawn(self) -> int:
        rate = self._rate_ppb
        return self._random.choice((-rate, rate, self._random.randint(-rate, rate)))

    def at(self, time_ps: int) -> int:
        """The offset in 10⁻⁹ ps."""
        while time_ps >= self._begin_ps[-1]:
            length_ps = self._random.choice((10**6, 10**8, 10**10)) * PS
            self._value.append(self._value[-1] + self._slope_ppb[-1] * length_ps)
            self._begin_ps.append(self._begin_ps[-1] + length_ps)
            self._slope_ppb.append(self._drawn())
        k = bisect_right(self._begin_ps, time_ps) - 1
        return self._value[k] + self._slope_ppb[k] * (time_ps - self._begin_ps[k])

    def reading_ns(self, time_ps: int) -> int:
        """The reference's clock, rounded down."""
        return (time_ps * PPB + self.at(time_ps)) // SCALE


def exchanges(
    random: Random, truth: TrueOffset, begin_ns: int, number: int
) -> Iterator[tuple[int, Exchange]]:
    """Exchanges in the order of their ends, some of them twice, and the time of each end in ps.

    Each delay has any scale, requests overlap, and some are lost. Receive times may be late.
    """
    sent_ps = begin_ns * PS
    waiting: list[tuple[int, tuple[int, int], Exchange]] = []
    for k in range(number):
        sent_ps += random.randint(0, 10 ** random.choice((4, 7, 8)) * PS)
        forward, answer, back, late, late_there = (
            random.randint(0, random.choice(DELAYS_NS) * PS) for _ in range(5)
        )
        arrived_ps = sent_ps + forward
        answered_ps = arrived_ps + answer
        received_ps = answered_ps + back
        exchange = Exchange(
            sent_ps // PS,
            truth.reading_ns(arrived_ps + min(late_there, answer)),
            truth.reading_ns(answered_ps),
            (received_ps + late) // PS,
        )
        while waiting and waiting[0][0] <= sent_ps:
            end_ps, _, ended = heappop(waiting)
            yield end_ps, ended
        for copy in range(random.choice((0, 1, 1, 1, 2))):
            copied_ps = received_ps + late + copy * random.randint(0, 10**9 * PS)
            heappush(waiting, (copied_ps, (k, copy), exchange))
    for end_ps, _, ended in sorted(waiting):
        yield end_ps, ended


def check_run(
    offset: ClockOffset, random: Random, offset_ns: int, rate_ppb: int, number: int
) -> None:
    """Fail if an interval does not contain the truth, or is wider than the newest exchange."""
    begin_ns = random.randint(0, 10**15)
    truth = TrueOffset(random, begin_ns, offset_ns, rate_ppb)
    for end_ps, exchange in exchanges(random, truth, begin_ns, number):
        assert offset.add(exchange) is None
        time_ps = end_ps + random.choice((0, random.randint(0, 10**8 * PS)))
        for at_ps in (end_ps, time_ps):
            interval = offset.interval(at_ps // PS)
            assert interval is not None
            check_contains(interval, truth.at(at_ps))
            t1, t2, t3, t4 = exchange
            growth_ns = offset.rate_ppb * (2 * (at_ps // PS + 1) - t1 - t4) // PPB
            width_ns = interval.upper_ns - interval.lower_ns
            assert width_ns <= (t2 - t1) + (t4 - t3) + growth_ns + 5


def check_contains(interval: OffsetInterval, truth: int) -> None:
    assert interval.lower_ns * SCALE <= truth <= interval.upper_ns * SCALE
