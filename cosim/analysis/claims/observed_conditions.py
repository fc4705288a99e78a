"""The conditions under which a run took place, in the plant's time."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.conformance.input_origins import SampledSeries
from netem.guarantee.loss_guarantee import LongestBurst, LossRule
from noack.theory.certificates.conditions import NetworkConditions

_TOLERANCE_S = 1e-9
"""Times in seconds have rounding errors below this."""

Reals = NDArray[np.float64]


class PacketLosses(NamedTuple):
    """The events, and the losses among their updates."""

    t_s: Reals
    """(k,)"""
    replaced_after_s: Reals
    """(k,) Time until a newer update took effect instead: infinite if the update was dropped, 0 if
    it was delivered or in flight, in between if it was delivered out of order (stale)."""

    def consecutive(self, delay_s: float) -> SampledSeries:
        """Consecutive losses up to every event."""
        return self.values(LongestBurst(0), delay_s)

    def values(self, rule: LossRule, delay_s: float) -> SampledSeries:
        """The values of a rule at every event.

        An update that was replaced within the allowed delay is not lost.
        """
        values, state = [], rule.start
        for replaced_s in self.replaced_after_s.tolist():
            lost = replaced_s == np.inf or replaced_s > delay_s + _TOLERANCE_S
            state, value = rule.after(state, lost)
            values.append(value)
        return SampledSeries(self.t_s, np.array(values, dtype=np.float64))


class ObservedConditions(NamedTuple):
    """The conditions of :class:`noack.theory.certificates.conditions.NetworkConditions`, as observed."""

    losses: PacketLosses
    """Updates that the controller never received, or received too late."""
    sampling: SampledSeries
    """Time since the measurement before, in seconds, at every measurement."""
    delay: SampledSeries
    """Time from each event until the plant applied an input computed with its update, after the
    first input: until then it is part of ``start_s``."""
    hold: SampledSeries
    """Largest age of the applied input, per step."""
    lead: SampledSeries
    """By how much the applied input was computed for a later time, at the steps at which it was."""
    start_s: float
    """Time at which the plant applied the first input of a controller with a state, or infinity."""
    watchdog: SampledSeries
    """Age of the newest actuation at every step at which the watchdog replaced the input."""
    safe_input: SampledSeries
    """Largest entry of the input, if it is not 0, at every step at which it came from a controller
    without a state, before ``start_s``."""
    early_messages: Mapping[str, SampledSeries] = MappingProxyType({})
    """By receiving process: by how much messages were received before they were sent, in a run with several
    clocks."""
    allowed_leads_s: Mapping[str, float] = MappingProxyType({})
    """By receiving process: the largest such times that the bounds of both clocks explain."""
    clock_error_s: float | None = None
    """Largest error that a clock may have had at the start."""
    reached_s: float = np.inf
    """The end of the run, once it is known."""
    early: SampledSeries = SampledSeries(np.zeros(0), np.zeros(0))
    """Model time at which an update reset x_c, in seconds, by the earlier time at which the plant
    first applied an input computed with it: its step was late, or the controller's clock ahead."""
    waiting: SampledSeries = SampledSeries(np.zeros(0), np.zeros(0))
    """Time at which the plant first applied an input computed with an update, infinite for never, by the
    earlier model time at which the update reset x_c, in seconds."""
    first_delay_s: float | None = None
    """Largest time from an event to the first input, if that was computed with the event's update."""

    def _first_input(self, limit_s: float) -> SampledSeries:
        """The time of the first input, at t = 0; 0 if the run ended before that had to come."""
        ended_before = self.start_s == np.inf and 0.0 < self.reached_s <= limit_s
        return SampledSeries(np.zeros(1), np.array([0.0 if ended_before else self.start_s]))

    def first_broken_rule(self, conditions: NetworkConditions) -> tuple[float, str] | None:
        """Return when the losses first broke a rule of a guarantee, and the rule's name; None if never."""
        broken = []
        for rule in conditions.guarantee.rules:
            excess = self.losses.values(rule, conditions.delay_s).excess(rule.limit)
            if excess is not None:
                broken.append((excess.first_s, rule.name))
        return min(broken, default=None)

    def widen(self, allowed: NetworkConditions, until_s: float = np.inf) -> NetworkConditions:
        """Return conditions that the run's schedule meets up to a time.

        Each time is the allowed one, or what the run took, if that was more. It is not met where an input
        never came. A bound that is proved for such times is one of this run, too.
        """

        def larger(limit_s: float, series: SampledSeries) -> float:
            values_s = series.before(until_s).value
            value_s = float(values_s[np.isfinite(values_s)].max(initial=0.0))
            return value_s if value_s > limit_s + _TOLERANCE_S else limit_s

        return allowed._replace(
            delay_s=larger(allowed.delay_s, self.delay),
            hold_s=larger(allowed.hold_s, self.hold),
            lead_s=larger(allowed.lead_s, self.lead),
            start_s=larger(allowed.start_s, self._first_input(allowed.start_s)),
        )

    def _largest_delay_s(self) -> float | None:
        """The largest time from an event to the plant, that of the first update included."""
        delays_s = (self.first_delay_s, self.delay.largest())
        return max((delay_s for delay_s in delays_s if delay_s is not None), default=None)

    def summary(self) -> dict[str, float | None]:
        """The largest value of each condition."""
        return {
            LongestBurst(0).name: self.losses.consecutive(0.0).largest(),
            "sampling_s": self.sampling.largest(),
            "delay_s": self._largest_delay_s(),
            "hold_s": self.hold.largest(),
            "lead_s": None if self.hold.largest() is None else self.lead.largest() or 0.0,
            "start_s": self.start_s if np.isfinite(self.start_s) else None,
            "clock_error_s": self.clock_error_s,
        }
