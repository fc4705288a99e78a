"""Whether a trace is a run of its loop document, and shows what was recorded.

What has to be right for a statement about a run is this file, the kernel, and what the document says. A trace
is a path: each item is a motion in a location, or an edge. For a run of the document

* the path begins at the start and has each recorded step: motions lead to the next step, edges take no time;
* an edge is taken while the clock is in its interval, where its facts hold, and z becomes J z;
* in a location the clock does not exceed its limit, the facts hold, and z moves as the motion says;
* x and u are the recorded x and u. The recorded x_s and x_c are not compared.

Between two steps of the plant the input is constant. A motion whose corners have a common part,
Fᵢ = F + B Uᵢ, moves as ż = F z + B u + Σ c p with u = Σ λᵢ Uᵢ z. So z at the end follows from z and u, but
for the signals p, which may change during the step; and u is in the hull of the Uᵢ z at both ends. All is
computed in floating point, with tolerances relative to the sizes of the terms.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.optimize import nnls

from cosim.analysis.conformance.trace import Trace
from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix, Vector

STATE, MOTION, INPUT, FACT = 1e-7, 1e-6, 1e-6, 1e-9
"""Largest differences that count as rounding: of z, of its motion, of u and of facts, relative."""
CLOCK_NS = 2
_MOST_HULLS = 300
"""Steps at which the hull of several inputs is tested; a single input is tested at all steps."""
_TINY = 1e-12
_PROJECTIONS = 60
_LEAST_DIRECTION = 0.02
"""Directions in which signals have a smaller share of their effect are left out."""
Table = Mapping[str, Any]


class RefutedError(Exception):
    """The trace is no run of the document."""

    def __init__(self, t_s: float, what: str) -> None:
        super().__init__(f"{what}, at {t_s:.6g} s")
        self.t_s, self.what = t_s, what


class Conformance(NamedTuple):
    """Whether a run is one of a document."""

    until_s: float
    """Up to this time."""
    reason: str
    """What failed then; empty: the whole run is one of the document."""
    edges: Mapping[str, int]
    """How often each edge of the document was taken."""
    clocks: Mapping[str, float]
    """By location, the largest share of its clock's limit that was reached."""
    document: str
    """Name of the document."""

    @property
    def conforms(self) -> bool:
        """Whether the whole run is a run of the document."""
        return not self.reason

    @property
    def verdict(self) -> str:
        """The result in one sentence."""
        taken = sum(count > 0 for count in self.edges.values())
        coverage = f"{taken} of the document's {len(self.edges)} kinds of transitions occurred"
        if self.conforms:
            return (
                f"the run is a run of the loop document {self.document!r}, so the bounds of states, outputs "
                f"and inputs that are proved of this document hold for the run; {coverage}"
            )
        return (
            f"the run is a run of the loop document {self.document!r} until {self.until_s:.6g} s only: "
            f"{self.reason}; from then on the bounds that are proved of this document need not hold; "
            f"{coverage}"
        )


def compare(trace: Trace, document: Table) -> Conformance:
    """Return whether a trace is a run of a document."""
    checked = _Checked(trace, document)
    failures: list[RefutedError] = []
    for check in (checked.path, checked.edges, checked.locations, checked.motions, checked.record):
        try:
            check()
        except RefutedError as refuted:
            failures.append(refuted)
    first = min(failures, key=lambda failure: failure.t_s, default=None)
    until_s = float(trace.t_ns[-1]) / NS_PER_S if first is None else first.t_s
    names = [edge["name"] for edge in document["edges"] if edge["to"] is not None]
    taken = Counter(item.name for item in trace.items if not item.is_motion)
    counts = {name: taken[name] for name in names}
    reason = "" if first is None else first.what
    return Conformance(until_s, reason, counts, checked.clock_shares(), document["name"])


@dataclass
class _Split:
    """A motion ż = F z + B u + Σ c p with u in the hull of Uᵢ z."""

    F: Matrix
    B: Matrix
    U: Sequence[Matrix]
    columns: Matrix
    rows: Sequence[Matrix]


