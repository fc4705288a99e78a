"""The paper's loop in exact continuous time, under any policy.

In the coordinates z = (x, e_s, e_c) with e_s = x_s − x and e_c = x_c − x, the loop between events
is linear and autonomous:

    ẋ   = (A+BK) x + BK e_c
    ė_s = H e_s − E x − BK e_c          E = A + BK − H  (eq:miet_errdyn)
    ė_c = (H−BK) e_c − E x

with H = Â+B̂K in model mode and H = 0 under zero-order hold. An event is the first t > t_i at which
‖W e_s(t)‖ exceeds max(βe^{−αt}, ε) (eq:thre), or at which another policy's comparison holds. There
e_s ← 0, and e_c ← 0 if the update arrives. The core follows the loop (native/exact/).

In this order: the loop, a run of it for given packet fates, the fates that a scenario's network
decides, and the run of ``noack simulate --trigger continuous`` with its summary and JSON document.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from cosim.record.divergence import Divergence, divergence
from cosim.simulation.exact_simulation import (
    DIVERGED,
    MAX_EVENTS,
    OK,
    TOO_MANY_EVENTS,
    EventLog,
    ExactSimulation,
    left_out,
    timeless,
    vanished_error,
    vanishes_s,
)
from netem.core.errors import CallerError, ExitStatus
from netem.core.packet_rows import Fate
from netem.link_state import LinkState
from noack.core.core_library import core
from noack.core.linear_systems import Matrix, Vector
from noack.machines.run_channel import UPDATE_LINK
from noack.scenario.resolution import LoopMatrices, loop_of, rule_of
from noack.scenario.scenario import Scenario
from noack.theory.coverage import require_exact
from noack.trigger_policies.trigger_rule import TriggerRule


class LoopState(NamedTuple):
    """The loop at a time: plant state and both models' errors, each of shape (n,)."""

    t_s: float
    x: Vector
    e_s: Vector
    e_c: Vector


class LoopSamples(NamedTuple):
    """The loop at k times; states of shape (k, n)."""

    t_s: Vector
    x: Matrix
    e_s: Matrix
    e_c: Matrix

    @property
    def x_s(self) -> Matrix:
        """The sensor's model."""
        return self.x + self.e_s

    @property
    def x_c(self) -> Matrix:
        """The controller's model."""
        return self.x + self.e_c


class ContinuousLoop:
    """The loop in continuous time, under any policy."""

    def __init__(self, loop: LoopMatrices, trigger: TriggerRule) -> None:
        self.loop = loop
        self.trigger = trigger
        self._between = self.simulation(0.0, known_start=True)

    def simulation(
        self,
        horizon_s: float,
        *,
        known_start: bool,
        delivered: NDArray[np.bool_] | None = None,
        **numbers: object,
    ) -> ExactSimulation:
        """Return the core's simulation of the loop; the arguments are those of its class."""
        return ExactSimulation(
            self.loop.H,
            self.loop.K,
            self.trigger,
            horizon_s=horizon_s,
            known_start=known_start,
            link=None,
            delivered=delivered,
            **numbers,
        )

    def norms(self, errors: Matrix) -> Vector:
        """‖W e‖ of k errors, shape (k, n) → (k,)."""
        W = self.trigger.weight
        norms: Vector = np.linalg.norm(errors if W is None else errors @ W.T, axis=-1)
        return norms

    def follow(self, start_s: Vector, starts: NDArray[np.float64], t_s: Vector) -> LoopSamples:
        """Return the states at ascending times, of parts that begin just after events.

        Args:
            start_s: ascending, (k,).
            starts: (k, 3, n); the last one up to a time applies.
            t_s: the times, from the first start on.
        """
        t_s = np.asarray(t_s, dtype=np.float64)
        states = self._between.sample(self.loop.A, self.loop.B, start_s, starts, t_s)
        return LoopSamples(t_s, *np.moveaxis(states, 1, 0))


def reset(state: LoopState, delivered: bool) -> LoopState:
    """Return the state after an event: e_s = 0, and e_c = 0 if the update arrives."""
    zero = np.zeros_like(state.e_s)
    return LoopState(state.t_s, state.x, zero, zero if delivered else state.e_c)


def continuous_loop_of(resolved: Scenario) -> ContinuousLoop:
    """Return the exact loop of a resolved scenario.

    Raises:
        CallerError: exact simulation does not support the scenario.
    """
    try:
        resolved.coverage.require_unchanging()
        require_exact(resolved)
    except CallerError as error:
        raise CallerError(f"in continuous time: {error}") from None
    return ContinuousLoop(loop_of(resolved), rule_of(resolved))


