"""Fidelity: the difference between a live run and the ideal loop, split by cause.

A chain of exact simulations uses the run's packet fates by event number. Each adds one effect:

* the ideal loop in continuous time;
* sampling: the trigger is tested on the measurement grid;
* delay: an update acts from the plant step that first applied an input computed with it;
* held actuation: the input of each step is K x_c at the model time of the actuation that was
  applied there, and zero before the first actuation.

The last simulation has all effects of the live run and must equal it up to rounding. Records are in
simulated time, and the plant's state is defined on its nominal grid, whatever the actual times of
its steps. So delays and model times refer to that grid.

Events that the live run did not have use the network emulator's decisions (which depend only on its
seed) and the median of the recorded delays.

:func:`recorded_loop` reads from a live run's record, in steps of the plant, when updates and inputs took
effect.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.claims.condition_reader import read_conditions
from cosim.analysis.summary.summary_model import FidelityPart, NoFidelityPart
from cosim.record.run_events import changes_of
from cosim.record.run_record import Rows, RunRecord
from cosim.simulation.continuous import (
    ContinuousLoop,
    ContinuousRun,
    TooManyEventsError,
    continuous_loop_of,
    network_fates,
    simulate_continuous,
)
from cosim.simulation.exact_simulation import MAX_EVENTS
from cosim.simulation.plant_grid_loop import NO_ACTUATION, PlantGridLoop, StepSchedule
from noack.core.errors import NoackError
from noack.core.linear_systems import Matrix, Vector
from noack.core.number_format import percent
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    NO_SEQUENCE,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)

_LEAST_MEASUREMENTS = 10
"""Fewer measurements than these are not compared."""
_AFTER_ANY_TIME_NS = 2**62
"""Later than any time of a run; differences of times still fit 64 bits."""


class IncomparableError(NoackError):
    """The run's record does not allow the comparison; the message has the reason."""


class RecordedLoop(NamedTuple):
    """A live run on the plant's grid, up to its last measurement."""

    schedule: StepSchedule
    x: Matrix
    """The plant's state at the measurements, (k, n)."""
    event_s: Vector
    """Times of the events."""


