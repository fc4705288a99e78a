"""The conditions under which a run took place, in the plant's time."""

from collections.abc import Collection, Iterable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.guarantee.loss_guarantee import LongestBurst, LossRule
from noack.runtime.host_clocks import RECEIVED, causality_text
from noack.scenario.scenario import Scenario
from noack.theory.certificates.conditions import NetworkConditions, ideal_conditions
from noack.theory.coverage import is_papers_loop

_TOLERANCE_S = 1e-9
"""Times in seconds have rounding errors below this."""

Reals = NDArray[np.float64]


class VoidFrom(NamedTuple):
    """The time from which claims are void: an assumption was violated, or data is missing."""

    t_s: float
    why: str


def clock_cause(role: str) -> str:
    """Return the name of the assumption that no message reached a process before it was sent."""
    return f"{role} clock"


CLOCK_CAUSES = tuple(clock_cause(role) for role in RECEIVED)
"""The assumptions about clocks, on which all claims depend; see ``docs/derivations.md``."""
CAUSES = {
    "sampling": "no measurement for up to {:.4g} s, {:.4g} s allowed",
    "delay": "an update took effect up to {:.4g} s after its event, {:.4g} s allowed",
    "hold": "the applied input was up to {:.4g} s old, {:.4g} s allowed",
    "lead": "the applied input was computed for a time up to {:.4g} s after its step, {:.4g} s allowed",
    "start": "the plant applied its first input at {:.4g} s, {:.4g} s allowed",
    "watchdog": "the watchdog replaced the input: the newest actuation was up to {:.4g} s old, {:.4g} s "
    "allowed",
    "safe input": "the controller had no state and sent its safe input, largest entry {:.4g}",
    **{clock_cause(role): causality_text(role) for role in RECEIVED},
}
"""The assumptions about the schedule, each with the message of a violation: worst value and limit.

The other assumptions are the rules of the guarantee, under their own names; "dropouts" is the limit
of consecutive losses."""
SCHEDULE = ("delay", "hold", "lead", "start")
"""The assumptions about lateness; their limits are ``delay_s`` and so on of the conditions.

A certificate holds for every run that meets its conditions, however they were chosen. So a run that
was later than its scenario allows has the certificate for the times that it took, if there is one.
"""
DROPOUTS = LongestBurst(0).name
_NOT_WITHIN = (
    "an update had not taken effect by the end of the run, {:.4g} s after its event; {:.4g} s allowed"
)
"""In place of the delay of an update that never took effect."""
_NO_INPUT = "the plant applied no input at all; the first was required within {1:.4g} s"
"""In place of a time until the first input, which is the only condition without an upper limit."""


class Excess(NamedTuple):
    """How far a series exceeded a limit."""

    first_s: float
    """The first time above it."""
    worst: float
    """The largest value."""
    worst_at_s: float
    """The time of the largest value."""


class SampledSeries(NamedTuple):
    """A condition's value over time: k values, each determined at its time."""

    t_s: Reals
    value: Reals

    def largest(self) -> float | None:
        """The largest value; None if there is none."""
        return float(self.value.max()) if len(self.value) else None

    def excess(self, limit: float) -> Excess | None:
        """Return how far the values exceed a limit; None if they keep it."""
        beyond = np.flatnonzero(self.value > limit + _TOLERANCE_S)
        if not len(beyond):
            return None
        largest = int(beyond[self.value[beyond].argmax()])
        return Excess(float(self.t_s[beyond[0]]), float(self.value[largest]), float(self.t_s[largest]))

    def before(self, t_s: float) -> "SampledSeries":
        """Return the values before a time."""
        early = self.t_s < t_s
        return SampledSeries(self.t_s[early], self.value[early])


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


class AssumptionViolation(NamedTuple):
    """A run's first violation of one assumption, with the largest excess over the run."""

    t_s: float
    cause: str
    """One of ``CAUSES``, or the name of a rule of the guarantee."""
    worst: float
    text: str
    """The largest excess, in words."""
    worst_at_s: float
    """The time of the largest excess."""


