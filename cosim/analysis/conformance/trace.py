"""What a recorded loop did, in the words of its loop document: where it was, which edges it took, and z."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.claims.input_origins import plant_inputs
from cosim.record.run_record import RunRecord
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.core.linear_systems import Vector, exponential
from noack.proof.loop_document import LoopDocument
from noack.protocol.record_tables import NO_SEQUENCE, PLANT_STEP, SENSOR_MEASUREMENT
from noack.theory.witnesses.coordinates import floats

Numbers = NDArray[np.int64]
_PROJECTIONS = 200


class Item(NamedTuple):
    """A step of a trace: time passes in a location, or an edge is taken."""

    name: str
    """Of the location or of the edge."""
    is_motion: bool


@dataclass
class Trace:
    """A path through a document. Item i leads from the i-th state to the next one."""

    items: list[Item] = field(default_factory=list)
    steps: list[int] = field(default_factory=list)
    """The plant's step of each state, one more than items."""
    clocks_ns: list[int] = field(default_factory=list)
    z: Vector = field(default_factory=lambda: np.zeros((0, 0)))
    """(states, coordinates)"""
    t_ns: Numbers = field(default_factory=lambda: np.zeros(0, np.int64))
    """(steps,) Times of the plant's steps."""
    x: Vector = field(default_factory=lambda: np.zeros((0, 0)))
    u: Vector = field(default_factory=lambda: np.zeros((0, 0)))
    """(steps, n) and (steps, m) As they were recorded."""


class _State(NamedTuple):
    """What determines z between two items."""

    step: int
    events: int
    """So many events happened."""
    acting: int
    """The event whose update acts; −1: none."""
    following: int
    """The event whose update acts next; −1: none that was sent."""


def trace_of(record: RunRecord, document: LoopDocument) -> Trace:
    """Return the trace of a recorded loop.

    Raises:
        CallerError: the document has parts that the record does not show, or the record is too short.
    """
    loop = document.loop
    if loop.loads or loop.until is not None or loop.offset != 0:
        raise CallerError(
            "a loop with a load, or with a reference that moves, cannot be compared with a loop "
            "document yet; noack summary shows which claims the run was checked against"
        )
    if document.model.is_by_tests or not (loop.times.sampling > 0 or document.model.is_periodic):
        raise CallerError(
            "a loop document with tests at exact times, or at all times, cannot be compared with a run yet; "
            "noack summary shows which claims the run was checked against"
        )
    return _Tracer(record, document).trace()


