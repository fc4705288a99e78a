"""The last minute of an emulator's statistics, for charts."""

from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

from netem.control.emulator_statistics import RecentRates, Statistics
from netem.engine.relay_interface import DIRECTIONS, Direction

SPAN_S = 60.0


class StatisticsSample(NamedTuple):
    """What happened in one direction of a link until some time."""

    elapsed_s: float
    recent: RecentRates


class History:
    """Statistics, as they come, and what of them lies in the last minute."""

    def __init__(self) -> None:
        self.latest: Statistics | None = None
        self._samples: defaultdict[tuple[str, Direction], deque[StatisticsSample]] = defaultdict(
            deque
        )

    def add(self, statistics: Statistics) -> None:
        """Take statistics that are newer than those before."""
        self.latest = statistics
        now_s = statistics["elapsed_s"]
        for link in statistics["links"]:
            for direction in DIRECTIONS:
                recent = link[direction]["recent"]
                samples = self._samples[link["name"], direction]
                if recent is not None:
                    samples.append(StatisticsSample(now_s, recent))
                while samples and samples[0].elapsed_s <= now_s - SPAN_S:
                    samples.popleft()

    def series(
        self,
        link: str,
        direction: Direction,
        value: Callable[[RecentRates], float | None],
        points: int,
    ) -> Sequence[float | None]:
        """Return the last minute of a value, (points,); the mean where several fall together.

        A value of a sample is valid from the one before it on.
        """
        if self.latest is None:
            return [None] * points
        begin_s = self.latest["elapsed_s"] - SPAN_S
        width_s = SPAN_S / points
        found: list[list[float]] = [[] for _ in range(points)]
        for sample in self._samples[link, direction]:
            measured = value(sample.recent)
            if measured is None:
                continue
            first = int(max(sample.elapsed_s - sample.recent["seconds"] - begin_s, 0) / width_s)
            last = min(int((sample.elapsed_s - begin_s) / width_s - 1e-9), points - 1)
            for point in range(first, max(last, first) + 1):
                found[min(point, points - 1)].append(measured)
        return [sum(values) / len(values) if values else None for values in found]
