"""Whether a trace is a run of its loop document, and shows what was recorded.

What has to be right for a statement about a run is this file, the kernel, and what the document says. A trace
is a path: each item is a motion in a location, or an edge. For a run of the document

* the path begins at the start and has each recorded step: motions lead to the next step, edges take no time;
* an edge is taken while the clock is in its interval, where its facts hold, and z becomes J z;
* in a location the clock does not exceed its limit, the facts hold, and z moves as the motion says;
* u is the recorded one, and what the document's readings say of z is what was recorded: x at all steps, and
  x_s and x_c where the record has them.

Edges, clocks and times are compared at all items. Motions, facts, jumps and readings are compared at those of
which the trace has z, before and after: the result says which share that is.

Between two steps of the plant the input is constant. A motion whose corners have a common part,
Fᵢ = F + B Uᵢ, moves as ż = F z + B u + Σ c p with u = Σ λᵢ Uᵢ z. So z at the end follows from z and u, but
for the signals p, which may change during the step; and u is in the hull of the Uᵢ z at both ends. A signal
is at most Σ λᵢ |Rᵢ z| with the λ of this u, and has the sign that the document may require. All is computed
in floating point, with tolerances relative to the sizes of the terms.
"""

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.optimize import lsq_linear, nnls

from cosim.analysis.conformance.document_numbers import (
    TINY,
    DocumentNumbers,
    MotionParts,
    MotionStep,
    Table,
    value,
)
from cosim.analysis.conformance.recorded_loop import Flags, Numbers
from cosim.analysis.conformance.trace import Trace
from cosim.analysis.conformance.verdicts import Conformance, Failed, Failure
from netem.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix, Vector

STATE, MOTION, INPUT, FACT = 1e-7, 1e-6, 1e-6, 1e-9
"""Largest differences that count as rounding: of z, of its motion, of u and of facts, relative."""
CLOCK_NS = 2
_MOST_HULLS = 60
"""Steps at which the hull of several inputs is tested; a single input is tested at all steps."""
_PROJECTIONS = 60
_SMALLEST_EFFECT = 0.1
"""Directions in which signals have a smaller effect, in units of what counts as rounding, are left out."""
_NOTHING = np.zeros(0, np.int64)


class RefutedError(Exception):
    """The trace is no run of the document."""

    def __init__(self, failure: Failure) -> None:
        super().__init__(f"{failure.kind}: {failure.place}")
        self.failure = failure


def compare(trace: Trace, document: DocumentNumbers) -> Conformance:
    """Return whether a trace is a run of a document."""
    checked = _Checked(trace, document)
    failures: list[Failure] = []
    for check in (checked.path, checked.edges, checked.locations, checked.motions, checked.record):
        try:
            check()
        except RefutedError as refuted:
            failures.append(refuted.failure)
    first = min(failures, key=lambda failure: failure.t_s, default=None)
    until_s = float(trace.t_ns[-1]) / NS_PER_S if first is None else first.t_s
    share = float(trace.is_sampled.mean()) if len(trace.items) else 1.0
    name = document.table["name"]
    return Conformance(name, until_s, first, checked.edge_counts(), checked.clock_shares(), share)


