"""The loop document of a time-triggered loop: one edge for each outcome until the next transmission.

When everything happens is known, so that an edge is a list of linear steps in order of time: the plant moves,
an update is sent or arrives, a tick of the controller computes an input, an input acts. At one time the order
is: an input acts, an update is sent, one arrives, a tick. The states are those about the set-point.

A *location* says how many of the last updates were lost, and what else the next edge depends on: the state of
the guarantee's other rules, where the ticks are (the *slot*), and inputs that wait to act.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from math import exp, floor
from typing import Any, NamedTuple

import numpy as np

from netem.guarantee.loss_guarantee import LossGuarantee
from noack.core.linear_systems import Matrix, Vector
from noack.proof.loop_document import FORMAT, NoDocumentError
from noack.proof.numbers import as_written, quotient
from noack.proof.period_times import NEVER, LoopTimes

Table = dict[str, Any]
_MOST_LOCATIONS, _MOST_EDGES, _MOST_COORDINATES = 200, 2000, 60
"""Of the kernel."""
_MOST_OUTCOMES = 27
"""Outcomes of the inputs of a period; for more, no input is late."""
_LONGEST_CYCLE = 6
"""Of steps that are written once and repeated."""
_DECAY_DIGITS = 15
_ROUNDED = 1e-9
"""What is so small, relative to its terms, is 0 but for rounding."""


@dataclass(frozen=True)
class PeriodOutput:
    """An output y = row x, about the set-point."""

    name: str
    unit: str
    row: Vector


@dataclass(frozen=True)
class PeriodLoop:
    """A loop that transmits x at each period, or after some periods; n states, m inputs."""

    name: str
    A: Matrix
    B: Matrix
    K: Matrix
    H: Matrix
    """ẋ_c = H x_c between arrivals, (n, n); 0: a hold."""
    times: LoopTimes
    start: Vector
    """x(0), about the set-point."""
    input_before: Vector
    """The input before the first one acts, about that at the set-point."""
    safe_input: Vector
    """The same of the input when the newest update is too old."""
    push: Vector
    """ẋ at the set-point, (n,): 0 if the plant rests there."""
    states: Sequence[str]
    inputs: Sequence[str]
    state_units: Sequence[str] = ()
    outputs: Sequence[PeriodOutput] = ()
    late: int = 0
    """Most steps of the plant by which an input acts late."""
    knows_start: bool = False
    """Whether the controller knows x(0); else the first update is always delivered."""
    between: range = range(1, 2)
    """Periods that may be between two transmissions."""

    @property
    def outcomes_of_inputs(self) -> int:
        """How many ways there are for the inputs between two transmissions to be late."""
        period, found = self.times.period, 1
        for begin in range(0, self.times.slots * period, period):
            end = begin + self.between[-1] * period
            ticks = sum(is_tick for _, is_tick in self.times.occurrences(begin, end))
            found = max(found, int((self.late + 1) ** ticks))
        return found

    @property
    def covered_late(self) -> int:
        """Most steps by which inputs may be late in the document: 0 if there are too many outcomes."""
        return self.late if self.outcomes_of_inputs <= _MOST_OUTCOMES else 0


class _PeriodPlace(NamedTuple):
    """What the next period depends on."""

    state: tuple[int, ...]
    """Of the guarantee's rules."""
    lost: int
    """Updates lost since the one that the controller has."""
    slot: int
    waiting: tuple[tuple[int, int], ...] = ()
    """Inputs that do not act yet: in how many steps of the plant, and the number of the coordinate."""
    starting: int | None = None
    """The number of the period, until the first update arrives or may be lost."""


class _Outcome(NamedTuple):
    """What may happen in a period."""

    words: tuple[str, ...]
    steps: tuple[Any, ...]
    target: _PeriodPlace
    periods: int
    is_lost: bool


@dataclass
class _Walk:
    """What has happened in a period until now."""

    now: int
    waiting: tuple[tuple[int, int], ...]
    words: tuple[str, ...] = ()
    steps: list[Any] = field(default_factory=list)
    moved: int = 0
    """Since the last step that is no motion."""

    def copy(self) -> "_Walk":
        return _Walk(self.now, self.waiting, self.words, [*self.steps], self.moved)


