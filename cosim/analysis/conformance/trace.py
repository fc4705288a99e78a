"""What a recorded loop did, in the words of its loop document: where it was, which edges it took, and z.

A location changes only at some steps: at events, when an update begins to act, and at the silent tests that a
document counts. :class:`_RecordWalk` follows these; what each step needs is computed for all steps at once.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.conformance.recorded_loop import Flags, Numbers, RecordedLoop
from cosim.analysis.conformance.run_document import RunDocument
from cosim.analysis.conformance.verdicts import EdgeKind, Place, Transition, Unknown
from cosim.record.rows import Rows
from netem.core.clock import NS_PER_S
from netem.core.errors import CallerError
from noack.core.linear_systems import Propagator, Vector
from noack.core.references import Reference
from noack.protocol.record_tables import NO_SEQUENCE

Indices = NDArray[np.int32]
"""Numbers of items, states or steps: half as large, as a long run has many."""
_PROJECTIONS = 200
_BETWEEN = 1.5
"""A rule whose tests are further apart than this share of the measurements' period skips measurements."""
_ROUNDED_NS = 2
"""Times of steps differ from exact ones by at most this."""
_NONE = -1
"""Stands for no event."""
_STAGES = 3
"""States of a step of the plant: after the motion to it, after an update began to act, and after a test."""
_MOVED, _ACTED, _TESTED = range(_STAGES)


@dataclass
class Trace:
    """A path through a document with k items. Item i leads from the i-th state to the next one."""

    names: list[str]
    """Names of locations and edges."""
    items: Indices
    """(k,) Each item's place in ``names``: of the location in which time passes, or of the edge."""
    is_motion: Flags
    """(k,) Whether time passes, or an edge is taken."""
    steps: Indices
    """(k + 1,) The plant's step of each state."""
    clocks_ns: Numbers
    """(k + 1,)"""
    is_sampled: Flags
    """(k,) Of which items z is known before and after; of a long run a part."""
    rows: Indices
    """(k + 1,) The place of each state in ``z``; −1: it is not known."""
    z: Vector
    """(known states, coordinates)"""
    t_ns: Numbers
    """(steps,) Times of the plant's steps."""
    is_recorded: Flags
    """(steps,) Whether x is."""
    u: Vector
    """(known states, m) The input as it was recorded, minus that of the reference for its time."""
    readings: dict[str, Vector]
    """(known states, rows) each: what was recorded of x, and of x_s and x_c. NaN: nothing at this step;
    infinite: no number, where one belongs."""
    unknown: dict[str, Unknown] = field(default_factory=dict)
    """What happened at edges that the document lacks, by the name in ``names``."""


class _LocationChange(NamedTuple):
    """What changes at a step, and what then is."""

    key: int
    """The step times ``_STAGES``, plus the stage."""
    location: str
    events: int
    """So many events happened."""
    acting: int
    """The event whose update acts; ``_NONE``: none."""
    following: int
    """The event whose update acts next; ``_NONE``: none that was sent."""
    edge: str = ""


def trace_of(recorded: RecordedLoop, document: RunDocument, reference: Reference | None = None) -> Trace:
    """Return the trace of a recorded loop.

    Args:
        recorded: what is read of its record.
        document: of the loop.
        reference: in whose coordinates the document is; None: 0.

    Raises:
        CallerError: the document has parts that the record does not show.
    """
    return _Tracer(recorded, document, reference).trace()