_FIRST_LOG_EVENTS = 64
"""Events that the log of the first attempt can hold; that of each further one holds four times as many."""


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

    def at(self, t_s: Vector | Sequence[float]) -> LoopSamples:
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

    def divergence(self, samples: LoopSamples, resolved: Scenario) -> Divergence | None:
        """Return how the run diverged, by samples at evenly spaced times; None if it did not."""
        if self.diverged_at_s is not None:
            return Divergence(self.diverged_at_s, f"diverged at {self.diverged_at_s:g} s")
        return divergence([(samples.t_s, samples.x)], len(samples.t_s), [resolved])

    def e_s_norm(self, samples: LoopSamples) -> Vector:
        """‖W e_s‖ of samples, (k,)."""
        return self.system.norms(samples.e_s)

    def e_c_norm(self, samples: LoopSamples) -> Vector:
        """‖W e_c‖ of samples, (k,)."""
        return self.system.norms(samples.e_c)


def simulate_continuous(
    system: ContinuousLoop,
    *,
    horizon_s: float,
    delivered: Callable[[int], bool] | Sequence[bool],
    known_start: bool,
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
        max_events: largest number of events.

    Raises:
        TooManyEventsError: more than ``max_events`` events, or two at the same time.
        CallerError: the threshold decays below the smallest supported value before the horizon, or
            the run cannot be decided.
    """
    until_s = min(horizon_s, vanishes_s(system.trigger))
    row, log = _simulate_with_log(system, until_s, delivered, known_start, max_events)
    if row["status"] == OK and until_s < horizon_s:
        raise vanished_error(until_s)
    if row["status"] not in (OK, DIVERGED, TOO_MANY_EVENTS):
        raise CallerError(
            f"trigger: a million steps do not decide event {row['transmissions']}: an error stays "
            "too close to its threshold, or the plant is too fast"
        )
    diverged_at_s = float(row["diverged_at_s"]) if row["status"] == DIVERGED else None
    run = _read_run(system, horizon_s, log, int(row["transmissions"]), diverged_at_s, known_start)
    if row["status"] == TOO_MANY_EVENTS:
        last_s = run.event_s[-1] if len(run.event_s) else 0.0
        too_many = TooManyEventsError(
            f"trigger: event {len(run.event_s)}, after {last_s:.9g} s, is one too many: the events "
            "accumulate; a stable loop, a larger threshold or a floor would keep them apart"
        )
        too_many.run = replace(run, horizon_s=float(last_s))
        raise too_many
    return run


def _simulate_with_log(
    system: ContinuousLoop,
    until_s: float,
    delivered: Callable[[int], bool] | Sequence[bool],
    known_start: bool,
    max_events: int,
) -> tuple[np.void, EventLog]:
    """Return the row and the events of a run; it is repeated with a larger log until its events fit."""
    loop, fates = system.loop, [] if callable(delivered) else list(delivered)
    log_events = min(_FIRST_LOG_EVENTS, max_events)
    while True:
        if callable(delivered):
            fates += [bool(delivered(event)) for event in range(len(fates), log_events)]
        simulation = system.simulation(
            until_s,
            known_start=known_start,
            most_events=log_events,
            delivered=np.array(fates, bool),
            measure=core.NOACK_EXACT_TIMES,
        )
        rows, log = simulation.runs(loop.A[None], loop.B[None], loop.x0[None], places=log_events, states=True)
        row: np.void = rows[0]
        full = row["status"] == TOO_MANY_EVENTS and row["transmissions"] == log_events
        if not full or log_events == max_events:
            return row, log
        log_events = min(4 * log_events, max_events)


def _read_run(
    system: ContinuousLoop,
    horizon_s: float,
    log: EventLog,
    events: int,
    diverged_at_s: float | None,
    known_start: bool,
) -> ContinuousRun:
    """Read a run from its events."""
    assert log.states is not None
    x0 = system.loop.x0
    delivered, zero = log.delivered[0, :events], np.zeros_like(x0)
    times_s, states = log.event_s[0, :events].tolist(), log.states[0, :events]
    start = LoopState(0.0, x0, zero, zero if known_start else -x0)
    before = tuple(map(LoopState, times_s, *np.moveaxis(states, 1, 0)))
    after = tuple(map(reset, before, delivered.tolist()))
    return ContinuousRun(system, horizon_s, start, before, after, delivered, diverged_at_s)


def network_fates(resolved: Scenario, loop: int = 0) -> Callable[[int], bool]:
    """Return whether the network delivers update i of a loop, for i = 0, 1, …, as in a live run.

    The emulator's losses and corruption depend only on its seed and on the order of arrival, so
    they can be computed without sending. Delays, rate limits and blackouts do not exist in the
    paper's loop and are ignored. For ``initial_sync = "first_packet"`` update 0 is delivered.
    """
    link = LinkState(timeless(resolved.network.link), resolved.seeds.loss, UPDATE_LINK)
    link.start_flow(0, loop)
    known: list[bool] = []

    def delivered(event: int) -> bool:
        while len(known) <= event:
            known.append(Fate(link.decide(0, 1, 0).fate).effective)
        return known[event]

    return delivered


POINTS = 501
"""Number of evenly spaced times at which the document lists the states."""


def run_continuous(resolved: Scenario, max_events: int = MAX_EVENTS) -> ContinuousRun:
    """Run a resolved scenario in exact continuous time, with the losses of its own network.

    Raises:
        TooManyEventsError: more than ``max_events`` events, or two at the same time.
        CallerError: the scenario is not covered, since its plant is not linear or its network delays;
            or the threshold becomes too small to compute with.
    """
    if kinds := left_out(resolved.network.link):
        raise CallerError(
            f"in continuous time: network.impairments: {kinds}: the network has no delay there; "
            "leave it out: network.impairments=[]"
        )
    return simulate_continuous(
        continuous_loop_of(resolved),
        horizon_s=resolved.horizon_s,
        delivered=network_fates(resolved),
        known_start=resolved.network.initial_sync == "known_state",
        max_events=max_events,
    )


@np.errstate(all="ignore")  # a run may diverge
def document(run: ContinuousRun, resolved: Scenario) -> dict[str, object]:
    """Return the run as JSON: its summary, every event, and the states at 501 times."""
    samples = run.at(np.linspace(0.0, run.reached_s, POINTS))
    states = ("x", "e_s", "e_c")
    return {
        "summary": summary(run, resolved).to_json(),
        "events": [
            {"t_s": state.t_s, "delivered": bool(delivered)}
            | {name: getattr(state, name).tolist() for name in states}
            for state, delivered in zip(run.before, run.delivered, strict=True)
        ],
        "state_names": list(run.system.loop.state_names),
        "samples": {
            **{name: getattr(samples, name).tolist() for name in ("t_s", "x", "x_s", "x_c")},
            "e_s_norm": run.e_s_norm(samples).tolist(),
            "e_c_norm": run.e_c_norm(samples).tolist(),
            "threshold": _thresholds(run, samples),
        },
    }


def _thresholds(run: ContinuousRun, samples: LoopSamples) -> list[float] | None:
    trigger = run.system.trigger
    if not trigger.is_decaying:
        return None
    return [trigger.threshold(1e9 * t_s) for t_s in samples.t_s.tolist()]


class ContinuousSummary(NamedTuple):
    """The run's numbers, with the names of a loop's in ``summary.json``."""

    scenario: str
    mode: str
    mansd: int
    horizon_s: float
    reached_s: float
    events: int
    deliveries: int
    drops: int
    longest_loss_burst: int
    inter_event_min_s: float | None
    inter_event_median_s: float | None
    inter_delivery_median_s: float | None
    initial_state_norm: float
    final_state_norm: float
    sup_state_norm: float
    diverged_at_s: float | None
    exit_status: ExitStatus
    reason: str

    def to_json(self) -> dict[str, object]:
        """The summary as JSON."""
        numbers = self._asdict()
        exit_part = {"status": int(numbers.pop("exit_status")), "reason": numbers.pop("reason")}
        return {"kind": "continuous", **numbers, "exit": exit_part}


def summary(run: ContinuousRun, resolved: Scenario) -> ContinuousSummary:
    """Return the run's numbers."""
    samples = run.at(np.linspace(0.0, run.reached_s, POINTS))
    divergence = run.divergence(samples, resolved)
    arrived = np.flatnonzero(run.delivered)
    loss_bursts = np.diff(arrived, prepend=-1, append=len(run.delivered)) - 1
    return ContinuousSummary(
        scenario=resolved.name,
        mode=resolved.mode,
        mansd=resolved.network.mansd,
        horizon_s=resolved.horizon_s,
        reached_s=run.reached_s,
        events=len(run.delivered),
        deliveries=int(run.delivered.sum()),
        drops=int((~run.delivered).sum()),
        longest_loss_burst=int(loss_bursts.max()),
        inter_event_min_s=_or_none(np.min, np.diff(run.event_s)),
        inter_event_median_s=_or_none(np.median, np.diff(run.event_s)),
        inter_delivery_median_s=_or_none(np.median, np.diff(run.event_s[run.delivered])),
        initial_state_norm=float(np.linalg.norm(samples.x[0])),
        final_state_norm=float(np.linalg.norm(samples.x[-1])),
        sup_state_norm=float(np.linalg.norm(samples.x, axis=1).max()),
        diverged_at_s=None if divergence is None else divergence.at_s,
        exit_status=ExitStatus.OK if divergence is None else ExitStatus.FAILED,
        reason="horizon" if divergence is None else divergence.text,
    )


def _or_none(statistic: Callable[[Vector], SupportsFloat], values: Vector) -> float | None:
    return float(statistic(values)) if len(values) else None