class _Checked:
    def __init__(self, trace: Trace, document: DocumentNumbers) -> None:
        self._trace, self._document, self._states = trace, document, document.states
        self._clocks_ns, self._is_motion = trace.clocks_ns, trace.is_motion
        self._largest = float(np.abs(trace.z[:, self._states]).max(initial=0.0)) or 1.0
        self._number = {name: number for number, name in enumerate(trace.names)}
        # Items by name and kind, found at once: most names of a document do not occur in a trace.
        kinds = 2 * trace.items + trace.is_motion
        order = np.argsort(kinds, kind="stable")
        ends = np.searchsorted(kinds[order], np.arange(2 * len(trace.names) + 1))
        self._at = [order[first:last] for first, last in pairwise(ends.tolist())]

    # The path.

    def path(self) -> None:
        """Require that the path begins at the start, has all steps, and that items follow each other."""
        trace, start = self._trace, self._document.table["start"]
        self._require_start(start)
        sources, targets = (
            np.array([self._end(name, index, is_first=is_first) for name in trace.names for index in (0, 1)])
            for is_first in (True, False)
        )
        which = 2 * trace.items + trace.is_motion
        begins, ends = sources[which], targets[which]
        expected = np.append([self._place_number(start["location"])], ends[:-1])
        known = begins >= 0
        if (wrong := np.flatnonzero(~known | (begins != expected) | (ends < 0))).size:
            index = int(wrong[0])
            name, t_s = trace.names[trace.items[index]], self._time_s(index)
            unknown = trace.unknown.get(name)
            place = name if unknown is None else unknown.transition.source
            raise RefutedError(Failure(t_s, Failed.EDGE, place, unknown=unknown))
        steps = trace.steps
        going = np.asarray(np.diff(steps) == trace.is_motion)
        self._require(np.arange(len(going)), going, Failed.PATH, "", "the path does not go step by step")
        is_known = trace.rows >= 0
        self._require(
            np.arange(len(going)),
            ~trace.is_sampled | (is_known[:-1] & is_known[1:]),
            Failed.PATH,
            "",
            "the trace has no z",
        )
        if steps[0] != 0 or steps[-1] != len(trace.t_ns) - 1:
            what = "the path does not have all steps of the record"
            raise RefutedError(Failure(self._time_s(-1), Failed.PATH, detail=what))

    def _require_start(self, start: Table) -> None:
        """Require that z is that of the start, where its facts hold."""
        clock_ns, t_ns = self._clocks_ns[:1], self._trace.t_ns
        self._require_clock(
            np.zeros(1, int), clock_ns == 0, Failed.CLOCK, start["location"], clock_ns, (0, 0)
        )
        if (still := np.flatnonzero(np.diff(t_ns) <= 0)).size:
            what = "the steps of the record do not follow each other in time"
            raise RefutedError(Failure(float(t_ns[still[0]]) / NS_PER_S, Failed.PATH, detail=what))
        first = self._z(np.zeros(1, int))
        Z, noise, z = self._document.start(), first[0, self._document.noise], first[0, self._states]
        expected = (Z @ np.append(1.0, noise))[self._states]
        if not (np.abs(z - expected) <= STATE * (1 + np.abs(expected))).all():
            raise RefutedError(Failure(self._time_s(0), Failed.JUMP, "start"))
        for fact in start["facts"]:
            self._require(np.zeros(1, int), self._holds(fact, first), Failed.FACT, "start", fact)

    def _place_number(self, name: str | None) -> int:
        return -1 if name is None else self._document.place_numbers.get(name, -1)

    def _end(self, name: str, is_motion: int, *, is_first: bool) -> int:
        """Return the number of the location in which an item begins or ends; −1: the document has none."""
        if is_motion:
            return self._place_number(name)
        edge = self._document.edges.get(name)
        return -1 if edge is None else self._place_number(edge["from" if is_first else "to"])

    def edges(self) -> None:
        """Require that edges are taken at their times, where their facts hold, and that z jumps to J z."""
        self._require_all(
            self._edge, ((edge, self._taken(name)) for name, edge in self._document.edges.items())
        )

    @staticmethod
    def _require_all(check: Callable[..., None], calls: Iterable[tuple[Any, Numbers]]) -> None:
        """Check each of several things that occurred; raise the first failure in time."""
        failures = []
        for what, at in calls:
            if not len(at):
                continue
            try:
                check(what, at)
            except RefutedError as refuted:
                failures.append(refuted.failure)
        if failures:
            raise RefutedError(min(failures, key=lambda failure: failure.t_s))

    def _edge(self, edge: Table, at: Numbers) -> None:
        if edge["to"] is None:
            return  # then the path is none
        name, clock, after = edge["name"], self._clocks_ns[at], self._clocks_ns[at + 1]
        if edge.get("when") is not None:
            first, last = (value(end) * NS_PER_S for end in edge["when"])
            inside = (clock >= first - CLOCK_NS) & (clock <= last + CLOCK_NS)
            self._require_clock(at, inside, Failed.WHEN, name, clock, (first, last))
        limit = self._document.locations[edge["to"]].get("clock")
        end = np.inf if limit is None else value(limit) * NS_PER_S
        expected = {
            "zero": after == 0,
            "keeps": after == clock,
            "any": (after >= 0) & (after <= end + CLOCK_NS),
        }
        self._require_clock(at, expected[edge["clock"]], Failed.CLOCK, name, after, (0, end))
        at = at[self._trace.is_sampled[at]]
        z, then, J = self._z(at), self._z(at + 1), self._document.jump(name)
        for fact in edge["facts"]:
            self._require(at, self._holds(fact, z), Failed.FACT, name, fact)
        room = STATE * (np.abs(z) @ np.abs(J).T + np.abs(then)) + TINY * self._largest
        near = np.abs(then - z @ J.T) <= room
        self._require(at, np.asarray(near[:, self._states].all(axis=1)), Failed.JUMP, name)

    # Locations and motions.

    def locations(self) -> None:
        """Require of each location that its clock is within its limit, and that its facts hold."""
        self._require_all(
            self._location,
            ((each, self._motions_of(name)) for name, each in self._document.locations.items()),
        )

    def _location(self, location: Table, at: Numbers) -> None:
        name, after = location["name"], self._clocks_ns[at + 1]
        moved = after - self._clocks_ns[at]
        dt = self._lengths_s(at) * NS_PER_S
        self._require_clock(at, np.abs(moved - dt) <= CLOCK_NS, Failed.CLOCK, name, after, (0, np.inf))
        if location.get("clock") is not None:
            limit = value(location["clock"]) * NS_PER_S
            self._require_clock(at, after <= limit + CLOCK_NS, Failed.LIMIT, name, after, (0, limit))
        at = at[self._trace.is_sampled[at]]
        zero = np.abs(self._z(at)[:, self._document.outside(name)]) <= STATE * self._largest
        self._require(at, np.asarray(zero.all(axis=1)), Failed.ZERO, name)
        for fact in location["facts"]:
            for ends in (at, at + 1):
                self._require(at, self._holds(fact, self._z(ends)), Failed.FACT, name, fact)

    def motions(self) -> None:
        """Require that z moves as the motions say, for some signals, and that u is in their hull."""
        self._require_all(
            self._motion,
            ((each, self._motions_of(name)) for name, each in self._document.locations.items()),
        )

    def _motion(self, location: Table, at: Numbers) -> None:
        motion, at = location["motion"], at[self._trace.is_sampled[at]]
        if (split := self._document.split(motion)) is None:
            raise RefutedError(Failure(0.0, Failed.MOTION, motion, "its corners have no common part"))
        self._require_all(
            lambda check, here: check(location, split, here), ((self._flows, at), (self._inputs, at))
        )

    def _flows(self, location: Table, split: MotionParts, at: Numbers) -> None:
        dt_s, u = self._lengths_s(at), self._trace.u[self._trace.rows[at]]
        rounded_s = np.round(dt_s, 9)
        for length in np.unique(rounded_s):
            is_here = rounded_s == length
            here, inputs = at[is_here], u[is_here]
            flow = self._document.flow(location["motion"], float(length))
            now, then = self._z(here), self._z(here + 1)
            rest = then - now @ flow.state.T - inputs @ flow.input.T
            scale = np.abs(now) @ np.abs(split.F).T + np.abs(inputs) @ np.abs(split.B).T
            allowed = MOTION * length * scale + STATE * 1e-3 * np.abs(then) + TINY * self._largest
            rest, allowed = rest[:, self._states], allowed[:, self._states]
            explained = self._explained(rest, allowed, flow, self._states, _ranges(split, now, then))
            if any(len(signal.rows) > 1 for signal in split.signals):  # the mixture may allow more
                left = np.flatnonzero(~explained)
                ranges = _ranges(split, now[left], then[left], inputs[left])
                explained[left] = self._explained(rest[left], allowed[left], flow, self._states, ranges)
            self._require(here, explained, Failed.MOTION, location["name"])

    @staticmethod
    def _explained(
        rest: Vector, free: Vector, flow: MotionStep, states: list[int], ranges: tuple[Vector, Vector]
    ) -> Flags:
        """Return which rests are Σ column p with p in its range, but for what is ``free``.

        A signal that varies may differ from a constant one: this difference is free, too. Signals are found
        by projections in turn, on all signals that explain the rest and on all signals within their ranges.
        """
        columns, varied = flow.signals[states], flow.varied[states]
        if not columns.shape[1]:
            return np.asarray((np.abs(rest) <= free).all(axis=1))
        lowest, highest = ranges
        limits = (highest - lowest) / 2
        rest = rest - (highest + lowest) / 2 @ columns.T
        free = free + limits @ varied.T
        near = np.abs(rest) <= free
        explained = np.asarray(near.all(axis=1))
        moved = columns.any(axis=1)  # the coordinates on which signals have an effect
        is_number = np.isfinite(rest).all(axis=1) & np.isfinite(free).all(axis=1)
        open_ = np.flatnonzero(~explained & is_number & near[:, ~moved].all(axis=1))
        unit, columns = free[np.ix_(open_, moved)], columns[moved]
        effects = columns * limits[open_][:, None, :] / unit[:, :, None]  # (steps, coordinates, signals)
        explained[open_] = _reachable(effects, rest[np.ix_(open_, moved)] / unit)
        return explained

    def _inputs(self, location: Table, split: MotionParts, at: Numbers) -> None:
        name, u = location["name"], self._trace.u[self._trace.rows[at]]
        for ends in (at, at + 1):
            z = self._z(ends)
            corners = np.stack([z @ U.T for U in split.U])  # (corners, steps, m)
            scale = np.max([np.abs(z) @ np.abs(U).T for U in split.U], axis=0)
            room = INPUT * scale + TINY * self._largest
            inside = (u >= corners.min(axis=0) - room) & (u <= corners.max(axis=0) + room)
            self._require(at, inside.all(axis=1), Failed.INPUT, name)
            if u.shape[1] > 1:
                some = np.unique(np.linspace(0, len(at) - 1, min(len(at), _MOST_HULLS)).astype(int))
                fits = np.array([_in_hull(corners[:, i], u[i], room[i]) for i in some])
                self._require(at[some], fits, Failed.INPUT, name)

    # The record.

    def record(self) -> None:
        """Require that x is recorded at all steps, and that what is recorded is what z shows.

        At a step x and x_s are those before what happens then, and x_c is the one of the input from then on.
        """
        readings = self._document.readings()
        x_is_known = self._trace.is_recorded.all() and np.isfinite(self._trace.readings["x"]).all()
        if "x" not in readings or not x_is_known:
            raise RefutedError(Failure(self._time_s(0), Failed.READING, detail="x"))
        read = {place for _, places in readings["x"] for place in places}
        for name in self._document.locations:
            if name not in read and (at := self._motions_of(name)).size:
                raise RefutedError(Failure(self._time_s(int(at[0])), Failed.READING, name, "x"))
        for name, parts in readings.items():
            recorded = self._trace.readings[name]
            for rows, places in parts:
                here = np.sort(np.concatenate([_NOTHING, *map(self._motions_of, places)]))
                here = here[self._trace.is_sampled[here]]
                at = here if name == "x_c" else here + 1
                self._require_read(name, at, rows, recorded)
                if name == "x":
                    self._require_read(name, here[:1], rows, recorded)

    def _require_read(self, name: str, at: Numbers, rows: Matrix, recorded: Vector) -> None:
        found = recorded[self._trace.rows[at]]
        known = ~np.isnan(found).any(axis=1)
        at, found = at[known], found[known]
        z = self._z(at)
        room = STATE * (np.abs(found) + np.abs(z) @ np.abs(rows).T) + TINY * self._largest
        near = np.isfinite(found) & (np.abs(z @ rows.T - found) <= room)
        self._require(at, near.all(axis=1), Failed.READING, "", name)

    def edge_counts(self) -> dict[str, int]:
        """Return how often each edge was taken."""
        names = [name for name, edge in self._document.edges.items() if edge["to"] is not None]
        return {name: len(self._taken(name)) for name in names}

    def clock_shares(self) -> dict[str, float]:
        """Return the largest share of each clock's limit."""
        found = {}
        for name, location in self._document.locations.items():
            at = self._motions_of(name)
            if location.get("clock") is not None and value(location["clock"]) > 0:
                limit = value(location["clock"]) * NS_PER_S
                found[name] = float(self._clocks_ns[at + 1].max(initial=0) / limit)
        return found

    # Parts.

    def _time_s(self, at: int) -> float:
        """Return the time of a state."""
        return float(self._trace.t_ns[self._trace.steps[at]] / NS_PER_S)

    def _lengths_s(self, at: Numbers) -> Vector:
        """Return the lengths of items."""
        first, last = (self._trace.t_ns[self._trace.steps[ends]] / NS_PER_S for ends in (at, at + 1))
        return np.asarray(last - first)

    def _z(self, at: Numbers) -> Matrix:
        """Return z of states, (k, coordinates), which are before or after sampled items."""
        return np.asarray(self._trace.z[self._trace.rows[at]])

    def _motions_of(self, name: str) -> Numbers:
        """Return the items in which time passes in a location."""
        return self._items_of(name, is_motion=True)

    def _taken(self, name: str) -> Numbers:
        """Return the items that are an edge."""
        return self._items_of(name, is_motion=False)

    def _items_of(self, name: str, *, is_motion: bool) -> Numbers:
        number = self._number.get(name)
        return _NOTHING if number is None else self._at[2 * number + is_motion]

    def _holds(self, fact: str, z: Vector) -> Flags:
        facts = self._document.table["facts"][fact]
        left, right = (
            sum((np.square(z @ self._document.rows(name).T).sum(axis=1) for name in names), np.zeros(len(z)))
            for names in (facts["less"], facts["more"])
        )
        return np.asarray(left <= right * (1 + FACT) + TINY**2)

    def _require(self, at: Numbers, holds: Flags, kind: Failed, place: str, detail: str = "") -> None:
        if not holds.all():
            first = at[int(np.argmin(holds))]
            raise RefutedError(Failure(self._time_s(first), kind, place, detail))

    def _require_clock(
        self,
        at: Numbers,
        holds: Flags,
        kind: Failed,
        place: str,
        clock_ns: Numbers,
        allowed_ns: tuple[float, float],
    ) -> None:
        if not holds.all():
            first = int(np.argmin(holds))
            found, low, high = (float(value) / NS_PER_S for value in (clock_ns[first], *allowed_ns))
            raise RefutedError(Failure(self._time_s(at[first]), kind, place, "", found, low, high))


