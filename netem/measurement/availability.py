"""Availability of a service that needs a message per transfer interval, as 3GPP TS 22.104 has it.

A message is expected in each transfer interval T. After a loss, the application goes on for the
survival time S. If the next message is not there by then, the service has failed, until a message
arrives: j messages lost in a row are a failure if jT > S, and the service is then unavailable for
jT − S. Availability is the share of the time in which the service is available, and the mean time
between failures the mean time for which it is available before it fails.

With n = ⌊S/T⌋ losses survived, the matrices D₀, D₁ of a chain and its stationary π
(:mod:`netem.measurement.chain_fits`), a message is the i-th one lost in a row with probability
q_i = π D₀ D₁^i 1. So failures begin with probability q_{n+1} per message, and the service is
unavailable for the share Σ_{i>n} q_i − (S/T − n) q_{n+1}, with Σ_{i>n} q_i = π D₀ D₁^{n+1} (I − D₁)⁻¹ 1.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import stats

from netem.core.errors import CallerError
from netem.core.number_checks import real_number
from netem.measurement.chain_fits import ChainRates
from netem.measurement.interval_estimates import LEVEL, poisson_estimate
from netem.measurement.loss_bursts import LossBursts
from netem.traces.packet_trace import Int64s, PacketTrace

_LONGEST_S = 1e8
_ROUNDING = 1e-9
"""Share by which a survival time may miss a whole number of intervals, since times are decimals."""
_SAME = 0.01
"""Share by which a transfer interval may differ from the trace's period, to be that of its packets."""
_MOST_SURVIVED = 10_000_000


@dataclass(frozen=True)
class Service:
    """What an application needs of the network."""

    interval_s: float
    """Transfer interval: the time between two messages."""
    survival_s: float
    """Survival time: how long the application goes on without an expected message."""

    def __post_init__(self) -> None:
        """Raise CallerError for a time that is out of range."""
        real_number("interval", self.interval_s, above=0.0, most=_LONGEST_S)
        if real_number("survival", self.survival_s, most=_LONGEST_S) < 0:
            raise CallerError(f"survival {self.survival_s:g} s: must be 0 or more")
        if self.survival_s / self.interval_s > _MOST_SURVIVED:
            raise CallerError(
                f"survival {self.survival_s:g} s: more than {_MOST_SURVIVED:,} transfer intervals of "
                f"{self.interval_s:g} s"
            )

    @property
    def survived(self) -> int:
        """n: how many messages lost in a row the application survives."""
        return math.floor(self.survival_s / self.interval_s * (1 + _ROUNDING))

    @property
    def rest(self) -> float:
        """S/T − n: the part of an interval by which the survival time is longer."""
        return max(self.survival_s / self.interval_s - self.survived, 0.0)


class ChainAvailability(NamedTuple):
    """Availability under a chain, exactly."""

    unavailability: float
    """Share of the time in which the service is not available."""
    failures_per_message: float
    mean_time_between_failures_s: float
    """Infinite if there are no failures."""

    @property
    def availability(self) -> float:
        """Share of the time in which the service is available."""
        return 1 - self.unavailability


def chain_availability(rates: ChainRates, service: Service) -> ChainAvailability:
    """Return the availability of a service whose messages are lost as a Gilbert–Elliott chain says.

    Independent losses are the chain with the same loss probability in both states.
    """
    start, delivers, loses = rates.matrices()
    if rates.loss_rate >= 1:
        return ChainAvailability(1.0, 0.0, 0.0)
    entry = start @ delivers @ loses @ np.linalg.matrix_power(loses, service.survived)
    failures = float(entry.sum())
    lost_longer = float(np.linalg.solve((np.eye(2) - loses).T, entry).sum())
    unavailability = max(lost_longer - service.rest * failures, 0.0)
    available_s = (1 - unavailability) * service.interval_s
    return ChainAvailability(unavailability, failures, available_s / failures if failures else math.inf)


class OpenInterval(NamedTuple):
    """A value with its confidence interval; an end that is None is not known."""

    value: float
    low: float | None
    high: float | None


