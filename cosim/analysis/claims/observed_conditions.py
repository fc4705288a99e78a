"""Under which conditions a run really took place, in the plant's time."""

from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.theory.certificate import NetworkConditions

_TOLERANCE_S = 1e-9

Reals = NDArray[np.float64]


Left = tuple[float, str] | None
"""When a run left the conditions of a claim, and how; None if it never did."""

CAUSES = {
    "dropouts": "{:.0f} updates lost in a row, {:.0f} allowed",
    "sampling": "no measurement for {:.4g} s, {:.4g} s allowed",
    "delay": "an update was felt after {:.4g} s, {:.4g} s allowed",
    "hold": "an input was {:.4g} s old, {:.4g} s allowed",
    "start": "the plant felt no input until {:.4g} s, {:.4g} s allowed",
    "watchdog": "the input was the watchdog's: the newest actuation was {:.4g} s old, "
    "{:.4g} s allowed",
    "safe input": "the input was the controller's safe one, up to {:.4g}: it knew no state",
    "restart": "the sensor was started anew: what it transmits first is no event of the trigger",
}
"""How conditions can be left, and how that is said, of the worst value and the limit."""


class SampledSeries(NamedTuple):
    """A condition's value over time: k values, each known from its time on."""

    t_s: Reals
    value: Reals

    def largest(self) -> float | None:
        """The largest value; None if there is none."""
        return float(self.value.max()) if len(self.value) else None


class PacketLosses(NamedTuple):
    """The events, and which of their updates never came."""

    t_s: Reals
    """(k,)"""
    made_up_s: Reals
    """(k,) After which time the plant felt a newer update instead: infinite if the update was
    dropped, 0 if it came or was still to come; in between if it was overtaken."""

    def runs(self, delay_s: float, before: int = 0) -> SampledSeries:
        """Successive losses at every event; what was overtaken within ``delay_s`` is not lost.

        Args:
            delay_s: how late an update may be felt.
            before: losses up to these events.
        """
        runs, run = [], before
        for made_up_s in self.made_up_s.tolist():
            lost = made_up_s == np.inf or made_up_s > delay_s + _TOLERANCE_S
            run = run + 1 if lost else 0
            runs.append(run)
        return SampledSeries(self.t_s, np.array(runs, dtype=np.float64))


class AssumptionViolation(NamedTuple):
    """How a run left the conditions in one respect."""

    t_s: float
    """When it first did."""
    cause: str
    """One of ``CAUSES``."""
    worst: float
    limit: float

    @property
    def text(self) -> str:
        """In words."""
        return CAUSES[self.cause].format(self.worst, self.limit)


class ObservedConditions(NamedTuple):
    """What :class:`noack.theory.certificate.NetworkConditions` presupposes, as it was."""

    losses: PacketLosses
    """Updates that the controller never took."""
    sampling: SampledSeries
    """Time since the measurement before, in seconds, at every measurement."""
    delay: SampledSeries
    """From an event until the controller had its update and the plant felt it, at the event."""
    hold: SampledSeries
    """How far the model's time behind the input was from now at most, at every step."""
    start_s: float
    """When the plant began to feel the controller; infinite if never."""
    watchdog: SampledSeries
    """Age of the newest actuation at every step whose input was the watchdog's instead."""
    safe_input: SampledSeries
    """Largest entry of the input at every step whose input was of a controller without a state:
    one other than 0 before the plant felt the controller, and any after that."""
    restarts: SampledSeries
    """At the first measurement of every sensor that took another's place: its generation."""
    timeout_s: float
    """Age at which the watchdog acts."""

    def departures(
        self, conditions: NetworkConditions, causes: Collection[str] = tuple(CAUSES), run: int = 0
    ) -> list[AssumptionViolation]:
        """In which respects the conditions were left.

        Args:
            conditions: the conditions.
            causes: which respects count.
            run: updates that were lost in a row before.
        """
        start = SampledSeries(np.zeros(1), np.array([self.start_s]))
        every: dict[str, tuple[SampledSeries, float]] = {
            "dropouts": (self.losses.runs(conditions.delay_s, run), conditions.dropouts),
            "sampling": (self.sampling, conditions.sampling_s),
            "delay": (self.delay, conditions.delay_s),
            "hold": (self.hold, conditions.hold_s),
            "start": (start, conditions.start_s),
            "watchdog": (self.watchdog, self.timeout_s),
            "safe input": (self.safe_input, -1.0),  # any at all
            "restart": (self.restarts, 0.0),
        }
        found = []
        for cause, (series, limit) in every.items():
            beyond = np.flatnonzero(series.value > limit + _TOLERANCE_S)
            if cause in causes and len(beyond):
                first_s, worst = float(series.t_s[beyond[0]]), float(series.value.max())
                found.append(AssumptionViolation(first_s, cause, worst, limit))
        return found

    def left(self, conditions: NetworkConditions, causes: Collection[str] = tuple(CAUSES)) -> Left:
        """When and how the run first left the conditions; None if it never did."""
        return earliest(self.departures(conditions, causes))

    def summary(self) -> dict[str, float | None]:
        """The largest value of each condition."""
        return {
            "dropouts": self.losses.runs(0.0).largest(),
            "sampling_s": self.sampling.largest(),
            "delay_s": self.delay.largest(),
            "hold_s": self.hold.largest(),
            "start_s": self.start_s if np.isfinite(self.start_s) else None,
        }


def earliest(departures: Collection[AssumptionViolation]) -> Left:
    """When and how the conditions were first left; None if they were not."""
    return min(((one.t_s, one.text) for one in departures), default=None)