class _Tracer:
    def __init__(self, recorded: RecordedLoop, document: RunDocument, reference: Reference | None) -> None:
        self._recorded, self._document, self._reference = recorded, document, reference
        self._t_ns, count = recorded.t_ns, len(recorded.t_ns)
        self._n = document.H.shape[0]
        self._period_ns = int(self._t_ns[1] - self._t_ns[0])
        self._propagate = Propagator(document.H)
        self._x = self._about(recorded.x, self._t_ns[recorded.sampled])
        is_event = recorded.events != NO_SEQUENCE
        is_test = self._is_compared(recorded.test_steps, is_event)
        self._test_steps, event_steps = recorded.test_steps[is_test], recorded.test_steps[is_event]
        self._is_test, self._is_event = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
        self._is_test[self._test_steps] = True
        self._is_event[event_steps] = True
        sent = recorded.measured[recorded.measured["event"] != NO_SEQUENCE]
        self._sent_step, self._sent_x = event_steps, self._about(sent["x"], sent["t_ns"])
        self._begin_with(knows_start=recorded.knows_start)
        virtual = len(self._sent_step) - len(sent)
        self._acts = self._acting_steps(
            {int(sequence): i for i, sequence in enumerate(sent["event"], virtual)}
        )
        self._order = sorted(self._acts.values())
        waited_ns = self._t_ns[-1] - self._t_ns[self._sent_step]
        last = self._order[-1] if self._order else _NONE
        # What was sent last may be on its way when the record ends.
        in_flight = np.flatnonzero(waited_ns <= document.delay_ns)
        self._order += in_flight[in_flight > last].tolist()

    def _is_compared(self, at: Numbers, is_event: Flags) -> Flags:
        """Return which measurements the rule tests: some rules do not test each of them."""
        test_ns, dwell_ns = self._document.test_ns, self._document.dwell_ns
        t_ns = self._t_ns[at]
        if len(at) < 2 or (not dwell_ns and test_ns <= _BETWEEN * float(np.diff(t_ns).min())):
            return np.ones(len(at), dtype=bool)
        events = np.union1d(0, np.flatnonzero(is_event))  # the start is one
        last = np.searchsorted(events, np.arange(len(at)), "left") - 1  # the event before each measurement
        since_ns = t_ns - t_ns[events[np.maximum(last, 0)]] - dwell_ns
        tests = np.round(since_ns / test_ns)
        is_due = (tests >= 0) & (np.abs(since_ns - tests * test_ns) <= _ROUNDED_NS)
        return np.asarray(is_event | is_due)

    def _about(self, x: Vector, t_ns: Numbers) -> Vector:
        """Return states about the reference, (k, n)."""
        return x if self._reference is None else x - self._reference.states(t_ns)[:, : self._n]

    def _sensor_states(self, steps: Indices) -> Vector:
        """Return x_s at steps, (k, n), NaN where nothing is tested."""
        found, is_test = np.full((len(steps), self._n), np.nan), self._is_test[steps]
        rows = self._measured_at(steps[is_test])
        found[is_test] = _numbers(self._about(rows["x_s"], rows["t_ns"]))
        return found

    def _measured_at(self, steps: Indices) -> Rows:
        """Return the measurements at steps that are tested."""
        measured = self._recorded.measured
        return measured[np.searchsorted(measured["t_ns"], self._t_ns[steps])]

    def _begin_with(self, *, knows_start: bool) -> None:
        """Require that the run begins with an event; a known start is as if x(0) had been sent."""
        begins = bool(len(self._sent_step)) and self._sent_step[0] == 0
        if knows_start and begins and not (self._sent_x[0] == self._x[0]).all():
            raise CallerError("x(0) is known, and the sensor sends another one: no loop document says this")
        if knows_start and not begins:
            self._sent_step = np.append(0, self._sent_step)
            self._sent_x = np.vstack([self._x[:1], self._sent_x])
        elif not begins:
            raise CallerError(
                "a run that does not begin with an event cannot be compared with a loop document"
            )
        self._is_event[0] = False  # it is the start

    def _acting_steps(self, numbers: Mapping[int, int]) -> dict[int, int]:
        """Return by step the event whose update acts from it on, of several the newest one."""
        found: dict[int, int] = {}
        inputs, end_ns = self._recorded.inputs, int(self._t_ns[-1])
        if self._recorded.knows_start and inputs.start_s * NS_PER_S <= end_ns:
            found[int(np.searchsorted(self._t_ns, round(inputs.start_s * NS_PER_S)))] = 0
        for update in inputs.updates:
            at_ns = update.applied_ns
            if at_ns is not None and at_ns <= end_ns and update.sequence in numbers:
                step = int(np.searchsorted(self._t_ns, at_ns))
                found[step] = max(found.get(step, _NONE), numbers[update.sequence])
        newest, kept = _NONE, dict[int, int]()
        for step, event in sorted(found.items()):
            if event > newest:
                newest = kept[step] = event
        return kept

    def _feedback(self) -> Vector:
        """Return the sampled inputs, (k, m): of a controller with a state, without those of the reference."""
        u, inputs, steps = self._recorded.u, self._recorded.inputs, self._recorded.sampled
        if self._reference is None:
            return u
        of_reference = self._reference.rows(inputs.input_ns[steps])[:, self._n :]
        return np.where(inputs.is_controlled[steps, None], u - of_reference, u)

    def _controller_states(self) -> Vector:
        """Return the x_c from which the sampled inputs were computed, as at their steps, (k, n)."""
        inputs, ticks, steps = self._recorded.inputs, self._recorded.ticks, self._recorded.sampled
        found, actuation = np.full((len(steps), self._n), np.nan), inputs.actuation[steps]
        at = np.searchsorted(ticks["sequence"], actuation)
        known = inputs.is_controlled[steps] & (at < len(ticks))
        known[known] = ticks["sequence"][at[known]] == actuation[known]
        rows = ticks[at[known]]
        x_c = self._about(rows["x_c"], rows["model_t_ns"])
        ages_ns = self._t_ns[steps[known]] - rows["model_t_ns"]
        ahead = ages_ns < 0
        moved = self._propagate.advance_by(x_c, np.maximum(ages_ns, 0), self._period_ns)
        if ahead.any():
            back = Propagator(-self._document.H)
            moved[ahead] = back.advance_by(x_c[ahead], -ages_ns[ahead], self._period_ns)
        found[known] = _numbers(moved)
        return found

    # The path.

    def trace(self) -> Trace:
        """Return the path and its states."""
        walk = _RecordWalk(self._document, self._acts, self._order, self._is_event, self._is_test)
        changes = [*walk.changes()]
        last_step = len(self._t_ns) - 1 if walk.missing is None else changes[-1].key // _STAGES
        keys = self._keys(changes, walk.is_shown, last_step)
        changed = np.array([change.key for change in changes])
        at = np.searchsorted(changed, keys, "right").astype(np.int32) - 1
        names: dict[str, int] = {}
        locations = np.array([names.setdefault(change.location, len(names)) for change in changes], np.int32)
        edges = np.array([names.setdefault(change.edge, len(names)) for change in changes], np.int32)
        steps, stages = np.divmod(keys, np.int32(_STAGES))
        is_motion = stages[1:] == _MOVED
        items = np.where(is_motion, locations[at[:-1]], edges[at[1:]])
        silent = ~is_motion & (changed[at[1:]] != keys[1:])
        stays = at[1:][silent]  # silent tests that lead to where the loop is
        for index in np.unique(stays).tolist():
            edges[index] = names.setdefault(self._silent_edge(changes[index].location), len(names))
        items[silent] = edges[stays]
        unknown = {} if walk.missing is None else {changes[-1].edge: self._unknown(walk.missing)}
        is_known = self._recorded.is_sampled[steps]
        known, by_change = steps[is_known], at[is_known]
        numbers = np.array([change[2:5] for change in changes], np.int64)[by_change]
        is_lost = np.array([not self._is_waiting(change) for change in changes])[by_change]
        samples = np.searchsorted(self._recorded.sampled, known)
        x = self._x[samples]
        z = self._z(x, known, numbers, is_lost)
        self._add_noise(z, x, known, np.append(is_motion, True)[is_known])
        x_c = self._controller_states()[samples]
        return Trace(
            names=[*names], items=items, is_motion=is_motion, steps=steps,
            clocks_ns=self._clocks(steps, stages == _TESTED, changes, at),
            is_sampled=is_known[:-1] & is_known[1:],
            rows=np.where(is_known, np.cumsum(is_known, dtype=np.int32) - 1, np.int32(-1)),
            z=z, t_ns=self._t_ns, is_recorded=self._recorded.is_recorded, u=self._feedback()[samples],
            readings={"x": x, "x_s": self._sensor_states(known), "x_c": x_c}, unknown=unknown,
        )  # fmt: skip

    def _unknown(self, missing: Transition) -> Unknown:
        places, wanted = self._document.places.values(), missing.target
        alike = [each.number for each in places if each[:2] == wanted[:2]]
        return Unknown(missing, max(alike, default=-1))

    def _keys(self, changes: list[_LocationChange], is_shown: Mapping[str, bool], last_step: int) -> Indices:
        """Return the keys of all states: after each motion, arrival, and test that the document shows."""
        changed = np.array([change.key for change in changes], np.int64)
        at = np.searchsorted(changed, self._test_steps * _STAGES + _TESTED, "left") - 1
        shown = np.array([is_shown.get(change.location, False) for change in changes])
        tests = self._test_steps[shown[at] & (self._test_steps > 0) & (self._test_steps <= last_step)]
        is_key = np.zeros((last_step + 1) * _STAGES, dtype=bool)
        is_key[_MOVED::_STAGES] = True
        is_key[changed] = True
        is_key[tests * _STAGES + _TESTED] = True
        keys = np.flatnonzero(is_key).astype(np.int32)
        return keys[keys <= changed[-1]] if last_step < len(self._t_ns) - 1 else keys

    def _silent_edge(self, location: str) -> str:
        place = self._document.places[location]
        return self._document.targets[Transition(location, EdgeKind.SILENT, place)].edge

    def _is_waiting(self, change: _LocationChange) -> bool:
        return change.following >= 0 or change.acting < 0

    def _clocks(
        self, steps: Indices, is_tested: Flags, changes: list[_LocationChange], at: Indices
    ) -> Numbers:
        """Return the clock of each state, (k + 1,)."""
        document, now_ns = self._document, self._t_ns[steps]
        if document.is_periodic:
            events = np.array([change.events for change in changes])
            return np.asarray(now_ns - self._t_ns[self._sent_step[events - 1]][at])
        start_ns = self._t_ns[0]
        tested_ns = np.maximum.accumulate(np.where(self._is_test, self._t_ns, start_ns))
        before_ns = np.append(start_ns, tested_ns[:-1])
        clocks = np.where(is_tested, tested_ns[steps], before_ns[steps])
        if not document.is_by_tests:
            following = np.array([change.following for change in changes])
            is_sent, starts = following >= 0, np.array([self._starts(each.location) for each in changes])
            sent_ns = self._t_ns[self._sent_step[np.maximum(following, 0)]]
            since_ns = np.where(starts, start_ns, sent_ns)
            clocks = np.where((is_sent | starts)[at], since_ns[at], clocks)
        return np.asarray(now_ns - clocks)

    def _starts(self, location: str) -> bool:
        place = self._document.places.get(location)
        return place is not None and place.starts

    # States.

    def _flow(self, events: Numbers, steps: Indices) -> Vector:
        """Return the states that events sent, as the models move them up to steps, (k, n)."""
        ages_ns = self._t_ns[steps] - self._t_ns[self._sent_step[events]]
        return self._propagate.advance_by(self._sent_x[events], ages_ns, self._period_ns)

    def _z(self, x: Vector, steps: Indices, numbers: Numbers, is_lost: Flags) -> Vector:
        """Return z of states, (k, coordinates); ``numbers`` are those of :class:`_LocationChange`."""
        document, (events, acting, following) = self._document, numbers.T
        newest = self._flow(events - 1, steps)
        acts = acting >= 0
        driving = newest.copy()
        driving[acts] = self._flow(acting[acts], steps[acts])
        reduce = document.seen.T
        z = x @ document.states
        smooth, decaying = self._smooth(steps)
        if smooth.shape[1]:
            z += smooth @ document.decaying
        error, w = newest - x - decaying, driving - newest
        if document.is_periodic:  # then e is x_c − x where updates are lost, and w is 0
            error, w = error + w * (is_lost & acts)[:, None], w * ~(is_lost & acts)[:, None]
        z += error @ reduce @ document.errors[0] + w @ reduce @ document.errors[1]
        for k, rows in enumerate(document.errors[2:]):
            here = (following >= 0) & (following + k < events - 1)
            later = self._flow(following[here] + k, steps[here]) - newest[here]
            z[here] += later @ reduce @ rows
        t_s = self._t_ns[steps] / NS_PER_S
        for coordinate, unit in self._units():
            z[:, coordinate] = np.exp(-unit * t_s)
        return z

    def _units(self) -> Iterator[tuple[int, float]]:
        """Yield the coordinates of the units, and the rates at which they decay."""
        names = [coordinate["name"] for coordinate in self._document.table["coordinates"]]
        for unit, rate in (("f1", self._document.rate_per_s), ("f2", 0.0)):
            if unit in names:
                yield names.index(unit), rate

    def _smooth(self, steps: Indices) -> tuple[Vector, Vector]:
        """Return s, the decaying error of an observer's estimate, and its part of the estimate."""
        columns, rates, start = self._document.smooth
        if not len(rates):
            return np.zeros((len(steps), 0)), np.zeros((len(steps), self._n))
        first = np.tile(start[:, 0], (len(steps), 1))
        s = Propagator(rates).advance_by(first, self._t_ns[steps], self._period_ns)
        return s, s @ columns.T

    def _add_noise(self, z: Vector, x: Vector, steps: Indices, is_before_motion: Flags) -> None:
        """Set the noise of each state that a test reads: what was measured, minus x and what decays."""
        document = self._document
        if not document.noise:
            return
        reads = ~is_before_motion
        reads[0] = True  # the start is an event
        at = np.flatnonzero(reads & self._is_test[steps])
        here = steps[at]
        tests = self._measured_at(here)
        limits = np.ones((len(at), len(document.noise)))
        decay = np.exp(-document.rate_per_s * self._t_ns[here] / NS_PER_S)
        limits[:, : document.decaying_noise] = decay[:, None]
        noise = self._about(tests["x"], tests["t_ns"]) - x[at] - self._smooth(here)[1]
        z[np.ix_(at, np.array(document.noise))] = _within(document.noise_columns, noise, limits)