def recorded_loop(record: RunRecord) -> RecordedLoop:
    """Read the schedule of a run.

    Raises:
        IncomparableError: the run diverged, a process was restarted, settings were changed, the
            record is too short or has gaps, or some inputs were not those of the controller's
            model.
        CallerError: exact simulation does not support the scenario.
    """
    _require_ideal(record)
    steps = record.columns(PLANT_STEP, "sequence", "actuation", "x")
    sensor = record.columns(SENSOR_MEASUREMENT, "input", "t_ns", "event")
    ticks, deliveries = (
        record.columns(table, "input", "sequence", "model_t_ns")
        for table in (CONTROLLER_STEP, CONTROLLER_DELIVERY)
    )
    steps = _whole_steps(record, steps, sensor, ticks, deliveries)
    period_ns, last = record.scenario.timing.plant_period_ns, len(steps) - 1
    measured = np.zeros(last + 1, dtype=np.bool_)
    measured[sensor["t_ns"] // period_ns] = True
    origins, accepted = _ticks(ticks, deliveries)
    latched = _origins_of_steps(steps["actuation"], origins)
    observed = read_conditions(record)
    _require(
        not (len(observed.watchdog.t_s) or len(observed.safe_input.t_s)),
        "the ideal loop has no watchdog and no safe input, which this run applied for a time",
    )
    events = sensor[sensor["event"] != NO_SEQUENCE]
    numbers, event_ns = np.arange(len(events)), events["t_ns"]
    acts_at_tick = np.searchsorted(origins.newest, numbers)
    acts_at_step = np.searchsorted(latched.newest, numbers)
    act_ns = np.append(origins.model_ns, _AFTER_ANY_TIME_NS)[acts_at_tick]
    network = network_fates(record.scenario, record.number)
    schedule = StepSchedule(
        period_ns=period_ns,
        measured=measured,
        delivered=lambda event: event in accepted if event < len(events) else network(event),
        delay_ns=_delays(accepted, act_ns - event_ns, act_ns < _AFTER_ANY_TIME_NS),
        delay_steps=_delays(accepted, acts_at_step - event_ns // period_ns, acts_at_step <= last),
        model_ns=latched.model_ns,
    )
    return RecordedLoop(schedule, steps["x"][measured], event_ns * 1e-9)


def _require_ideal(record: RunRecord) -> None:
    """Require settings and processes that stayed the same, and a loop with an exact simulation."""
    changed, restarted = bool(changes_of(record)), record.restarted_role()
    _require(not changed, "the ideal loop has no changes of settings, as this run has")
    record.scenario.coverage.require_unchanging()
    record.scenario.coverage.require_exact()
    why = f"the ideal loop has no restarts: {restarted} was restarted during the run"
    _require(restarted is None, why)


def _whole_steps(record: RunRecord, steps: Rows, sensor: Rows, ticks: Rows, deliveries: Rows) -> Rows:
    """Require that nothing is missing; return the plant's steps up to the last measurement."""
    count = len(sensor)
    _require(
        count >= _LEAST_MEASUREMENTS,
        f"the record holds {count} measurements; {_LEAST_MEASUREMENTS} are needed",
    )
    last = int(sensor["t_ns"][-1]) // record.scenario.timing.plant_period_ns
    steps = steps[: last + 1]
    _require(
        len(steps) > last and np.array_equal(steps["sequence"], np.arange(last + 1)),
        "steps of the plant are missing from the record",
    )
    _require(
        np.array_equal(sensor["input"], np.arange(count)),
        "measurements are missing from the sensor's record",
    )
    horizon_ns = record.scenario.timing.horizon_ns
    _require_times(SENSOR_MEASUREMENT, sensor["t_ns"], horizon_ns)
    _require_times(CONTROLLER_STEP, ticks["model_t_ns"], horizon_ns)
    _require_times(CONTROLLER_DELIVERY, deliveries["model_t_ns"], horizon_ns)
    _require(bool(np.abs(steps["x"]).max() < _LARGEST), "the run diverged")  # also for NaN
    return steps


def _require(met: bool, why: str) -> None:
    if not met:
        raise IncomparableError(why)


def _require_times(table: str, times_ns: NDArray[np.int64], horizon_ns: int) -> None:
    """Require possible times: with others, as in a damaged record, a simulation would not end."""
    possible = (times_ns >= 0).all() and (times_ns <= horizon_ns).all()
    possible = possible and (np.diff(times_ns) >= 0).all()
    _require(bool(possible), f"the record's {table} has times that no run has")


class _Origins(NamedTuple):
    """The origin of the controller's actuations (by sequence number) or of the plant's steps."""

    model_ns: NDArray[np.int64]
    newest: NDArray[np.int64]
    """Sequence number of the newest update that they use, −1 for none."""


def _ticks(ticks: Rows, deliveries: Rows) -> tuple[_Origins, set[int]]:
    """Return the origin of each actuation, and the updates that the controller accepted."""
    inputs = np.sort(np.concatenate([ticks["input"], deliveries["input"]]))
    _require(
        np.array_equal(inputs, np.arange(len(inputs)))
        and np.array_equal(ticks["sequence"], np.arange(len(ticks))),
        "ticks or deliveries are missing from the controller's record",
    )
    sequences = np.concatenate([[NO_SEQUENCE], deliveries["sequence"]])
    newest = sequences[np.searchsorted(deliveries["input"], ticks["input"])]
    return _Origins(ticks["model_t_ns"], newest), set(deliveries["sequence"].tolist())


def _origins_of_steps(actuations: NDArray[np.int64], ticks: _Origins) -> _Origins:
    """Return the origin of the input held from each step on; −1 before the first."""
    known = bool(actuations.max(initial=NO_SEQUENCE) < len(ticks.newest))
    _require(known, "the controller's record ends before the plant's")
    by_sequence = _Origins(np.append(ticks.model_ns, NO_ACTUATION), np.append(ticks.newest, NO_SEQUENCE))
    return _Origins(by_sequence.model_ns[actuations], by_sequence.newest[actuations])


def _delays(accepted: set[int], delays: NDArray[np.int64], acted: NDArray[np.bool_]) -> Callable[[int], int]:
    """Return the recorded delays; for events that the run did not have, their median."""
    usable = [int(delays[event]) for event in accepted if event < len(delays) and acted[event]]
    usual = int(np.median(usable)) if usable else 0
    return lambda event: int(delays[event]) if event < len(delays) else usual


EXPLAINED = 0.1
"""Largest residual, as a share of the difference, that counts as explained."""
_ROUNDING = 1e-9
"""A difference below this share of x is rounding and needs no explanation."""
_NUDGE = 1e-13
"""Perturbation of x(0), relative, about the size of rounding. If it changes the events of a run,
rounding does so too."""
_AT_THE_END = 1e-11
"""The ideal loop runs longer, relative: an event at the last measurement may be due after rounding."""
_SPLIT_PERIODS = 10
"""Two event sequences differ from the first event that is further apart, in measurements."""
_LARGEST = 1e100
"""Largest entry of x of a run that did not diverge: its square is finite."""
_STEPS_AT_THE_END, _EVENTS_AT_THE_END = 100_000, 10_000
"""Longer runs are compared only on request: a comparison keeps over a kilobyte for each step."""
_STAGES = ("sampling", "delay", "held actuation", "residual")


@dataclass(frozen=True)
class SignalDifference:
    """The difference of x between two runs, over all measurements."""

    rms: float
    """Root mean square of its norm."""
    max: float
    """Largest norm."""
    rms_by_state: tuple[float, ...]
    max_by_state: tuple[float, ...]


@dataclass(frozen=True)
class FidelityStage:
    """The contribution of one effect to the difference between the ideal loop and the live run."""

    name: str
    difference: SignalDifference
    """Difference to the stage before."""
    share: float
    """Share of the whole difference D, ⟨d, D⟩/⟨D, D⟩. Shares add up to 1; some may be negative."""
    events: int
    """Number of events with this effect and all effects before it."""
    max_event_difference_s: float | None
    """Largest time difference to the same event in the stage before."""
    first_different_event: int | None
    """First event that is more than ten measurements from that of the stage before, or that only
    one of the two stages has."""


@dataclass(frozen=True)
class Fidelity:
    """The comparison of a live run with the ideal loop."""

    scenario: str
    mode: str
    compared_s: float
    """Length of the comparison in simulated time."""
    samples: int
    state_names: tuple[str, ...]
    rms_live: float
    """Root mean square of ‖x‖ in the live run, for scale."""
    total: SignalDifference
    """Live run minus the ideal loop."""
    stages: tuple[FidelityStage, ...]
    explained_relative: float
    """RMS of the residual over the RMS of the whole difference."""
    events_ideal: int
    events_live: int
    max_event_difference_s: float | None
    """Largest time difference between ideal loop and live run, over the events that both have."""
    first_different_event: int | None
    """As in :class:`FidelityStage`. From there on the packet fates apply to different events."""
    t_s: Vector
    """(samples,) times of the measurements."""
    stage_norms: Matrix
    """(stages, samples) Euclidean norm of the change of x by each stage."""

    @property
    def explained(self) -> bool:
        """Whether the residual is at most a tenth of the difference."""
        return self.explained_relative <= EXPLAINED or self._nothing_to_explain

    @property
    def _nothing_to_explain(self) -> bool:
        return self.total.rms <= _ROUNDING * self.rms_live

    @property
    def verdict(self) -> str:
        """The result in one line of text."""
        if self._nothing_to_explain:
            return "x equals that of the ideal loop, to rounding"
        of_x = 100 * self.total.rms / self.rms_live
        shares = ", ".join(f"{stage.name} {percent(stage.share)}" for stage in self.stages[:-1])
        return (
            f"x differs from the ideal loop by {of_x:.2g} % (RMS). Shares: {shares}. Residual "
            f"{100 * self.explained_relative:.2g} %" + ("" if self.explained else ", too large")
        )

    def to_json(self) -> dict[str, object]:
        """All figures, for ``noack fidelity --json``."""
        figures = {k: v for k, v in asdict(self).items() if k not in ("t_s", "stage_norms")}
        return {**figures, "explained": self.explained, "verdict": self.verdict}

    def summary(self) -> FidelityPart:
        """The part of the run's summary; ``docs/record.md`` explains the keys."""
        return FidelityPart(
            reason=None,
            explained=self.explained,
            explained_relative=self.explained_relative,
            rms_x=self.total.rms,
            max_x=self.total.max,
            rms_x_live=self.rms_live,
            shares={stage.name.replace(" ", "_"): stage.share for stage in self.stages},
            events_ideal=self.events_ideal,
            events_live=self.events_live,
            max_event_difference_s=self.max_event_difference_s,
            first_different_event=self.first_different_event,
        )


def fidelity_for_summary(record: RunRecord, loops: int = 1) -> FidelityPart | NoFidelityPart:
    """The comparison for a run's summary, or the reason why there is none.

    ``loops`` is the number of loops of the run.
    """
    if loops * record.count(PLANT_STEP) > _STEPS_AT_THE_END:
        return NoFidelityPart(reason="the run is long; `noack fidelity` compares it")
    try:
        return compute_fidelity(record, _EVENTS_AT_THE_END).summary()
    except NoackError as error:
        return NoFidelityPart(reason=str(error))
    except Exception as error:  # a failed comparison is no failure of the run
        return NoFidelityPart(reason=repr(error))


def compute_fidelity(record: RunRecord, max_events: int = MAX_EVENTS) -> Fidelity:
    """Compare a live run with the ideal loop, effect by effect.

    The ideal loop may have at most ``max_events`` events, which an unstable loop may exceed.

    Raises:
        IncomparableError: the run diverged, its record is too short or incomplete, or rounding
            changes its events.
    """
    live = recorded_loop(record)
    schedule, scenario = live.schedule, record.scenario
    known = scenario.network.initial_sync == "known_state"
    system = continuous_loop_of(scenario)
    period_s = schedule.period_ns * 1e-9
    t_s = np.flatnonzero(schedule.measured).astype(np.float64) * period_s
    # The chain of simulations, from the ideal loop to the live run.
    until_s = float(t_s[-1]) * (1 + _AT_THE_END)
    ideal = _ideal(system, live, until_s, max_events, known_start=known)
    simulated, event_times_s = _simulate_stages(system, schedule, known)
    states = [ideal.at(t_s).x, *simulated, live.x]
    events_s = [ideal.event_s, *event_times_s, live.event_s]
    if not all(np.abs(x).max() < _LARGEST for x in states):
        raise IncomparableError("a simulation of the run diverges")
    # What each one changes, and what is left at the end.
    whole, effects = live.x - states[0], [after - before for before, after in pairwise(states)]
    total, residual = _difference(whole), _difference(effects[-1])
    if residual.rms > EXPLAINED * total.rms:
        _require_stable_events(system, schedule, states[-2], EXPLAINED * total.rms, known)
    split_s = _SPLIT_PERIODS * scenario.plant.measure_every * period_s
    stages = (
        FidelityStage(
            name,
            _difference(effect),
            _share(effect, whole),
            len(after_s),
            *_event_changes(before_s, after_s, split_s),
        )
        for name, effect, (before_s, after_s) in zip(_STAGES, effects, pairwise(events_s), strict=True)
    )
    largest_s, first_different = _event_changes(ideal.event_s, live.event_s, split_s)
    return Fidelity(
        scenario=scenario.name,
        mode=scenario.mode,
        compared_s=float(t_s[-1]),
        samples=len(t_s),
        state_names=record.loop.state_names,
        rms_live=_difference(live.x).rms,
        total=total,
        stages=tuple(stages),
        explained_relative=residual.rms / total.rms if total.rms else 0.0,
        events_ideal=len(ideal.event_s),
        events_live=len(live.event_s),
        max_event_difference_s=largest_s,
        first_different_event=first_different,
        t_s=t_s,
        stage_norms=np.array([np.linalg.norm(effect, axis=1) for effect in effects]),
    )


def _simulate_stages(
    system: ContinuousLoop, schedule: StepSchedule, known_start: bool
) -> tuple[list[Matrix], list[Vector]]:
    """Return the measured states and the event times with one more effect of the network each."""
    loop = PlantGridLoop(system, schedule, known_start=known_start)
    effects = (False, False), (True, False), (True, True)
    runs = [loop.run(delay=delay, hold=hold) for delay, hold in effects]
    period_s = schedule.period_ns * 1e-9
    return (
        [run.x[schedule.measured] for run in runs],
        [run.event_steps.astype(np.float64) * period_s for run in runs],
    )


def _require_stable_events(
    system: ContinuousLoop, schedule: StepSchedule, x: Matrix, limit: float, known_start: bool
) -> None:
    """Require that a change of x(0) by rounding changes ``x`` by less than ``limit``."""
    other = replace(system.loop, x0=system.loop.x0 * (1 + _NUDGE))
    nudged = PlantGridLoop(ContinuousLoop(other, system.trigger), schedule, known_start=known_start)
    moved = nudged.run(delay=True, hold=True).x[schedule.measured] - x
    if not _difference(moved).rms < limit:
        raise IncomparableError(
            "the loop turns rounding into another run: so does a change of x(0) by "
            f"{_NUDGE:g} of itself; a shorter run can be compared"
        )


def _ideal(
    system: ContinuousLoop, live: RecordedLoop, horizon_s: float, max_events: int, *, known_start: bool
) -> ContinuousRun:
    try:
        ideal = simulate_continuous(
            system,
            horizon_s=horizon_s,
            delivered=live.schedule.delivered,
            known_start=known_start,
            max_events=max_events,
        )
    except TooManyEventsError:
        raise IncomparableError(
            f"in continuous time the events accumulate (more than {max_events:,}), so there is no ideal "
            "loop; a stable loop, a larger threshold or a floor would keep them apart; `noack compare` "
            "compares runs with each other"
        ) from None
    if ideal.diverged_at_s is not None:
        raise IncomparableError(f"the ideal loop diverges at {ideal.diverged_at_s:g} s")
    return ideal


def is_against(share: float) -> bool:
    """Return whether a share is negative (it partly cancels the others) at the shown precision."""
    return round(100 * share, 1) < 0


def _difference(x: Matrix) -> SignalDifference:
    norms = np.linalg.norm(x, axis=1)
    return SignalDifference(
        rms=float(np.sqrt(np.mean(norms**2))),
        max=float(norms.max()),
        rms_by_state=tuple(np.sqrt(np.mean(x**2, axis=0)).tolist()),
        max_by_state=tuple(np.abs(x).max(axis=0).tolist()),
    )


def _share(part: Matrix, whole: Matrix) -> float:
    energy = float((whole**2).sum())
    return float((part * whole).sum()) / energy if energy else 0.0


def _event_changes(first_s: Vector, second_s: Vector, tolerance_s: float) -> tuple[float | None, int | None]:
    """Return the largest time difference of events of equal number, and the first other event.

    The latter is further apart than the tolerance, or only one of the two runs has it.
    """
    both = min(len(first_s), len(second_s))
    apart_s = np.abs(first_s[:both] - second_s[:both])
    largest_s = float(apart_s.max()) if both else None
    if (far := np.flatnonzero(apart_s > tolerance_s)).size:
        return largest_s, int(far[0])
    return largest_s, both if len(first_s) != len(second_s) else None