@dataclass(frozen=True)
class ObservedAvailability:
    """Availability of a service in a trace, with 95 % intervals.

    The intervals take the times for which the service is available, and those for which it is not,
    as exponential and independent of each other: the number of failures is then Poisson distributed
    (Garwood, 1936), and the ratio of the mean times follows an F distribution.
    """

    messages: int
    failures: int
    observed_s: float
    unavailable_s: float

    @property
    def unavailability(self) -> float:
        """Share of the time in which the service was not available."""
        return self.unavailable_s / self.observed_s

    @property
    def availability(self) -> OpenInterval:
        """Share of the time in which the service is available."""
        count, available_s = self.failures, self.observed_s - self.unavailable_s
        value = 1 - self.unavailability
        if not count:
            return OpenInterval(value, None, 1.0)
        if available_s <= 0:
            return OpenInterval(value, 0.0, None)
        ratio, tail = self.unavailable_s / available_s, (1 + LEVEL) / 2
        most = ratio * float(stats.f.ppf(tail, 2 * count + 2, 2 * count))
        least = ratio / float(stats.f.ppf(tail, 2 * count, 2 * count))
        return OpenInterval(value, 1 / (1 + most), 1 / (1 + least))

    @property
    def mean_time_between_failures_s(self) -> OpenInterval:
        """Mean time for which the service is available before it fails; infinite without failures."""
        available_s = self.observed_s - self.unavailable_s
        if available_s <= 0:
            return OpenInterval(0.0, 0.0, None)
        rate = poisson_estimate(self.failures, available_s)
        value = 1 / rate.value if rate.value else math.inf
        return OpenInterval(value, 1 / rate.high, 1 / rate.low if rate.low else None)


def observed_availability(bursts: LossBursts, service: Service) -> ObservedAvailability:
    """Return the availability of a service whose messages were lost in bursts."""
    losses = bursts.length[bursts.length > service.survived]
    beyond = float((losses - service.survived).sum()) - service.rest * len(losses)
    interval_s = service.interval_s
    return ObservedAvailability(
        bursts.packets, len(losses), bursts.packets * interval_s, max(beyond, 0.0) * interval_s
    )


def message_indices(trace: PacketTrace, interval_s: float | None) -> tuple[Int64s, float]:
    """Return which packets of a trace are the messages of a service, (m,), and their interval.

    With an interval that is longer than the trace's period, they are the packets sent nearest to its
    multiples. None: all packets, with their mean period.

    Raises:
        CallerError: the interval is shorter than the trace's period, or the trace is too short.
    """
    if interval_s is not None:
        real_number("interval", interval_s, above=0.0, most=_LONGEST_S)
    count = len(trace)
    period_s = float(trace.sent_ns[-1]) * 1e-9 / max(count - 1, 1)
    if period_s <= 0:
        raise CallerError("--survival: needs a trace of packets that are sent at different times")
    if interval_s is None or abs(interval_s / period_s - 1) <= _SAME:
        return np.arange(count), period_s if interval_s is None else interval_s
    if interval_s < period_s:
        raise CallerError(
            f"--interval {interval_s:g} s: shorter than the time between two packets of the trace, "
            f"{period_s:.3g} s on average; what became of messages between them is not known"
        )
    times_ns = np.arange(0, int(trace.sent_ns[-1]) + 1, max(round(interval_s * 1e9), 1))
    after = np.minimum(np.searchsorted(trace.sent_ns, times_ns), count - 1)
    before = np.maximum(after - 1, 0)
    is_before = times_ns - trace.sent_ns[before] < trace.sent_ns[after] - times_ns
    return np.unique(np.where(is_before, before, after)), interval_s


def to_json(
    service: Service, observed: ObservedAvailability, model: ChainAvailability | None
) -> Mapping[str, object]:
    """Return both for JSON, where infinity is null."""
    by_model = model and {
        "availability": model.availability,
        "unavailability": model.unavailability,
        "mean_time_between_failures_s": _finite(model.mean_time_between_failures_s),
    }
    return {
        "transfer_interval_s": service.interval_s,
        "survival_time_s": service.survival_s,
        "losses_survived": service.survived,
        "messages": observed.messages,
        "failures": observed.failures,
        "availability": observed.availability._asdict(),
        "mean_time_between_failures_s": {
            name: None if value is None else _finite(value)
            for name, value in observed.mean_time_between_failures_s._asdict().items()
        },
        "by_preferred_model": by_model,
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