def _ranges(split: MotionParts, now: Vector, then: Vector, u: Vector | None = None) -> tuple[Vector, Vector]:
    """Return the least and the largest value of each signal during steps, (steps, signals) each.

    Signals may vary during a step: what bounds one is the larger value of both ends, plus what it changes by.
    Without ``u`` it is what all mixtures of corners allow.
    """
    mixtures = [None if u is None else _mixtures(split, z, u) for z in (now, then)]
    lowest, highest = np.zeros((2, len(now), len(split.signals)))
    for k, signal in enumerate(split.signals):
        first, last = (
            _mixed_sizes(signal.rows, z, mixture) for z, mixture in zip((now, then), mixtures, strict=True)
        )
        limit = np.maximum(first, last) + _mixed_sizes(signal.rows, then - now, mixtures[1])
        lowest[:, k], highest[:, k] = -limit, limit
        if signal.along is not None:  # p is between 0 and Cz/k
            ends = np.stack([z @ signal.along[0] for z in (now, then)])
            change = np.abs(ends[1] - ends[0])
            below, above = np.minimum(ends.min(axis=0) - change, 0), np.maximum(ends.max(axis=0) + change, 0)
            if signal.least > 0:
                below, above = below / signal.least, above / signal.least
            else:  # any p of this sign
                below, above = np.where(below < 0, -np.inf, 0.0), np.where(above > 0, np.inf, 0.0)
            lowest[:, k], highest[:, k] = np.maximum(-limit, below), np.minimum(limit, above)
    return lowest, highest


