"""A run of the paper's loop in continuous time, for a given loss pattern."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cosim.simulation.continuous.continuous_loop import (
    ContinuousLoop,
    LoopState,
    Samples,
    reset,
    vanished,
    vanishes_s,
)
from cosim.simulation.exact_simulation import DIVERGED, OK, TOO_MANY_EVENTS, EventLog
from noack.core.core_library import core
from noack.core.errors import CallerError
from noack.core.linear_systems import Vector

MAX_EVENTS = 100_000
_PLACES = 512
"""Room for events in the first attempt; each further one has four times as much."""


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

    @cached_property
    def starts(self) -> NDArray[np.float64]:
        """(x, e_s, e_c) at the start and just after each event, (k + 1, 3, n)."""
        return np.array([state[1:] for state in (self.start, *self.after)])

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
        return self.system.follow(np.array([0.0, *self.event_s]), self.starts, t_s)

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
        delivered: whether the update of event i arrives, asked in the order of the events. If a
            sequence is shorter than the number of events, all updates after its end arrive.
        known_start: sensor and controller start from x(0). Otherwise x_c = 0 and event 0 happens at
            t = 0, the paper's t_0; the paper assumes that it is delivered.
        x0: x(0), shape (n,); by default the loop's own.
        max_events: largest number of events.

    Raises:
        TooManyEventsError: more than ``max_events`` events, or two at the same time.
        CallerError: the threshold decays below the smallest supported value before the horizon, or
            the run cannot be decided.
    """
    loop, fates = system.loop, [] if callable(delivered) else list(delivered)
    until_s = min(horizon_s, vanishes_s(system.trigger, loop.n))
    x0, places = np.array(loop.x0 if x0 is None else x0, np.float64), min(_PLACES, max_events)
    while True:
        if callable(delivered):
            fates += [bool(delivered(event)) for event in range(len(fates), places)]
        simulation = system.simulation(
            until_s, known_start=known_start, most_events=places, delivered=np.array(fates, bool),
            measure=core.NOACK_EXACT_TIMES,
        )  # fmt: skip
        rows, log = simulation.runs(
            loop.A[None], loop.B[None], x0[None], places=places, states=True
        )
        row = rows[0]
        full = row["status"] == TOO_MANY_EVENTS and row["transmissions"] == places
        if not full or places == max_events:
            break
        places = min(4 * places, max_events)
    if row["status"] == OK and until_s < horizon_s:
        raise vanished(until_s)
    if row["status"] not in (OK, DIVERGED, TOO_MANY_EVENTS):
        raise CallerError(
            f"trigger: a million steps do not decide event {row['transmissions']}: an error stays "
            "too close to its threshold, or the plant is too fast"
        )
    diverged_at_s = float(row["diverged_at_s"]) if row["status"] == DIVERGED else None
    run = _run(system, horizon_s, x0, log, int(row["transmissions"]), diverged_at_s, known_start)
    if row["status"] == TOO_MANY_EVENTS:
        last_s = run.event_s[-1] if len(run.event_s) else 0.0
        too_many = TooManyEventsError(
            f"trigger: event {len(run.event_s)}, after {last_s:.9g} s, is one too many: the events "
            "accumulate; a stable loop, a larger threshold or a floor would keep them apart"
        )
        too_many.run = replace(run, horizon_s=float(last_s))
        raise too_many
    return run


def _run(
    system: ContinuousLoop, horizon_s: float, x0: Vector, log: EventLog, events: int,
    diverged_at_s: float | None, known_start: bool,
) -> ContinuousRun:  # fmt: skip
    """Read a run from its events."""
    assert log.states is not None
    delivered, zero = log.delivered[0, :events], np.zeros_like(x0)
    times_s, states = log.event_s[0, :events].tolist(), log.states[0, :events]
    start = LoopState(0.0, x0, zero, zero if known_start else -x0)
    before = tuple(map(LoopState, times_s, *np.moveaxis(states, 1, 0)))
    after = tuple(map(reset, before, delivered.tolist()))
    return ContinuousRun(system, horizon_s, start, before, after, delivered, diverged_at_s)