class _Tracer:
    def __init__(self, record: RunRecord, document: LoopDocument) -> None:
        self._document, self._model = document, document.model
        steps, tests = record[PLANT_STEP], record[SENSOR_MEASUREMENT]
        self._t_ns, self._x, self._u = steps["t_ns"], steps["x"], steps["u"]
        place = np.searchsorted(self._t_ns, tests["t_ns"])
        inside = place < len(self._t_ns)
        tests, place = tests[inside], place[inside]
        if len(self._t_ns) < 2 or not (self._t_ns[place] == tests["t_ns"]).all():
            raise CallerError("a measurement is not one of a step of the plant")
        self._tests = {int(k): row for k, row in zip(place, range(len(tests)), strict=True)}
        events = tests["event"] != NO_SEQUENCE
        self._sent_step, self._sent_x = place[events], tests["x"][events]
        self._measured, self._is_event = tests["x"], events
        knows_start = record.scenario.network.initial_sync == "known_state"
        if knows_start:  # as if x(0) had been sent, and had arrived
            self._sent_step = np.append(0, self._sent_step)
            self._sent_x = np.vstack([self._x[:1], self._sent_x])
        if not len(self._sent_step) or self._sent_step[0] != 0 or (knows_start and self._sent_step[1:2] == 0):
            raise CallerError(
                "a run that does not begin with an event cannot be compared with a loop document yet"
            )
        numbers = {int(sequence): i for i, sequence in enumerate(tests["event"][events], int(knows_start))}
        self._acts = self._acting_steps(record, numbers, knows_start=knows_start)
        self._H = floats(document.loop.H)
        self._exponentials: dict[int, Vector] = {}
        self._edges = {
            (
                document.model.locations[edge.source].name,
                document.model.locations[edge.target].name,
                _kind(name),
            ): name
            for edge, name in document.edges
        }
        for index in document.silent_locations:
            name = document.model.locations[index].name
            self._edges[name, name, "silent"] = f"{name}, silent"
        self._names = {place.name for place in document.model.locations}
        delay_ns = float(document.loop.times.delay.p) / float(document.loop.times.delay.q) * NS_PER_S
        self._order = sorted(self._acts.values())
        newest = len(self._sent_step) - 1
        if newest not in self._order and self._t_ns[-1] - self._t_ns[self._sent_step[newest]] <= delay_ns:
            self._order.append(newest)  # it may be on its way when the record ends

    def _acting_steps(
        self, record: RunRecord, numbers: dict[int, int], *, knows_start: bool
    ) -> dict[int, int]:
        """Return by step the event whose update acts from it on, of several the newest one."""
        found: dict[int, int] = {}
        inputs = plant_inputs(record)
        if knows_start and np.isfinite(inputs.start_s):
            found[int(np.searchsorted(self._t_ns, round(inputs.start_s * NS_PER_S)))] = 0
        for update in inputs.updates:
            if update.applied_ns is not None and update.sequence in numbers:
                step = int(np.searchsorted(self._t_ns, update.applied_ns))
                found[step] = max(found.get(step, -1), numbers[update.sequence])
        newest, kept = -1, dict[int, int]()
        for step, event in sorted(found.items()):
            if event > newest:
                newest = kept[step] = event
        return kept

    def trace(self) -> Trace:
        """Return the path and its states."""
        trace = Trace(t_ns=self._t_ns, x=self._x, u=self._u)
        states: list[_State] = []
        first = self._order[0] if self._order else -1
        place = self._document.table["start"]["location"]
        is_started = not place.startswith("start")
        now = _State(0, 1, 0 if is_started else -1, -1 if is_started else first)
        clock = 0
        trace.steps.append(0)
        trace.clocks_ns.append(0)
        states.append(now)

        def take(item: Item, state: _State, clock_ns: int) -> None:
            trace.items.append(item)
            trace.steps.append(state.step)
            trace.clocks_ns.append(clock_ns)
            states.append(state)

        for step in range(len(self._t_ns)):
            if step:
                clock += int(self._t_ns[step] - self._t_ns[step - 1])
                now = now._replace(step=step)
                take(Item(place, True), now, clock)
            if step in self._acts and self._acts[step] >= 0 and (step or not is_started):
                now, target = self._after_arrival(now, self._acts[step])
                clock = self._clock_after_arrival(now, step, clock)
                take(Item(self._edge(place, target, "arrival"), False), now, clock)
                place = target
            if step == 0 or step not in self._tests:
                continue
            if self._is_event[self._tests[step]]:
                now, target, clock = self._after_event(now, place, clock)
                take(Item(self._edge(place, target, "event"), False), now, clock)
                place = target
            elif (edge := self._edges.get((place, place, "silent"))) is not None:
                clock = 0
                take(Item(edge, False), now, clock)
        trace.z = np.array([self._z(state) for state in states])
        self._add_noise(trace, states)
        return trace

    def _edge(self, source: str, target: str, kind: str) -> str:
        """Return the name of an edge; one that the document lacks has a name that is refuted."""
        return self._edges.get((source, target, kind), f"{source} to {target}, {kind}")

    def _after_arrival(self, now: _State, acting: int) -> tuple[_State, str]:
        """Return the state and the location after an update began to act."""
        missing = now.events - 1 - acting
        following = next((e for e in self._order if acting < e < now.events), -1)
        later = f"{now.events - 1 - following} later" if following >= 0 else f"{missing} lost"
        return now._replace(acting=acting, following=following), later

    def _clock_after_arrival(self, now: _State, step: int, clock: int) -> int:
        """Return the time since the update on its way was sent, or since the last test."""
        if self._model.is_periodic:
            return clock
        if now.following >= 0:
            return int(self._t_ns[step] - self._t_ns[self._sent_step[now.following]])
        return int(self._t_ns[step] - self._t_ns[self._last_test(step)])

    def _last_test(self, step: int) -> int:
        """Return the step of the last test before one."""
        while step > 0:
            step -= 1
            if step in self._tests:
                return step
        return 0

    def _after_event(self, now: _State, place: str, clock: int) -> tuple[_State, str, int]:
        """Return the state, the location and the clock after an event."""
        event = now.events
        after = now._replace(events=event + 1)
        if place.startswith("start"):
            if now.following >= event or now.following < 0:  # no update that was sent before acts
                return after, "start, 0 later", clock
            return after, f"start, {event - now.following} later", clock
        if now.following >= 0:
            return after, f"{event - now.following} later", 0 if self._model.is_periodic else clock
        if event in self._order:
            return after._replace(following=event), "0 later" if "0 later" in self._names else "0 lost", 0
        return after, f"{event - now.acting} lost", 0

    # States.

    def _flow(self, step: int, event: int) -> Vector:
        """Return the state that an event sent, as the models move it up to a step."""
        return self._moved(self._sent_x[event], int(self._t_ns[step] - self._t_ns[self._sent_step[event]]))

    def _moved(self, x: Vector, dt_ns: int) -> Vector:
        if dt_ns not in self._exponentials:
            self._exponentials[dt_ns] = exponential(self._H * (dt_ns * 1e-9))
        return np.asarray(self._exponentials[dt_ns] @ x)

    def _z(self, state: _State) -> Vector:
        model, document = self._model, self._document
        x = self._x[state.step]
        newest = self._flow(state.step, state.events - 1)
        acting = newest if state.acting < 0 else self._flow(state.step, state.acting)
        parts = [(model.x, x)]
        is_lost = state.following < 0 and state.acting >= 0
        seen = None if model.sees_all else document.loop.seen
        reduce = np.eye(len(x)) if seen is None else floats(seen)
        smooth, decaying = self._smooth(state.step)
        parts.append((model.s, smooth))
        if model.is_periodic and is_lost:
            parts.append((model.error_rows[0], reduce @ (acting - x - decaying)))
        else:
            parts.append((model.error_rows[0], reduce @ (newest - x - decaying)))
            if state.acting >= 0:
                parts.append((model.error_rows[1], reduce @ (acting - newest)))
        if state.following >= 0:
            for k, event in enumerate(range(state.following, state.events - 1)):
                if k + 2 < len(model.error_rows):
                    parts.append((model.error_rows[k + 2], reduce @ (self._flow(state.step, event) - newest)))
        z = np.zeros(model.size)
        for rows, value in parts:
            z += floats(rows).T @ value
        t_s = self._t_ns[state.step] * 1e-9
        z[-2], z[-1] = np.exp(-float(document.rate) * t_s), 1.0
        return z[document.used]

    def _smooth(self, step: int) -> tuple[Vector, Vector]:
        """Return s, the decaying error of an observer's estimate, and its part of the estimate."""
        smooth = self._model.bounds.smooth
        if not self._model.s.nrows():
            return np.zeros(0), np.zeros(len(self._x[0]))
        moved = exponential(floats(smooth.rates) * (self._t_ns[step] * 1e-9))
        s = moved @ floats(smooth.start)[:, 0]
        return s, floats(smooth.columns) @ s

    def _add_noise(self, trace: Trace, states: list[_State]) -> None:
        """Set the noise of each state that a test reads: what was measured, minus x and what decays."""
        model = self._model
        if not model.sources:
            return
        columns, rate = floats(model.bounds.columns), float(self._document.rate)
        at = [self._document.used.index(c) for c in model.sources]
        for i, (item, state) in enumerate(zip(trace.items, states, strict=False)):
            if (i == 0 or not item.is_motion) and state.step in self._tests:
                noise = self._measured[self._tests[state.step]] - self._x[state.step]
                limits = np.ones(columns.shape[1])
                limits[: model.bounds.decaying] = np.exp(-rate * self._t_ns[state.step] * 1e-9)
                trace.z[i, at] = _within(columns, noise - self._smooth(state.step)[1], limits)


def _within(columns: Vector, noise: Vector, limits: Vector) -> Vector:
    """Return p with Σ column p = noise, within its limits if projections in turn find such a p."""
    inverse = limits[:, None] * np.linalg.pinv(columns * limits)
    p = inverse @ noise
    for _ in range(_PROJECTIONS):
        if (np.abs(p) <= limits).all():
            break
        p = np.clip(p, -limits, limits)
        p = p + inverse @ (noise - columns @ p)
    return np.asarray(p)


def _kind(name: str) -> str:
    """Return the kind of an edge, by its name."""
    last = name.split(" to ")[0].rsplit(", ", 1)[-1]
    if last in ("event", "sent", "lost", "delivered"):
        return "event"
    return "silent" if last == "silent" else "arrival"