def _mixtures(split: MotionParts, z: Matrix, u: Vector) -> Vector:
    """Return λ with Σ λᵢ Uᵢ z = u, or nearly, (steps, corners)."""
    corners = np.stack([z @ U.T for U in split.U], axis=1)  # (steps, corners, m)
    found, steps = np.zeros(corners.shape[:2]), np.arange(len(z))
    if u.shape[1] == 1:  # a mixture of the least and the largest one
        least, largest = corners[:, :, 0].argmin(axis=1), corners[:, :, 0].argmax(axis=1)
        low, high = corners[steps, least, 0], corners[steps, largest, 0]
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.where(high > low, np.clip((u[:, 0] - low) / (high - low), 0, 1), 0)
        found[steps, least] += 1 - share
        found[steps, largest] += share
        return found
    for step in steps[np.isfinite(corners).all(axis=(1, 2)) & np.isfinite(u).all(axis=1)]:
        room = np.abs(corners[step]).max() or 1.0
        weights = np.vstack([corners[step].T / room, np.ones(len(split.U))])
        mixture = nnls(weights, np.append(u[step] / room, 1.0))[0]
        found[step] = mixture / (mixture.sum() or 1.0)
    return found


def _mixed_sizes(rows: Sequence[Matrix], z: Matrix, mixture: Vector | None) -> Vector:
    """Return Σ λᵢ |Rᵢ z|, (steps,); without a mixture the least of all."""
    sizes = np.stack([np.linalg.norm(z @ R.T, axis=1) for R in rows], axis=1)
    if len(rows) == 1 or mixture is None:
        return np.asarray(sizes.min(axis=1))
    return np.asarray((mixture * sizes).sum(axis=1))