class _RecordWalk:
    """The changes of location of a run, in order.

    Args:
        document: of the loop.
        acts: by step, the event whose update acts from it on.
        order: the events whose updates act, in order.
        is_event: which steps have an event, but for the start.
        is_test: which steps have a test.
    """

    def __init__(
        self,
        document: RunDocument,
        acts: Mapping[int, int],
        order: list[int],
        is_event: Flags,
        is_test: Flags,
    ) -> None:
        self._document, self._acts, self._order = document, acts, order
        self._is_event, self._is_test = is_event, is_test
        self.missing: Transition | None = None
        """What happened last, for which the document has no edge."""
        self.is_shown = {name: self._stays(name, place) for name, place in document.places.items()}
        """By location: whether silent tests lead back to it. Elsewhere they are not shown, or lead on."""

    def _stays(self, location: str, place: Place) -> bool:
        target = self._document.targets.get(Transition(location, EdgeKind.SILENT, place))
        return target is not None and target.location == location

    def changes(self) -> Iterator[_LocationChange]:
        """Yield the start and each change, up to the first for which the document has no edge."""
        start = self._document.table["start"]["location"]
        starts = self._document.places[start].starts
        first = self._order[0] if self._order else _NONE
        now = _LocationChange(0, start, 1, _NONE if starts else 0, first if starts else _NONE)
        yield now
        marks = sorted({*self._acts, *np.flatnonzero(self._is_event).tolist()} - (set() if starts else {0}))
        tests = np.flatnonzero(self._is_test)
        done = 0
        for mark in [*marks, len(self._is_test)]:
            between = tests[np.searchsorted(tests, done, "right") : np.searchsorted(tests, mark, "left")]
            for change in self._silent_tests(now, between):
                yield (now := change)
                if self.missing is not None:
                    return
            if mark == len(self._is_test):
                return
            if mark in self._acts:
                yield (now := self._after_arrival(now, mark))
                if self.missing is not None:
                    return
            if self._is_test[mark] and mark:
                if self._is_event[mark]:
                    yield (now := self._after_event(now, mark))
                else:
                    for change in self._silent_tests(now, np.array([mark])):
                        yield (now := change)
                if self.missing is not None:
                    return
            done = mark

    def _silent_tests(self, now: _LocationChange, steps: Numbers) -> Iterator[_LocationChange]:
        """Yield the changes of silent tests, up to a location to which they lead back."""
        if not self._document.is_by_tests:
            return
        for step in steps.tolist():
            if self.is_shown[now.location]:
                return
            now = self._taken(
                now, step * _STAGES + _TESTED, EdgeKind.SILENT, self._document.places[now.location]
            )
            yield now
            if self.missing is not None:
                return

    def _taken(self, now: _LocationChange, key: int, kind: EdgeKind, place: Place) -> _LocationChange:
        """Return what is after an edge."""
        wanted = Transition(now.location, kind, place)
        target = self._document.targets.get(wanted)
        if target is None:
            self.missing = wanted
            return now._replace(key=key, edge=f"{now.location}, {kind}, {place}")
        return now._replace(key=key, location=target.location, edge=target.edge)

    def _after_arrival(self, now: _LocationChange, step: int) -> _LocationChange:
        acting = self._acts[step]
        following = next((e for e in self._order if acting < e < now.events), _NONE)
        now = now._replace(acting=acting, following=following)
        last = now.events - 1
        place = Place(False, True, last - following) if following >= 0 else Place(False, False, last - acting)
        return self._taken(now, step * _STAGES + _ACTED, EdgeKind.ARRIVAL, place)

    def _after_event(self, now: _LocationChange, step: int) -> _LocationChange:
        event, source = now.events, self._document.places[now.location]
        now = now._replace(events=event + 1)
        if source.starts:
            # of updates that were sent before, none acts: the start is as with this one
            later = event - now.following if 0 <= now.following < event else 0
            place = Place(True, True, later)
        elif now.following >= 0:
            place = Place(False, True, event - now.following)
        elif event in self._order:
            waits = any(each.waits and not each.starts for each in self._document.places.values())
            now = now._replace(following=event if waits else _NONE)
            place = Place(False, waits, 0)
            if not waits:
                now = now._replace(acting=event)
        else:
            place = Place(False, False, event - now.acting)
        return self._taken(now, step * _STAGES + _TESTED, EdgeKind.EVENT, place)


def _numbers(recorded: Vector) -> Vector:
    """Return what was recorded; infinite where it is no number."""
    return np.where(np.isnan(recorded), np.inf, recorded)


def _within(columns: Vector, noise: Vector, limits: Vector) -> Vector:
    """Return p with Σ column p = noise, (k, columns), within limits if projections in turn find such a p."""
    scaled = columns * limits[:, None, :]
    inverse = limits[:, :, None] * np.linalg.pinv(scaled)
    p = (inverse @ noise[:, :, None])[:, :, 0]
    for _ in range(_PROJECTIONS):
        beyond = np.flatnonzero((np.abs(p) > limits).any(axis=1))
        if not len(beyond):
            break
        inside = np.clip(p[beyond], -limits[beyond], limits[beyond])
        rest = noise[beyond] - inside @ columns.T
        p[beyond] = inside + (inverse[beyond] @ rest[:, :, None])[:, :, 0]
    return np.asarray(p)
