"""The last minute of an emulator's statistics, for charts."""

from collections import defaultdict, deque
from collections.abc import Sequence

from netem.control.emulator_statistics import RecentRates, Statistics
from netem.engine.relay_interface import DIRECTIONS, Direction

SPAN_S = 60.0


class History:
    """The latest statistics, and the rates of the last minute."""

    def __init__(self) -> None:
        self.latest: Statistics | None = None
        self._samples: defaultdict[
            tuple[str, Direction], deque[tuple[float, RecentRates]]
        ] = defaultdict(deque)  # fmt: skip

    def add(self, statistics: Statistics) -> None:
        """Add statistics that are newer than those before."""
        self.latest = statistics
        now_s = statistics["elapsed_s"]
        for link in statistics["links"]:
            for direction in DIRECTIONS:
                recent = link[direction]["recent"]
                samples = self._samples[link["name"], direction]
                if recent is not None:
                    samples.append((now_s, recent))
                while samples and samples[0][0] <= now_s - SPAN_S:
                    samples.popleft()

    def series(
        self, link: str, direction: Direction, key: str, points: int
    ) -> Sequence[float | None]:
        """Return the last minute of a value of :class:`RecentRates`, (points,); None: unknown.

        A sample covers the time since the previous sample. A point is the mean of its samples.
        """
        if self.latest is None:
            return [None] * points
        begin_s = self.latest["elapsed_s"] - SPAN_S
        width_s = SPAN_S / points
        found: list[list[float]] = [[] for _ in range(points)]
        for end_s, recent in self._samples[link, direction]:
            value: float | None = recent[key]  # type: ignore[literal-required]
            if value is None:
                continue
            first = int(max(end_s - recent["seconds"] - begin_s, 0) / width_s)
            last = min(int((end_s - begin_s) / width_s - 1e-9), points - 1)
            for point in range(first, max(last, first) + 1):
                found[min(point, points - 1)].append(value)
        return [sum(values) / len(values) if values else None for values in found]