def _reachable(effects: Vector, rest: Vector) -> Flags:
    """Return which rests are effects times numbers from −1 to 1, up to about 1 in each coordinate.

    Args:
        effects: (k, coordinates, signals).
        rest: (k, coordinates).
    """
    found, open_ = np.zeros(len(rest), dtype=bool), np.arange(len(rest))
    U, sizes, V = np.linalg.svd(effects, full_matrices=False)
    with np.errstate(divide="ignore"):
        inverse = V.transpose(0, 2, 1) * np.where(sizes > _SMALLEST_EFFECT, 1 / sizes, 0.0)[:, None, :]
    inverse = inverse @ U.transpose(0, 2, 1)
    p, most = np.zeros((len(rest), effects.shape[2], 1)), np.sqrt(rest.shape[1])
    for _ in range(_PROJECTIONS):
        left = rest[open_, :, None] - effects[open_] @ p[open_]
        is_open = np.linalg.norm(left[:, :, 0], axis=1) > most
        found[open_[~is_open]] = True
        open_, left = open_[is_open], left[is_open]
        if not len(open_):
            return found
        p[open_] = np.clip(p[open_] + inverse[open_] @ left, -1.0, 1.0)
    for index in open_.tolist():
        best = lsq_linear(effects[index], rest[index], (-1.0, 1.0))
        if np.linalg.norm(best.fun) > most:
            break  # the first one that is not reachable is enough
        found[index] = True
    return found


def _in_hull(corners: Matrix, u: Vector, room: Vector) -> bool:
    """Return whether u is near a mixture of corners, (corners, m)."""
    weights = np.vstack([corners.T / room[:, None], np.full(len(corners), 1e6)])
    target = np.append(u / room, 1e6)
    rest = weights @ nnls(weights, target)[0] - target
    return bool(np.abs(rest[:-1]).max() <= 2.0)