class _Checked:
    def __init__(self, trace: Trace, document: Table) -> None:
        self._trace, self._document = trace, document
        self._names = [coordinate["name"] for coordinate in document["coordinates"]]
        self._noise = [i for i, c in enumerate(document["coordinates"]) if c.get("noise")]
        self._states = [i for i in range(len(self._names)) if i not in self._noise]
        self._locations = {location["name"]: location for location in document["locations"]}
        self._edges = {edge["name"]: edge for edge in document["edges"]}
        self._rows = {name: _matrix(rows) for name, rows in document["rows"].items()}
        self._z, self._clocks_ns = trace.z, np.array(trace.clocks_ns)
        self._t_s = trace.t_ns[np.array(trace.steps)] / NS_PER_S
        self._is_motion = np.array([item.is_motion for item in trace.items], dtype=bool)
        self._by_name: dict[str, list[int]] = {}
        for index, item in enumerate(trace.items):
            self._by_name.setdefault(item.name, []).append(index)

    # The path.

    def path(self) -> None:
        """Require that the path begins at the start, has all steps, and that items follow each other."""
        start, place = self._document["start"], self._document["start"]["location"]
        Z = _matrix(start["columns"])
        noise = self._z[0, self._noise]
        self._require_near(
            0, self._z[0, self._states], (Z @ np.append(1.0, noise))[self._states], "z at the start"
        )
        steps = np.array(self._trace.steps)
        self._require(
            np.arange(len(steps) - 1), np.diff(steps) == self._is_motion, "the path does not go step by step"
        )
        if steps[0] != 0 or steps[-1] != len(self._trace.t_ns) - 1:
            raise RefutedError(float(self._t_s[-1]), "the path does not have all steps of the record")
        for index, item in enumerate(self._trace.items):
            if item.is_motion:
                if item.name != place or item.name not in self._locations:
                    raise RefutedError(
                        float(self._t_s[index]), f"time passes in {item.name!r} after {place!r}"
                    )
                continue
            edge = self._edges.get(item.name)
            if edge is None or edge["from"] != place or edge["to"] is None:
                raise RefutedError(float(self._t_s[index]), f"the document has no transition {item.name!r}")
            place = edge["to"]

    def edges(self) -> None:
        """Require that edges are taken at their times, where their facts hold, and that z jumps to J z."""
        failures = []
        for name, edge in self._edges.items():
            if not (places := self._by_name.get(name)):
                continue
            at = np.array(places)
            try:
                self._edge(edge, at)
            except RefutedError as refuted:
                failures.append(refuted)
        if failures:
            raise min(failures, key=lambda failure: failure.t_s)

    def _edge(self, edge: Table, at: Vector) -> None:
        clock, after = self._clocks_ns[at], self._clocks_ns[at + 1]
        if edge.get("when") is not None:
            first, last = (_value(end) * NS_PER_S for end in edge["when"])
            self._require(
                at,
                (clock >= first - CLOCK_NS) & (clock <= last + CLOCK_NS),
                f"{edge['name']}: the clock is not within {first / 1e6:g} to {last / 1e6:g} ms",
            )
        limit = self._locations[edge["to"]].get("clock")
        end = np.inf if limit is None else _value(limit) * NS_PER_S
        expected = {
            "zero": after == 0,
            "keeps": after == clock,
            "any": (after >= 0) & (after <= end + CLOCK_NS),
        }
        self._require(at, expected[edge["clock"]], f"{edge['name']}: the clock is another one after it")
        for fact in edge["facts"]:
            self._require(at, self._holds(fact, self._z[at]), f"{edge['name']}: {fact!r} does not hold")
        jumped = self._z[at] @ _matrix(edge["jump"]).T
        scale = np.abs(self._z[at]) @ np.abs(_matrix(edge["jump"])).T
        near = (
            np.abs(self._z[at + 1] - jumped)
            <= STATE * (scale + np.abs(self._z[at + 1])) + _TINY * self._size()
        )
        self._require(at, near[:, self._states].all(axis=1), f"{edge['name']}: z is another one after it")

    # Locations and motions.

    def locations(self) -> None:
        """Require of each location that its clock is within its limit, and that its facts hold."""
        for name, location in self._locations.items():
            at = self._motions_of(name)
            if not len(at):
                continue
            moved = self._clocks_ns[at + 1] - self._clocks_ns[at]
            dt = (self._t_s[at + 1] - self._t_s[at]) * NS_PER_S
            self._require(at, np.abs(moved - dt) <= CLOCK_NS, f"{name}: the clock is not that of the record")
            if location.get("clock") is not None:
                limit = _value(location["clock"]) * NS_PER_S
                self._require(
                    at,
                    self._clocks_ns[at + 1] <= limit + CLOCK_NS,
                    f"{name!r} lasts longer than {limit / 1e6:g} ms",
                )
            outside = [
                i for i in self._states if self._names[i] not in (*location["coordinates"], *self._units())
            ]
            zero = np.abs(self._z[at][:, outside]) <= STATE * self._size()
            self._require(at, zero.all(axis=1), f"{name!r}: a coordinate that it lacks is not 0")
            for fact in location["facts"]:
                for ends in (at, at + 1):
                    self._require(at, self._holds(fact, self._z[ends]), f"{name!r}: {fact!r} does not hold")

    def motions(self) -> None:
        """Require that z moves as the motions say, for some signals, and that u is in their hull."""
        for name, location in self._locations.items():
            at = self._motions_of(name)
            if not len(at):
                continue
            split = self._split(location["motion"])
            self._flows(name, split, at)
            self._inputs(name, split, at)

    def _flows(self, name: str, split: _Split, at: Vector) -> None:
        dt_s, u = self._t_s[at + 1] - self._t_s[at], self._trace.u[np.array(self._trace.steps)[at]]
        for length in np.unique(np.round(dt_s, 9)):
            here = at[np.round(dt_s, 9) == length]
            n, m, k = len(split.F), split.B.shape[1], split.columns.shape[1]
            whole = np.zeros((n + m + k, n + m + k))
            whole[:n, :n], whole[:n, n : n + m], whole[:n, n + m :] = split.F, split.B, split.columns
            moved = expm(whole * length)[:n]
            now, then = self._z[here], self._z[here + 1]
            inputs = u[np.round(dt_s, 9) == length]
            rest = then - now @ moved[:, :n].T - inputs @ moved[:, n : n + m].T
            scale = np.abs(now) @ np.abs(split.F).T + np.abs(inputs) @ np.abs(split.B).T
            allowed = MOTION * length * scale + STATE * 1e-3 * np.abs(then) + _TINY * self._size()
            changes = min(float(np.linalg.norm(split.F, 2)) * length, 0.5)  # of a signal's effect in a step
            columns = moved[self._states, n + m :]
            free = allowed[:, self._states] + changes * np.abs(rest).max(axis=1, initial=0)[:, None] * bool(
                columns.size
            )
            explained = self._explained(rest[:, self._states], free, columns, split, now, then)
            self._require(here, explained, f"{name!r}: no motion of the document leads to what was recorded")

    @staticmethod
    def _explained(
        rest: Vector, free: Vector, columns: Matrix, split: _Split, now: Vector, then: Vector
    ) -> Vector:
        """Return which rests are Σ column p with |p| ≤ |Rz|, but for what is ``free``.

        Signals may vary during a step: |Rz| is the larger one of both ends, plus what it changes by. Signals
        are found by projections in turn, on those that explain the rest and on those within their limits.
        """
        if not columns.shape[1]:
            return np.asarray((np.abs(rest) <= free).all(axis=1))
        sizes = [[np.linalg.norm(z @ R.T, axis=1) for z in (now, then, then - now)] for R in split.rows]
        limits = np.stack([np.maximum(first, last) + change for first, last, change in sizes], axis=1)
        scaled = columns * limits[:, None, :]  # (steps, coordinates, signals)
        inverse, p = np.linalg.pinv(scaled, rcond=_LEAST_DIRECTION), np.zeros((*limits.shape, 1))
        for _ in range(_PROJECTIONS):
            p = np.clip(p + inverse @ (rest[:, :, None] - scaled @ p), -1.0, 1.0)
        return np.asarray((np.abs(rest - (scaled @ p)[:, :, 0]) <= free).all(axis=1))

    def _inputs(self, name: str, split: _Split, at: Vector) -> None:
        u = self._trace.u[np.array(self._trace.steps)[at]]
        for ends in (at, at + 1):
            corners = np.stack([self._z[ends] @ U.T for U in split.U])  # (corners, steps, m)
            scale = np.max([np.abs(self._z[ends]) @ np.abs(U).T for U in split.U], axis=0)
            room = INPUT * scale + _TINY * self._size()
            inside = (u >= corners.min(axis=0) - room) & (u <= corners.max(axis=0) + room)
            what = f"{name!r}: the input is none that the document allows"
            self._require(at, inside.all(axis=1), what)
            if u.shape[1] > 1:
                some = np.unique(np.linspace(0, len(at) - 1, min(len(at), _MOST_HULLS)).astype(int))
                fits = np.array([_in_hull(corners[:, i], u[i], room[i]) for i in some])
                self._require(at[some], fits, what)

    def _split(self, motion: str) -> _Split:
        """Return the parts of a motion; raise RefutedError if its corners have no common part."""
        corners = self._document["motions"][motion]
        F = [_matrix(corner["matrix"]) for corner in corners]
        U = [_matrix(corner["input"]) for corner in corners]
        unknown = corners[0]["unknown"]
        columns = np.hstack([_matrix(each["column"]) for each in unknown] or [np.zeros((len(F[0]), 0))])
        rows = [_matrix(each["rows"]) for each in unknown]
        if len(corners) == 1:  # then u is U z, and F has its part
            return _Split(F[0], np.zeros((len(F[0]), len(U[0]))), U, columns, rows)
        mean_F, mean_U = sum(F) / len(F), sum(U) / len(U)
        differences = np.hstack([each - mean_U for each in U]), np.hstack([each - mean_F for each in F])
        B = differences[1] @ np.linalg.pinv(differences[0])
        if np.abs(B @ differences[0] - differences[1]).max(initial=0) > 1e-6 * (np.abs(mean_F).max() + _TINY):
            raise RefutedError(0.0, f"the motion {motion!r} has no common part, and is not compared yet")
        return _Split(np.asarray(mean_F - B @ mean_U), B, U, columns, rows)

    # The record.

    def record(self) -> None:
        """Require that x is the recorded one."""
        steps = np.array(self._trace.steps)
        x = self._z[:, : self._trace.x.shape[1]]
        near = np.abs(x - self._trace.x[steps]) <= STATE * np.abs(self._trace.x[steps])
        self._require(np.arange(len(steps)), near.all(axis=1), "x is not the recorded one")

    def clock_shares(self) -> dict[str, float]:
        """Return the largest share of each clock's limit."""
        found = {}
        for name, location in self._locations.items():
            at = self._motions_of(name)
            if location.get("clock") is not None and _value(location["clock"]) > 0:
                limit = _value(location["clock"]) * NS_PER_S
                found[name] = float(self._clocks_ns[at + 1].max(initial=0) / limit)
        return found

    # Parts.

    def _units(self) -> list[str]:
        decaying = self._document.get("decaying")
        return [decaying["coordinate"] if decaying else "", self._document.get("constant") or ""]

    def _motions_of(self, name: str) -> Vector:
        places = [i for i in self._by_name.get(name, []) if self._is_motion[i]]
        return np.array(places, dtype=int)

    def _holds(self, fact: str, z: Vector) -> Vector:
        left, right = (
            sum((np.square(z @ self._rows[name].T).sum(axis=1) for name in names), np.zeros(len(z)))
            for names in (self._document["facts"][fact]["less"], self._document["facts"][fact]["more"])
        )
        return np.asarray(left <= right * (1 + FACT) + _TINY**2)

    def _size(self) -> float:
        return float(np.abs(self._z[:, self._states]).max()) or 1.0

    def _require(self, at: NDArray[Any], holds: NDArray[Any], what: str) -> None:
        if not holds.all():
            raise RefutedError(float(self._t_s[at[int(np.argmin(holds))]]), what)

    def _require_near(self, index: int, found: Vector, expected: Vector, what: str) -> None:
        if (np.abs(found - expected) > STATE * (1 + np.abs(expected))).any():
            raise RefutedError(float(self._t_s[index]), f"{what} is another one")


def _in_hull(corners: Matrix, u: Vector, room: Vector) -> bool:
    """Return whether u is near a mixture of corners, (corners, m)."""
    weights = np.vstack([corners.T / room[:, None], np.full(len(corners), 1e6)])
    target = np.append(u / room, 1e6)
    rest = weights @ nnls(weights, target)[0] - target
    return bool(np.abs(rest[:-1]).max() <= 2.0)


def _value(entry: Any) -> float:
    if isinstance(entry, list):
        return (_value(entry[0]) + _value(entry[1])) / 2
    return float(Fraction(entry)) if isinstance(entry, str) else float(entry)


def _matrix(rows: Sequence[Sequence[Any]]) -> Matrix:
    return np.array([[_value(entry) for entry in row] for row in rows], dtype=float)