def worst_time(t_s: float, worst_at_s: float | None) -> str:
    """Return in words when the largest excess of a violation was; empty if it was the first."""
    later = worst_at_s is not None and worst_at_s > t_s
    return f" (the worst value at t = {worst_at_s:.3f} s)" if later else ""


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
    timeout_s: float
    """Age at which the watchdog acts."""
    early_messages: Mapping[str, SampledSeries] = MappingProxyType({})
    """By ``CLOCK_CAUSES``: by how much messages were received before they were sent, in a run with
    several clocks."""
    allowed_leads_s: Mapping[str, float] = MappingProxyType({})
    """The largest such times that the bounds of both clocks explain."""
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

    def violations(
        self,
        conditions: NetworkConditions,
        causes: Collection[str] | None = None,
    ) -> list[AssumptionViolation]:
        """The conditions that the run violated, among the ``causes``; by default, among all."""
        violations: list[AssumptionViolation] = []
        for rule in conditions.guarantee.rules:
            if causes is not None and rule.name not in causes:
                continue
            values = self.losses.values(rule, conditions.delay_s)
            if (excess := values.excess(rule.limit)) is not None:
                text = rule.violation(excess.worst)
                violations.append(
                    AssumptionViolation(excess.first_s, rule.name, excess.worst, text, excess.worst_at_s)
                )
        series_and_limits: dict[str, tuple[SampledSeries, float]] = {
            "sampling": (self.sampling, conditions.sampling_s),
            "delay": (self.delay, conditions.delay_s),
            "hold": (self.hold, conditions.hold_s),
            "lead": (self.lead, conditions.lead_s),
            "start": (self._first_input(conditions.start_s), conditions.start_s),
            "watchdog": (self.watchdog, self.timeout_s),
            "safe input": (self.safe_input, -1.0),  # every value is a violation
        }
        for cause, series in self.early_messages.items():
            series_and_limits[cause] = (series, self.allowed_leads_s[cause])
        for cause, (series, limit) in series_and_limits.items():
            if causes is not None and cause not in causes:
                continue
            if (excess := series.excess(limit)) is not None:
                message = _NO_INPUT if excess.worst == np.inf else CAUSES[cause]
                if cause == "delay" and excess.worst_at_s + excess.worst >= self.reached_s - _TOLERANCE_S:
                    message = _NOT_WITHIN
                text = message.format(excess.worst, limit)
                violations.append(
                    AssumptionViolation(excess.first_s, cause, excess.worst, text, excess.worst_at_s)
                )
        return violations

    def first_violation(
        self, conditions: NetworkConditions, causes: Collection[str] | None = None
    ) -> VoidFrom | None:
        """Return the time at which the run first violated a condition; None if never."""
        return earliest(VoidFrom(first.t_s, first.text) for first in self.violations(conditions, causes))

    def widen(self, allowed: NetworkConditions, until_s: float = np.inf) -> NetworkConditions:
        """Return conditions that the run's schedule meets up to a time.

        Each time of ``SCHEDULE`` is the allowed one, or what the run took, if that was more. It is
        not met where an input never came.
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
            DROPOUTS: self.losses.consecutive(0.0).largest(),
            "sampling_s": self.sampling.largest(),
            "delay_s": self._largest_delay_s(),
            "hold_s": self.hold.largest(),
            "lead_s": None if self.hold.largest() is None else self.lead.largest() or 0.0,
            "start_s": self.start_s if np.isfinite(self.start_s) else None,
            "clock_error_s": self.clock_error_s,
        }


def earliest(candidates: Iterable[VoidFrom | None]) -> VoidFrom | None:
    """The first of several; None if there is none."""
    return min(filter(None, candidates), default=None)


def causes_of(scenario: Scenario) -> Collection[str]:
    """The assumptions that claims about a resolved scenario need.

    Certificates need all of them. (I1) needs the measurements, and all claims need the clocks.
    There are no claims about the acknowledgement baseline.
    """
    if scenario.protocol.acknowledges:
        return ()
    if not is_papers_loop(scenario):
        return ("sampling", *CLOCK_CAUSES)
    return (*guarantee_causes(scenario), *CAUSES)


def guarantee_causes(scenario: Scenario) -> Collection[str]:
    """The names of the rules of a resolved scenario's guarantee."""
    return [rule.name for rule in ideal_conditions(scenario).guarantee.rules]
