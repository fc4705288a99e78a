"""What losses per interval say about a network: loss rate, whether losses come in bursts, how long ones.

The interval of the loss rate is that of a ratio of sums, p = Σl/Σk over the n intervals with l of k
packets lost (Cochran, Sampling Techniques, 1977, Section 6.3): losses may depend on each other within an
interval. Whether they vary more from interval to interval than independent losses is the χ² test of
homogeneity, Σ (l − pk)²/(k p (1 − p)) with n − 1 degrees of freedom.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import stats

from netem.measurement.chain_fits import SIGNIFICANCE, FitTest
from netem.measurement.interval_estimates import LEVEL, IntervalEstimate, binomial_estimate
from netem.traces.iperf3_report import LossInterval, Stream

_FEWEST = 5
"""Intervals below which their spread says nothing."""


@dataclass(frozen=True)
class StreamLosses:
    """The losses of a stream, as far as intervals show them."""

    stream: Stream

    @property
    def _counted(self) -> Sequence[LossInterval]:
        return [interval for interval in self.stream.intervals if interval.packets]

    @property
    def is_by_interval(self) -> bool:
        """Whether there are enough intervals to see how losses vary between them."""
        return len(self._counted) >= _FEWEST

    @cached_property
    def loss_rate(self) -> IntervalEstimate | None:
        """Loss rate with its 95 % interval; for independent losses, if there are few intervals."""
        if not self.is_by_interval:
            return binomial_estimate(min(self.stream.lost, self.stream.packets), self.stream.packets)
        packets, lost = np.array([(interval.packets, interval.lost) for interval in self._counted], float).T
        count, rate = len(packets), lost.sum() / packets.sum()
        spread = math.sqrt(((lost - rate * packets) ** 2).sum() * count / (count - 1)) / packets.sum()
        half = float(stats.t.ppf((1 + LEVEL) / 2, count - 1)) * spread
        return IntervalEstimate(float(rate), max(float(rate) - half, 0.0), min(float(rate) + half, 1.0))

    @cached_property
    def dispersion_test(self) -> FitTest:
        """Whether losses vary between intervals as independent ones do."""
        packets, lost = np.array([(i.packets, i.lost) for i in self._counted], float).reshape(-1, 2).T
        total = packets.sum()
        rate = lost.sum() / total if total else 0.0
        if not self.is_by_interval or not 0 < rate < 1 or lost.sum() < _FEWEST:
            return FitTest(None, 0, None, "losses per interval")
        statistic = float((((lost - rate * packets) ** 2) / (packets * rate * (1 - rate))).sum())
        degrees = len(packets) - 1
        return FitTest(statistic, degrees, float(stats.chi2.sf(statistic, degrees)), "losses per interval")

    @property
    def bursts_text(self) -> str:
        """What this says about bursts."""
        p_value = self.dispersion_test.p_value
        if p_value is None:
            return "not known: too few losses or intervals"
        if p_value < SIGNIFICANCE:
            return f"losses vary more between intervals than independent ones (p = {p_value:.2g})"
        return f"losses vary between intervals as independent ones do (p = {p_value:.2g})"

    @cached_property
    def least_longest_burst(self) -> int:
        """A lower limit of the longest loss burst: so many losses cannot all be farther apart.

        With l of k packets lost, k − l deliveries leave k − l + 1 places for bursts. Intervals in a row
        of which all packets are lost are one burst.
        """
        longest = all_lost = 0
        for interval in self._counted:
            delivered = interval.packets - interval.lost
            all_lost = 0 if delivered else all_lost + interval.packets
            longest = max(longest, all_lost, math.ceil(interval.lost / (delivered + 1)))
        return max(longest, min(self.stream.lost, 1))

    @property
    def worst(self) -> LossInterval | None:
        """The interval with the largest share of losses."""
        return max(self._counted, key=lambda one: (one.lost / one.packets, one.lost), default=None)

    def to_json(self) -> dict[str, object]:
        """Return all of this for JSON."""
        rate, worst = self.loss_rate, self.worst
        return {
            "stream": self.stream.number,
            "packets": self.stream.packets,
            "lost": self.stream.lost,
            "out_of_order": self.stream.out_of_order,
            "loss_rate": None if rate is None else rate._asdict(),
            "intervals": len(self.stream.intervals),
            "worst_interval": None if worst is None else worst._asdict(),
            "bursts": self.bursts_text,
            "dispersion_p": self.dispersion_test.p_value,
            "longest_burst_at_least": self.least_longest_burst,
            "jitter_s": self.stream.jitter_s,
            "largest_jitter_s": max(
                (interval.jitter_s for interval in self.stream.intervals), default=self.stream.jitter_s
            ),
        }
