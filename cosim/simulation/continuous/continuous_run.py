"""A run of the paper's loop in continuous time, for a given loss pattern."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cosim.simulation.continuous.continuous_loop import ContinuousLoop, LoopState, Samples, reset
from cosim.simulation.continuous.event_detector import DivergedError
from noack.core.errors import CallerError
from noack.core.linear_systems import Vector

MAX_EVENTS = 100_000


class TooManyEventsError(CallerError):
    """The events accumulate: inter-event times tend to 0."""

    run: "ContinuousRun | None" = None
    """The run up to its last event; None if the events are not those of one run."""


@dataclass(frozen=True)
class ContinuousRun:
    """An exact run: k events, n states; event i is update number i."""

    system: ContinuousLoop
    horizon_s: float
    start: LoopState
    """At t = 0, before any event."""
    before: tuple[LoopState, ...]
    """At each event, just before the reset."""
    after: tuple[LoopState, ...]
    """At each event, just after the reset."""
    delivered: NDArray[np.bool_]
    """Whether the update of each event arrived, (k,)."""
    diverged_at_s: float | None
    """Time at which the state exceeded 1e100, or None; the run is computed up to this time."""

    @cached_property
    def event_s(self) -> Vector:
        """Times of the events, (k,)."""
        return np.array([state.t_s for state in self.before])

    @property
    def reached_s(self) -> float:
        """The run is computed up to this time."""
        return self.horizon_s if self.diverged_at_s is None else self.diverged_at_s

    def at(self, t_s: Vector | Sequence[float]) -> Samples:
        """Return the loop at many times, right-continuous: at an event, the state after the reset.

        Raises:
            ValueError: a time is out of range, or the times are not in ascending order.
        """
        t_s = np.asarray(t_s, dtype=np.float64)
        if len(t_s) and not (t_s[0] >= 0 and t_s[-1] <= self.reached_s):
            raise ValueError(f"times must lie in [0, {self.reached_s}] s")
        if (np.diff(t_s) < 0).any():
            raise ValueError("times must be in ascending order")
        states = (self.start, *self.after)
        bounds = np.searchsorted(t_s, self.event_s)
        parts = [
            self.system.sample(state, part)
            for state, part in zip(states, np.split(t_s, bounds), strict=True)
            if len(part)
        ]
        empty = np.empty((0, self.system.loop.n))
        x, e_s, e_c = (
            np.concatenate([empty, *(getattr(part, name) for part in parts)])
            for name in ("x", "e_s", "e_c")
        )
        return Samples(t_s, x, e_s, e_c)

    def e_s_norm(self, samples: Samples) -> Vector:
        """‖W e_s‖ of samples, (k,)."""
        return self.system.norms(samples.e_s)

    def e_c_norm(self, samples: Samples) -> Vector:
        """‖W e_c‖ of samples, (k,)."""
        return self.system.norms(samples.e_c)


def simulate_continuous(
    system: ContinuousLoop,
    *,
    horizon_s: float,
    delivered: Callable[[int], bool] | Sequence[bool],
    known_start: bool,
    x0: Vector | None = None,
    max_events: int = MAX_EVENTS,
) -> ContinuousRun:
    """Run the loop from t = 0; every event time is exact up to rounding.

    Args:
        system: the loop.
        horizon_s: end of the run.
        delivered: whether the update of event i arrives. If a sequence is shorter than the number
            of events, all updates after its end arrive.
        known_start: sensor and controller start from x(0). Otherwise x_c = 0 and event 0 happens at
            t = 0, the paper's t_0; the paper assumes that it is delivered.
        x0: x(0), shape (n,); by default the loop's own.
        max_events: largest number of events.

    Raises:
        TooManyEventsError: more than ``max_events`` events, or two at the same time.
        CallerError: the threshold decays below the smallest supported value before the horizon.
    """
    x = np.array(system.loop.x0 if x0 is None else x0, dtype=np.float64)
    zero = np.zeros_like(x)
    arrives = delivered if callable(delivered) else _pattern(delivered)
    start = state = LoopState(0.0, x, zero, zero if known_start else -x)
    before: list[LoopState] = []
    after: list[LoopState] = []
    fates: list[bool] = []
    diverged_at_s, auxiliary = None, system.trigger.initial_dynamic_variable
    event = None if known_start else start
    while True:
        if event is not None:
            fates.append(bool(arrives(len(before))))
            state = reset(event, fates[-1])
            before.append(event)
            after.append(state)
        condition = system.condition(state)
        if condition.integrates:
            auxiliary = 0.0
        try:
            crossing = system.next_crossing(state, horizon_s, condition, auxiliary)
            event, auxiliary = (None, 0.0) if crossing is None else crossing
        except DivergedError as error:
            diverged_at_s = error.t_s
            break
        if event is None:
            break
        if len(before) >= max_events or (before and event.t_s <= before[-1].t_s):
            too_many = TooManyEventsError(
                f"trigger: event {len(before)} at {event.t_s:.9g} s is one too many: the events "
                "accumulate; a stable loop, a larger threshold or a floor would keep them apart"
            )
            too_many.run = _finished(system, before[-1].t_s, start, before, after, fates)
            raise too_many
    return _finished(system, horizon_s, start, before, after, fates, diverged_at_s)


def _finished(
    system: ContinuousLoop,
    horizon_s: float,
    start: LoopState,
    before: list[LoopState],
    after: list[LoopState],
    fates: list[bool],
    diverged_at_s: float | None = None,
) -> ContinuousRun:
    delivered = np.array(fates, bool)
    return ContinuousRun(
        system, horizon_s, start, tuple(before), tuple(after), delivered, diverged_at_s
    )


def _pattern(delivered: Sequence[bool]) -> Callable[[int], bool]:
    return lambda event: event >= len(delivered) or delivered[event]