class PeriodDocument:
    """The document of a loop.

    Args:
        loop: the loop.
        guarantee: the outcomes that are allowed.
        rate: r of the bounds, 1/s.

    Raises:
        NoDocumentError: it would be too large.
    """

    def __init__(self, loop: PeriodLoop, guarantee: LossGuarantee, rate: float = 0.0) -> None:
        self.loop, self._guarantee, self._rate = loop, guarantee, rate
        self.outcomes: dict[str, tuple[bool, int]] = {}
        """Of each edge: whether an update is delivered, and the slot of its beginning."""
        self.lost: dict[str, int] = {}
        """Of each location: updates lost in a row."""
        self._require_times()
        self._late, self._waiting = loop.covered_late, 1
        n, m = loop.B.shape
        self._holds = m < n and not loop.H.any()
        """Whether Kx stands for x where it is carried to the controller."""
        self.table = self._write()
        while self._most_waiting > self._waiting:
            self._waiting = self._most_waiting
            self.table = self._write()

    def _require_times(self) -> None:
        times, shortest = self.loop.times, self.loop.between[0] * self.loop.times.period
        if len(self.loop.between) == 1:
            return
        if times.timeout < NEVER or self.loop.knows_start:
            raise NoDocumentError("times between events that vary, with a timeout or a known start")
        if times.behind * times.period + times.latest >= shortest:
            raise NoDocumentError("updates that are on their way at the next event, at times that vary")

    @property
    def _behind(self) -> int:
        """So many further updates are sent while one is on its way."""
        return self.loop.times.behind if len(self.loop.between) == 1 else 0

    def _write(self) -> Table:
        self._names = self._coordinates()
        if len(self._names) > _MOST_COORDINATES:
            raise NoDocumentError(
                f"it would have {len(self._names)} coordinates, more than {_MOST_COORDINATES}"
            )
        self._index = {name: i for i, name in enumerate(self._names)}
        self._steps: dict[str, Table] = {}
        self._places: dict[_PeriodPlace, str] = {}
        self._edges: list[Table] = []
        self._walked: dict[tuple[_PeriodPlace, int, int | None], list[_Walk]] = {}
        self._most_waiting = 1
        return self._table()

    # Coordinates.

    def _coordinates(self) -> list[str]:
        loop, behind = self.loop, self._behind
        self._x = [*loop.states]
        carried = [*loop.inputs] if self._holds else self._x
        self._applied = [f"{name} applied" for name in loop.inputs]
        self._computed = [
            [f"{name} computed{_number(k)}" for name in loop.inputs] for k in range(self._waiting)
        ]
        self._received = [f"{name} {'received' if self._holds else 'model'}" for name in carried]
        ago = ["sent", *(f"sent {k} ago" for k in range(1, behind + 1))]
        self._on_way = [[f"{name} {when}" for name in carried] for when in ago]
        return [
            *self._x,
            *self._applied,
            *self._received,
            *(name for names in self._on_way for name in names),
            *(name for names in self._computed for name in names),
            "f1",
            "f2",
        ]

    def _row(self, entries: Mapping[str, Any]) -> list[Any]:
        return [entries.get(name, 0) for name in self._names]

    def _identity(self) -> dict[str, list[Any]]:
        return {name: self._row({name: 1}) for name in self._names}

    def _step(self, name: str, words: str, rows: Mapping[str, Mapping[str, Any]]) -> str:
        """Return the name of a step that sets some coordinates to combinations of all."""
        if name not in self._steps:
            changed = self._identity() | {key: self._row(entries) for key, entries in rows.items()}
            self._steps[name] = {"words": words, "matrix": list(changed.values())}
        return name

    def _flow(self) -> str:
        loop, name = self.loop, "motion"
        if name not in self._steps:
            rows = {key: self._row({}) for key in self._names}
            for i, key in enumerate(self._x):
                moved = _entries(self._x, loop.A[i]) | _entries(self._applied, loop.B[i])
                rows[key] = self._row(moved | _entries(["f2"], loop.push[i : i + 1]))
            if not self._holds and loop.H.any():
                for names in (self._received, *self._on_way):
                    for i, key in enumerate(names):
                        rows[key] = self._row(_entries(names, loop.H[i]))
            self._steps[name] = {"words": "the plant moves", "matrix": list(rows.values())}
        return name

    # The steps of a period.

    def _send(self) -> str:
        rows = self.loop.K if self._holds else np.eye(len(self._x))
        words = "an update is sent" + (", for the input that will be computed from it" if self._holds else "")
        return self._step(
            "send",
            words,
            {name: _entries(self._x, row) for name, row in zip(self._on_way[0], rows, strict=True)},
        )

    def _arrive(self) -> str:
        taken = zip(self._received, self._on_way[-1], strict=True)
        return self._step("arrival", "an update arrives", {name: {sent: 1} for name, sent in taken})

    def _tick(self, slot: int, dropped: Sequence[int], *, is_late: bool) -> str:
        loop, rows = self.loop, dict[str, Mapping[str, Any]]()
        for j, name in enumerate(self._computed[slot]):
            if is_late:
                rows[name] = _entries(["f2"], loop.safe_input[j : j + 1])
            elif self._holds:
                rows[name] = {self._received[j]: 1}
            else:
                rows[name] = _entries(self._received, loop.K[j])
        for other in dropped:
            rows |= {name: {} for name in self._computed[other]}
        what = "the safe input" if is_late else "an input"
        name = ("safe tick" if is_late else "tick") + _number(slot)
        name += "".join(f", without {other + 1}" for other in dropped)
        return self._step(name, f"the controller computes {what}", rows)

    def _act(self, slot: int) -> str:
        rows: dict[str, Mapping[str, Any]] = {
            name: {computed: 1} for name, computed in zip(self._applied, self._computed[slot], strict=True)
        }
        rows |= {name: {} for name in self._computed[slot]}
        return self._step(f"action{_number(slot)}", "the computed input acts on the plant", rows)

    def _end(self, periods: int) -> str:
        rows: dict[str, Mapping[str, Any]] = {}
        for newer, older in zip(self._on_way, self._on_way[1:], strict=False):
            rows |= {name: {sent: 1} for name, sent in zip(older, newer, strict=True)}
        rows |= {name: {} for name in self._on_way[0]}
        period = float(self.loop.times.exact_seconds(self.loop.times.period * periods))
        digits = 10**_DECAY_DIGITS
        decay = Fraction(floor(exp(-self._rate * period) * (1 - 1e-15) * digits), digits) if self._rate else 1
        rows["f1"] = {"f1": quotient(Fraction(decay))}
        name = "period" if len(self.loop.between) == 1 else f"{periods} periods"
        return self._step(name, "the next transmission is due", rows)

    # Places and outcomes.

    def _table(self) -> Table:
        loop, f1, f2 = self.loop, "f1", "f2"
        first = _PeriodPlace(self._guarantee.start, 0, 0, starting=0)
        self._places[first] = self._name(first)
        pending = [first]
        while pending:
            place = pending.pop(0)
            seen = set[tuple[Any, ...]]()
            for outcome in self._outcomes(place):
                if outcome.target not in self._places:
                    self._places[outcome.target] = self._name(outcome.target)
                    pending.append(outcome.target)
                key = repr(outcome.steps), outcome.target
                if key not in seen:
                    seen.add(key)
                    self._add_edge(place, outcome)
            if len(self._places) > _MOST_LOCATIONS or len(self._edges) > _MOST_EDGES:
                raise NoDocumentError(
                    f"it would have more than {_MOST_LOCATIONS} locations or {_MOST_EDGES:,} edges"
                )
        self.lost = {name: place.lost for place, name in self._places.items()}
        units = dict(zip(self._x, loop.state_units, strict=False))
        where = list(self._places.values())
        values = dict(zip(self._x, loop.start, strict=True)) | dict(
            zip(self._applied, loop.input_before, strict=True)
        )
        if loop.knows_start:
            known = loop.K @ loop.start if self._holds else loop.start
            values |= dict(zip(self._received, known, strict=True))
        return {
            "format": FORMAT,
            "name": loop.name,
            "about": self._about(),
            "coordinates": [{"name": name, "unit": units.get(name, "")} for name in self._names],
            "decaying": {"coordinate": f1, "rate": self._rate},
            "constant": f2,
            "rows": {},
            "facts": {},
            "motions": {},
            "steps": self._steps,
            "locations": [
                {"name": name, "coordinates": self._inside(place), "motion": None, "facts": []}
                for place, name in self._places.items()
            ],
            "edges": self._edges,
            "start": {
                "location": self._places[first],
                "columns": [
                    [1 if name in (f1, f2) else _exact(values.get(name, 0.0))] for name in self._names
                ],
                "facts": [],
            },
            "outputs": [
                {
                    "name": output.name,
                    "unit": output.unit,
                    "rows": [self._row(_entries(self._x, output.row))],
                    "in": where,
                    "during_edges": True,
                }
                for output in loop.outputs
            ],
        }

    def _about(self) -> str:
        late = f"; an input acts up to {self._late} steps of the plant late" if self._late else ""
        return f"Each edge is a period. States and inputs are those about the set-point{late}."

    def _name(self, place: _PeriodPlace) -> str:
        """Return a name that no other place has."""
        parts = [f"start {place.starting}" if place.starting is not None else f"{place.lost} lost"]
        if self.loop.times.slots > 1:
            parts.append(f"slot {place.slot}")
        parts += [f"input in {steps + 1} steps" for steps, _ in place.waiting]
        name, names = ", ".join(parts), {*self._places.values()}
        number = 2
        while name in names:
            name, number = f"{', '.join(parts)} ({number})", number + 1
        return name

    def _inside(self, place: _PeriodPlace) -> list[str]:
        """Return the coordinates that may differ from 0 in a place."""
        behind = self._behind
        sent = (
            behind if place.starting is None else min(max(place.starting - self.loop.knows_start, 0), behind)
        )
        received = place.starting is None or self.loop.knows_start
        waiting = [name for _, slot in place.waiting for name in self._computed[slot]]
        on_way = [name for names in self._on_way[1 : sent + 1] for name in names]
        return [*self._x, *self._applied, *(self._received if received else ()), *on_way, *waiting]

    def _outcomes(self, place: _PeriodPlace) -> Iterator[_Outcome]:
        for periods in self.loop.between:
            yield from self._outcomes_after(place, periods)

    def _outcomes_after(self, place: _PeriodPlace, periods: int) -> Iterator[_Outcome]:
        """Yield what may happen until the next transmission, which is so many periods later."""
        times, behind = self.loop.times, self._behind
        target = place._replace(slot=(place.slot + periods) % times.slots)
        last_start = behind + int(self.loop.knows_start)
        if place.starting is not None and place.starting < last_start:
            follows = target._replace(starting=place.starting + 1)
            if self.loop.knows_start and place.starting + 1 == last_start:
                follows = target._replace(starting=None, lost=0)
            yield from self._walks(place, follows, periods, None, "")
            return
        delivered = self._guarantee.after(place.state, lost=False)
        if delivered is not None:
            arrivals = sorted({*times.arrivals(place.slot)})
            for arrival in arrivals:
                words = "delivered" if len(arrivals) == 1 else ("early" if arrival == arrivals[0] else "late")
                follows = target._replace(state=delivered, lost=0, starting=None)
                arrival += (times.behind - behind) * times.period
                yield from self._walks(place, follows, periods, arrival, words)
        lost = self._guarantee.after(place.state, lost=True)
        if lost is not None and place.starting is None:
            follows = target._replace(state=lost, lost=place.lost + 1)
            yield from self._walks(place, follows, periods, None, "lost")

    def _walks(
        self, place: _PeriodPlace, target: _PeriodPlace, periods: int, arrival: int | None, words: str
    ) -> Iterator[_Outcome]:
        """Yield the outcomes until the next transmission; an update arrives after so long, or none does."""
        # The state of the guarantee makes no difference until then, nor do losses without a timeout.
        lost = place.lost if self.loop.times.timeout < NEVER else 0
        key = place._replace(state=(), lost=lost), periods, arrival
        if key not in self._walked:
            self._walked[key] = self._walk(place, periods, arrival)
        after = () if len(self.loop.between) == 1 else (f"{periods} periods",)
        for walk in self._walked[key]:
            reached, named = target._replace(waiting=walk.waiting), [words] if words else []
            yield _Outcome(
                (*named, *after, *walk.words), tuple(walk.steps), reached, periods, is_lost=words == "lost"
            )

    def _walk(self, place: _PeriodPlace, periods: int, arrival: int | None) -> list[_Walk]:
        """Return what may happen until the next transmission."""
        times = self.loop.times
        begin = place.slot * times.period
        end = begin + periods * times.period
        events = [(t, 3 if is_tick else 0) for t, is_tick in times.occurrences(begin, end)]
        if arrival is not None and (begin + arrival - 1, 3) in events:
            events.append((begin + arrival - 1, 4))  # at the tick, but after it
        elif arrival is not None:
            events.append((begin + arrival, 2))
        if not (self.loop.knows_start and place.starting == 0):
            events.append((begin, 1))
        walks = [_Walk(begin, place.waiting)]
        has_arrived = False
        for time, kind in sorted(events):
            for walk in walks:
                self._move(walk, time)
            if kind == 0:
                for walk in walks:
                    self._step_plant(walk)
            elif kind == 3:
                walks = self._ticked(walks, place, time - begin, has_arrived=has_arrived)
            else:
                has_arrived |= kind != 1
                for walk in walks:
                    self._take(walk, self._send() if kind == 1 else self._arrive())
        for walk in walks:
            self._move(walk, end)
            self._take(walk, self._end(periods))
        return walks

    def _move(self, walk: _Walk, time: int) -> None:
        walk.moved += time - walk.now
        walk.now = time

    def _take(self, walk: _Walk, step: str) -> None:
        if walk.moved:
            seconds = quotient(self.loop.times.exact_seconds(walk.moved))
            walk.steps.append({"exp": self._flow(), "seconds": seconds})
            walk.moved = 0
        walk.steps.append(step)

    def _step_plant(self, walk: _Walk) -> None:
        """Let the inputs act whose time has come."""
        due = [slot for steps, slot in walk.waiting if steps == 0]
        for slot in due:
            self._take(walk, self._act(slot))
        walk.waiting = tuple((steps - 1, slot) for steps, slot in walk.waiting if steps > 0)

    def _ticked(
        self, walks: Sequence[_Walk], place: _PeriodPlace, since: int, *, has_arrived: bool
    ) -> list[_Walk]:
        """Return what may be after a tick: its input acts at the next step of the plant, or later."""
        times, found = self.loop.times, list[_Walk]()
        if not has_arrived and place.starting is not None and not self.loop.knows_start:
            return [*walks]  # nothing is known, and no input computed
        periods = self._behind + (0 if has_arrived else 1 + place.lost)
        is_late = place.starting is None or has_arrived
        is_late &= since + periods * times.period >= times.timeout
        if is_late and times.holds_input:
            return [*walks]
        for walk in walks:
            for late in range(self._late + 1):
                other = walk.copy() if self._late else walk
                dropped = [slot for steps, slot in walk.waiting if steps >= late]
                kept = tuple((steps, slot) for steps, slot in walk.waiting if steps < late)
                used = {slot for _, slot in kept}
                slot = min({*range(self._late + 1)} - used)
                self._most_waiting = max(self._most_waiting, slot + 1)
                slot = min(slot, self._waiting - 1)
                self._take(other, self._tick(slot, [k for k in dropped if k != slot], is_late=is_late))
                other.waiting = (*kept, (late, slot))
                if self._late:
                    other.words = (*walk.words, f"input {late} late")
                found.append(other)
        return found

    def _add_edge(self, place: _PeriodPlace, outcome: _Outcome) -> None:
        name = ", ".join((self._places[place], *(outcome.words or ("sent",))))
        number, names, unique = 2, {edge["name"] for edge in self._edges}, name
        while unique in names:
            unique, number = f"{name} ({number})", number + 1
        self.outcomes[unique] = not outcome.is_lost, place.slot
        self._edges.append({
            "name": unique,
            "from": self._places[place],
            "to": self._places[outcome.target],
            "clock": "zero",
            "facts": [],
            "jump": _folded(outcome.steps),
            "duration": quotient(self.loop.times.exact_seconds(self.loop.times.period * outcome.periods)),
        })  # fmt: skip


def _number(k: int) -> str:
    return f" {k + 1}" if k else ""


def _entries(names: Sequence[str], values: Sequence[float] | Vector) -> dict[str, Any]:
    return {name: _exact(value) for name, value in zip(names, values, strict=True) if value}


def _exact(value: float) -> Any:
    """Return a number as a scenario has it."""
    return quotient(as_written(float(value)))


def _folded(steps: Sequence[Any]) -> list[Any]:
    """Return steps in which those that come again and again are written once."""
    found, i = list[Any](), 0
    while i < len(steps):
        best, length = 1, 1
        for size in range(1, _LONGEST_CYCLE + 1):
            times = 1
            while steps[i + times * size : i + (times + 1) * size] == steps[i : i + size]:
                times += 1
            if times > 1 and times * size > best * length:
                best, length = times, size
        if best > 2:
            found.append({"repeat": list(steps[i : i + length]), "times": best})
            i += best * length
        else:
            found.append(steps[i])
            i += 1
    return found
