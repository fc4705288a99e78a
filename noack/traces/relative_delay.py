"""Delays between two clocks: known up to a constant, and to the drift of one against the other.

The lower envelope of the measured delays is the line below all of them with the smallest mean
distance to them. Its slope is the drift; without it, the smallest delay is 0. Source: Moon, Skelly,
Towsley, *Estimation and removal of clock skew from network delay measurements*, INFOCOM 1999.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from noack.traces.packet_trace import LOST_NS, PacketTrace

MOST_DRIFT_PPM = 500.0
"""Clocks differ by less than 200 ppm; NTP slews a clock by at most 500 ppm."""
_STEP_NS = 1_000_000
_FEWEST = 20
_BUCKETS = 4096

Times = NDArray[np.float64]


@dataclass(frozen=True)
class ClockComparison:
    """What the delays say about the two clocks."""

    drift_ppm: float | None
    """How much faster the receiver's clock runs; None if the delays do not show it."""
    step_ns: int = 0
    """Permanent change of the smallest delay that no drift explains; 0: none."""
    step_at_ns: int = 0

    def lines(self) -> list[str]:
        """Return lines for a report."""
        lines = [
            "the two clocks are not comparable: delays are relative to the smallest one, "
            "which is shown as 0, and a deadline applies to these relative delays"
        ]
        if self.drift_ppm is not None:
            lines.append(
                f"the receiver's clock runs {self.drift_ppm:+.2f} ppm against the sender's "
                "(slope of the delays' lower envelope); this drift is removed"
            )
        if self.step_ns:
            lines.append(
                f"the smallest delay changes by {self.step_ns / 1e6:+.1f} ms at "
                f"{self.step_at_ns / 1e9:.1f} s: a clock was set, the route changed, or a "
                "queue stays full; delays before and after it may not be comparable"
            )
        elif self.drift_ppm is None:
            lines.append("the drift between the clocks could not be estimated, and is not removed")
        return lines


def relative_delays(trace: PacketTrace) -> PacketTrace:
    """Return the trace with relative delays, without drift; the smallest delay is 0."""
    here = np.flatnonzero(~trace.lost)
    if not len(here):
        return trace
    sent_ns = trace.sent_ns[here]
    delay_ns = trace.received_ns[here] - sent_ns
    delay_ns = delay_ns - delay_ns.min()
    step_ns, step_at_ns = _step(sent_ns, delay_ns)
    slope = 0.0 if step_ns or len(here) < _FEWEST else envelope_slope(sent_ns, delay_ns)
    is_plausible = 0 < abs(slope) <= MOST_DRIFT_PPM * 1e-6
    if is_plausible:
        delay_ns = delay_ns - np.rint(slope * sent_ns).astype(np.int64)
    received = np.full(len(trace), LOST_NS)
    received[here] = sent_ns + delay_ns - delay_ns.min()
    known = slope * 1e6 if is_plausible or (slope == 0 and len(here) >= _FEWEST) else None
    comparison = ClockComparison(None if step_ns else known, step_ns, step_at_ns)
    return replace(trace, received_ns=received).noted(*comparison.lines())


def envelope_slope(t: NDArray[np.int64], y: NDArray[np.int64]) -> float:
    """Return the slope of the lower envelope of points (t, y); ``t`` does not descend.

    The line a·t + b below all points with the smallest Σ(y − a·t − b) has the largest value at the
    mean of t. So it is the edge of the lower convex hull above this place.
    """
    if t[0] == t[-1]:
        return 0.0
    mean = float(np.mean(t.astype(float)))
    kept = _lowest_of_each_bucket(t, y)
    hull: list[tuple[float, float]] = []
    for point in zip(t[kept].astype(float).tolist(), y[kept].astype(float).tolist(), strict=True):
        while len(hull) > 1 and _cross(hull[-2], hull[-1], point) <= 0:
            hull.pop()
        hull.append(point)
    rising = [
        (b[1] - a[1]) / (b[0] - a[0]) for a, b in pairwise(hull) if b[0] >= mean and b[0] > a[0]
    ]
    return rising[0] if rising else 0.0


def _cross(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _lowest_of_each_bucket(t: NDArray[np.int64], y: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the places of the lowest point in each of 4096 parts of the time, ascending."""
    width = (int(t[-1]) - int(t[0])) // _BUCKETS + 1
    bucket = (t - t[0]) // width
    order = np.lexsort((y, bucket))
    return np.sort(order[np.flatnonzero(np.diff(bucket[order], prepend=-1))])


def _step(sent_ns: NDArray[np.int64], delay_ns: NDArray[np.int64]) -> tuple[int, int]:
    """Return the largest permanent change of the smallest delay, and when; 0 if drift explains it.

    For each place the smallest delay before it is compared with the smallest delay after it.
    """
    few = max(_FEWEST, len(sent_ns) // 10)
    if len(sent_ns) < 2 * few:
        return 0, 0
    before = np.minimum.accumulate(delay_ns)[few - 1 : -few]
    after = np.minimum.accumulate(delay_ns[::-1])[::-1][few : len(delay_ns) - few + 1]
    change = after - before
    largest = int(change[np.argmax(np.abs(change))])
    allowed = _STEP_NS + MOST_DRIFT_PPM * 1e-6 * int(sent_ns[-1] - sent_ns[0])
    if abs(largest) <= allowed:
        return 0, 0
    # An increase shows at all places after it, a decrease at all places before it.
    places = np.flatnonzero(2 * np.abs(change) > abs(largest))
    return largest, int(sent_ns[few + (places[0] if largest > 0 else places[-1])])
