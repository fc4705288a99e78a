"""A loop document: what it says of a loop, read strictly. Rule R0 (well-formed) is here.

z is the vector of the document's coordinates. In a location z moves as the corners of a motion say, and a
clock runs. An edge may be taken while the clock is in an interval and the edge's facts hold; it sets
z := J z. An edge may last some time: then J is a product of steps (:mod:`.jumps`). A fact is an inequality
Σ|Rz|² ≤ Σ|R'z|². Nothing here knows a trigger, a network or a scenario.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from flint import fmpq, fmpq_mat

from noack_kernel.exact import (
    Matrix,
    RejectedError,
    beside,
    decay_below,
    decimal,
    product,
    rational,
    read_matrix,
    square,
    times_power,
    unit_rows,
    whole,
    zeros,
)
from noack_kernel.jumps import Products, Repeat, Step, Steps, duration_of

FORMAT = "noack-hybrid 1"
MOST_BYTES = 64 * 2**20
MOST_COORDINATES, MOST_LOCATIONS, MOST_EDGES, MOST_NODES = 60, 200, 2000, 64
MOST_SIGNALS = 200
MOST_STEPS = 100_000
"""Of an edge, repeated ones included."""
MOST_NAME = 200
MOST_TEXT = 2000
Table = Mapping[str, object]


@dataclass(frozen=True)
class Unknown:
    """A signal p in ż = … + ``column`` p with |p| ≤ |``rows`` z|, and p·(``along`` z) ≥ ``least`` p²."""

    column: Matrix
    rows: Matrix
    along: Matrix | None
    least: fmpq


@dataclass(frozen=True)
class Corner:
    """ż = ``matrix`` z + Σ column p, with the input u = ``input`` z. A motion is any mixture of corners."""

    matrix: Matrix
    input: Matrix
    unknown: tuple[Unknown, ...]

    @cached_property
    def velocity(self) -> Matrix:
        """ż as rows of (z, p)."""
        found = self.matrix
        for each in self.unknown:
            found = beside(found, each.column)
        return found

    @cached_property
    def squares(self) -> list[tuple[Matrix, Matrix | None]]:
        """|p|² − |Rz|² of each signal, and 2 k p² − 2 p·Cz if it goes along with a row, on (z, p)."""
        size, found = self.matrix.height, list[tuple[Matrix, Matrix | None]]()
        z = unit_rows(range(size), size + len(self.unknown))
        for index, signal in enumerate(self.unknown):
            p, along = unit_rows([size + index], z.width), None
            if signal.along is not None:
                along = square(p).times(2 * signal.least) - product(p, signal.along @ z)
            found.append((square(p) - square(signal.rows @ z), along))
        return found


@dataclass(frozen=True)
class Location:
    """Where z moves until an edge is taken. Its ``facts`` hold all the time."""

    name: str
    coordinates: tuple[int, ...]
    """The others are 0 here. Those of the units are among them."""
    clock: fmpq | None
    """The largest value of the clock, s; None: no limit."""
    motion: tuple[Corner, ...]
    """Empty: no time passes here, and the clock is 0."""
    facts: tuple[str, ...]


@dataclass(frozen=True)
class Edge:
    """z := ``jump`` z, possible while the clock is in [``first``, ``last``] and the facts hold."""

    name: str
    source: str
    target: str | None
    """None: the document says nothing of what follows. A proof has to show that the edge is never taken."""
    first: fmpq
    last: fmpq | None
    clock: str
    """What becomes of the clock: "zero", "keeps", or "any" value that the target allows."""
    facts: tuple[str, ...]
    jump: Matrix
    event: bool
    """Whether it counts as an event: a statement about the time between two events is about such edges."""
    steps: Steps
    """What happens during an edge, in order of time; ``jump`` is their product. Empty: it does not last."""
    duration: fmpq
    """How long the edge lasts, s."""


@dataclass(frozen=True)
class Output:
    """y = ``velocity`` ż + ``rows`` z, or an entry of u."""

    name: str
    unit: str
    rows: Matrix | None
    velocity: Matrix | None
    input: int | None
    locations: tuple[str, ...]
    during_edges: bool = False
    """Whether it is bounded during the edges that last, too."""


@dataclass(frozen=True)
class Limit:
    """The document describes the loop until |output| reaches ``less``."""

    output: str
    less: fmpq


class Document:
    """A document that is well-formed (R0).

    Args:
        text: the content of its file.

    Raises:
        RejectedError: it breaks a rule of the format; the message names the place.
    """

    def __init__(self, text: str) -> None:
        table = read_table(text, FORMAT, "document")
        required = {
            "format",
            "name",
            "coordinates",
            "rows",
            "facts",
            "motions",
            "locations",
            "edges",
            "start",
        }
        optional = {"decaying", "constant", "readings", "while", "about", "equations", "steps"}
        fields(table, "document", required | {"outputs"}, optional)
        self.digest = hashlib.sha256(text.encode()).hexdigest()
        self.name = name_of(table["name"], "name")
        self.coordinates, self.units_of, self.noise = self._read_coordinates(table["coordinates"])
        self.size = len(self.coordinates)
        self.rate, self.decaying, self.constant = self._read_units(table)
        self.units = [i for i in (self.decaying, self.constant) if i is not None]
        self.states = [i for i in range(self.size) if i not in self.noise]
        self.rows = {name: self._rows(rows, name) for name, rows in mapping(table["rows"], "rows").items()}
        self.words: dict[str, str] = {}
        self.facts = {name: self._fact(name, f) for name, f in mapping(table["facts"], "facts").items()}
        motions = mapping(table["motions"], "motions")
        self.motions = {name: self._motion(name, corners) for name, corners in motions.items()}
        self.products = Products(self.size)
        steps = mapping(table.get("steps", {}), "steps")
        self.steps = {name: self._read_step(name, mapping(value, name)) for name, value in steps.items()}
        found = [self._location(entry) for entry in entries(table["locations"], "locations")]
        self.locations = {location.name: location for location in found}
        self.edges = [self._edge(entry) for entry in entries(table["edges"], "edges")]
        _unique([location.name for location in found], "locations", MOST_LOCATIONS)
        _unique([edge.name for edge in self.edges], "edges", MOST_EDGES)
        self._require_time_to_pass()
        self._read_start(table["start"])
        outputs = [self._output(entry) for entry in entries(table["outputs"], "outputs")]
        _unique([output.name for output in outputs], "outputs")
        self.outputs = {output.name: output for output in outputs}
        self.limits = [self._limit(entry) for entry in entries(table.get("while", []), "while")]
        self.equations = None if "equations" not in table else mapping(table["equations"], "equations")
        """A claim about a plant's equations, which another program verifies; no bound depends on it."""
        for name, reading in mapping(table.get("readings", {}), "readings").items():
            self._read_reading(name, reading)

    # Coordinates and units.

    def _read_coordinates(self, value: object) -> tuple[list[str], list[str], list[int]]:
        names, units, noise = [], [], []
        for index, entry in enumerate(entries(value, "coordinates")):
            fields(entry, f"coordinate {index}", {"name", "unit"}, {"noise"})
            names.append(name_of(entry["name"], "coordinates"))
            units.append(text_of(entry["unit"], "coordinates"))
            if entry.get("noise", False) not in (False, True):
                raise RejectedError(f"{names[-1]}: noise is true or false")
            noise += [index] if entry.get("noise", False) else []
        _unique(names, "coordinates", MOST_COORDINATES)
        return names, units, noise

    def _read_units(self, table: Table) -> tuple[fmpq, int | None, int | None]:
        """Return r, and the coordinates f1 with ḟ1 = −r f1 and f2 = 1, from which bounds are made."""
        rate, decaying, constant = fmpq(0), None, None
        if table.get("decaying") is not None:
            entry = mapping(table["decaying"], "decaying")
            fields(entry, "decaying", {"coordinate", "rate"})
            rate, decaying = rational(entry["rate"]), self._state(entry["coordinate"])
        if table.get("constant") is not None:
            constant = self._state(table["constant"])
        if rate < 0 or (decaying is not None and decaying == constant):
            raise RejectedError("decaying: a rate below 0, or the coordinate that is constant")
        return rate, decaying, constant

    def _index(self, name: object) -> int:
        if not isinstance(name, str) or name not in self.coordinates:
            raise RejectedError(f"no coordinate is named {str(name)[:40]!r}")
        return self.coordinates.index(name)

    def _state(self, name: object) -> int:
        index = self._index(name)
        if index in self.noise:
            raise RejectedError(f"{name}: noise is no state")
        return index

    # Rows, facts and motions.

    def _rows(self, rows: object, name: str) -> Matrix:
        try:
            return read_matrix(rows, None, self.size)
        except RejectedError as error:
            raise RejectedError(f"{name[:40]}: {error}") from None

    def _fact(self, name: str, value: object) -> Matrix:
        """Return Q of a fact zᵀQz ≤ 0."""
        entry, total = mapping(value, name), zeros(self.size, self.size)
        fields(entry, f"fact {name}", {"less", "more", "words"})
        self.words[name] = text_of(entry["words"], name)
        for side, sign in (("less", 1), ("more", -1)):
            for rows in names_of(entry[side], self.rows, f"fact {name}"):
                total += square(self.rows[rows]).times(fmpq(sign))
        return total

    def _motion(self, name: str, value: object) -> tuple[Corner, ...]:
        corners = [self._corner(name, entry) for entry in entries(value, f"motion {name}")]
        if not corners:
            raise RejectedError(f"motion {name}: no corner")
        if any(len(corner.unknown) > MOST_SIGNALS for corner in corners):
            raise RejectedError(f"motion {name}: more than {MOST_SIGNALS} unknown signals")
        kinds = {(c.input.height, *(u.along is not None for u in c.unknown)) for c in corners}
        if len(kinds) > 1:
            raise RejectedError(f"motion {name}: corners with different inputs or unknown signals")
        return tuple(corners)

    def _corner(self, name: str, entry: Table) -> Corner:
        place = f"motion {name}"
        fields(entry, place, {"matrix", "input", "unknown"})
        F = read_matrix(entry["matrix"], self.size, self.size)
        unknown = tuple(self._unknown(place, each) for each in entries(entry["unknown"], place))
        for unit in self.units:
            slope = {unit: -self.rate} if unit == self.decaying else {}
            if not F.has_row(unit, slope):
                raise RejectedError(f"{place}: {self.coordinates[unit]} does not move as a unit")
        still = [*self.units, *self.noise]
        if not F.is_zero(self.noise, range(self.size)):
            raise RejectedError(f"{place}: noise has a motion")
        if not all(each.column.is_zero(still, [0]) for each in unknown):
            raise RejectedError(f"{place}: an unknown signal moves a unit or noise")
        return Corner(F, read_matrix(entry["input"], None, self.size), unknown)

    def _unknown(self, place: str, entry: Table) -> Unknown:
        fields(entry, f"{place}, unknown", {"column", "rows"}, {"along", "least"})
        if ("along" in entry) != ("least" in entry):
            raise RejectedError(f"{place}: along and least belong together")
        column = read_matrix(entry["column"], self.size, 1)
        rows = read_matrix(entry["rows"], None, self.size)
        if "along" not in entry:
            return Unknown(column, rows, None, fmpq(0))
        least = rational(entry["least"])
        if least < 0:
            raise RejectedError(f"{place}: least is below 0")
        return Unknown(column, rows, read_matrix(entry["along"], 1, self.size), least)

    # Locations, edges and the start.

    def _location(self, entry: Table) -> Location:
        name = name_of(entry.get("name"), "locations")
        fields(entry, f"location {name}", {"name", "coordinates", "motion", "facts"}, {"clock"})
        clock = None if entry.get("clock") is None else rational(entry["clock"])
        if clock is not None and clock < 0:
            raise RejectedError(f"location {name}: a clock below 0")
        inside = {self._state(each) for each in strings(entry["coordinates"], f"location {name}")} | {
            *self.units
        }
        facts = names_of(entry["facts"], self.facts, f"location {name}")
        if entry["motion"] is None:
            if clock not in (None, 0):
                raise RejectedError(f"location {name}: no time passes, and the clock is above 0")
            return Location(name, tuple(sorted(inside)), fmpq(0), (), facts)
        (motion,) = names_of([entry["motion"]], self.motions, f"location {name}")
        outside = [i for i in self.states if i not in inside]
        for corner in self.motions[motion]:
            moved = corner.matrix.is_zero(outside, [*inside, *self.noise])
            if not moved or not all(each.column.is_zero(outside, [0]) for each in corner.unknown):
                raise RejectedError(f"location {name}: a coordinate that it lacks moves")
        return Location(name, tuple(sorted(inside)), clock, self.motions[motion], facts)

    def _edge(self, entry: Table) -> Edge:
        name = name_of(entry.get("name"), "edges")
        place = f"edge {name}"
        optional = {"when", "jump", "event", "duration"}
        fields(entry, place, {"name", "from", "to", "clock", "facts"}, optional)
        event = entry.get("event", False)
        if not isinstance(event, bool):
            raise RejectedError(f"{place}: event is true or false")
        (source,) = names_of([entry["from"]], self.locations, place)
        end = self.locations[source].clock
        first, last = fmpq(0), end
        if entry.get("when") is not None:
            when = entry["when"]
            if not isinstance(when, list) or len(when) != 2:
                raise RejectedError(f"{place}: when has not two ends")
            first, last = rational(when[0]), rational(when[1])
            if not 0 <= first <= last or (end is not None and last > end):
                raise RejectedError(f"{place}: when is not within the clock of {source}")
        facts = names_of(entry["facts"], self.facts, place)
        if entry["clock"] not in ("zero", "keeps", "any"):
            raise RejectedError(f"{place}: the clock is zero, keeps, or any")
        if entry["to"] is None:
            if "jump" in entry or "duration" in entry:
                raise RejectedError(f"{place}: an edge that leads nowhere has no jump")
            nothing, clock = zeros(self.size, self.size), str(entry["clock"])
            return Edge(name, source, None, first, last, clock, facts, nothing, event, (), fmpq(0))
        (target,) = names_of([entry["to"]], self.locations, place)
        steps = self._steps(place, entry.get("jump"))
        duration = duration_of(steps)
        if rational(entry.get("duration", fmpq(0))) != duration:
            raise RejectedError(f"{place}: the duration is not the sum of its steps")
        J = self._product(steps) if steps else read_matrix(entry.get("jump"), self.size, self.size)
        self._require_jump(place, J, duration, self.locations[source], self.locations[target])
        return Edge(name, source, target, first, last, str(entry["clock"]), facts, J, event, steps, duration)

    def _require_jump(
        self, place: str, J: Matrix, duration: fmpq, source: Location, target: Location
    ) -> None:
        outside = [i for i in self.states if i not in target.coordinates]
        if not J.is_zero(outside, [*source.coordinates, *self.noise]):
            raise RejectedError(f"{place}: a coordinate that {target.name} lacks is not 0 after it")
        if not J.is_zero(self.noise, range(self.size)):
            raise RejectedError(f"{place}: noise does not follow from a jump")
        for unit in self.units:
            factor = J.mid[unit, unit] if unit == self.decaying and duration > 0 else fmpq(1)
            if not J.has_row(unit, {unit: factor}):
                raise RejectedError(f"{place}: a unit changes")
            if unit == self.decaying and not 0 < factor <= decay_below(self.rate, duration):
                raise RejectedError(
                    f"{place}: {self.coordinates[unit]} decays more slowly than at its rate, or becomes 0"
                )

    # Steps of edges that last.

    def _read_step(self, name: str, value: Table) -> Matrix:
        fields(value, f"step {name}", {"matrix", "words"})
        text_of(value["words"], f"step {name}")
        return read_matrix(value["matrix"], self.size, self.size)

    def _steps(self, place: str, value: object) -> Steps:
        """Return the steps of a jump; none if it is a matrix."""
        if not isinstance(value, list) or not any(isinstance(each, str | dict) for each in value):
            return ()
        found = tuple(self._step_or_repeat(place, each) for each in value)
        if (
            sum(len(each.steps) * each.times if isinstance(each, Repeat) else 1 for each in found)
            > MOST_STEPS
        ):
            raise RejectedError(f"{place}: more than {MOST_STEPS} steps")
        return found

    def _step_or_repeat(self, place: str, value: object) -> Step | Repeat:
        if not isinstance(value, dict) or "repeat" not in value:
            return self._step(place, value)
        fields(value, place, {"repeat", "times"})
        times = whole(value["times"])
        if not isinstance(value["repeat"], list) or not value["repeat"] or times < 1:
            raise RejectedError(f"{place}: repeated are a list of steps, at least one, at least once")
        return Repeat(tuple(self._step(place, each) for each in value["repeat"]), times)

    def _step(self, place: str, value: object) -> Step:
        """Return z := M z for the name of M, or z := e^{Fs} z. Noise and f2 keep their values meanwhile."""
        if isinstance(value, dict):
            fields(value, place, {"exp", "seconds"})
            (name,), seconds = names_of([value["exp"]], self.steps, place), rational(value["seconds"])
            if seconds < 0:
                raise RejectedError(f"{place}: a time below 0")
            if not self.steps[name].is_zero([*self.units, *self.noise], range(self.size)):
                raise RejectedError(f"{place}: a unit or noise changes in {name}")
            return Step(name, self.steps[name], seconds)
        (name,) = names_of([value], self.steps, place)
        M = self.steps[name]
        decay = {} if self.decaying is None else {self.decaying: M.mid[self.decaying, self.decaying]}
        if not all(M.has_row(i, {i: decay.get(i, fmpq(1))}) for i in (*self.units, *self.noise)):
            raise RejectedError(f"{place}: a unit or noise changes in {name}")
        return Step(name, M, None)

    def _product(self, steps: Steps) -> Matrix:
        """Return the product of steps; the rows of units are exact, and noise does not follow from a jump."""
        found = self.products.of(steps)
        mid, radius = fmpq_mat(found.mid), None if found.radius is None else fmpq_mat(found.radius)
        for i in (*self.units, *self.noise):
            for j in range(self.size):
                mid[i, j] = fmpq(int(i == j and i not in self.noise))
                if radius is not None:
                    radius[i, j] = fmpq(0)
        if self.decaying is not None:
            mid[self.decaying, self.decaying] = self._decay_of(steps, self.decaying)
        return Matrix(mid, radius)

    def _decay_of(self, steps: Steps, index: int) -> fmpq:
        """Return the exact product of what the steps multiply f1 by."""
        found = fmpq(1)
        for step in steps:
            if isinstance(step, Repeat):
                found = times_power(found, self._decay_of(step.steps, index), step.times)
            elif step.seconds is None:
                found = times_power(found, step.matrix.mid[index, index], 1)
        return found

    def _require_time_to_pass(self) -> None:
        """Require that each cycle of edges has an edge that lasts, or a location in which time may pass."""
        left = {
            name: {e.target for e in self.edges if e.source == name and e.duration == 0}
            for name, location in self.locations.items()
            if not location.motion
        }
        while ends := [name for name, targets in left.items() if not targets & {*left}]:
            for name in ends:
                del left[name]
        if left:
            raise RejectedError(f"edges: no time passes in a cycle through {min(left)}")

    def _read_start(self, value: object) -> None:
        """Read z(0) = Z (1, p): a column, and one for each noise coordinate p."""
        entry = mapping(value, "start")
        fields(entry, "start", {"location", "columns", "facts"})
        (self.start,) = names_of([entry["location"]], self.locations, "start")
        self.start_facts = names_of(entry["facts"], self.facts, "start")
        self.start_columns = Z = read_matrix(entry["columns"], self.size, 1 + len(self.noise))
        outside = [i for i in self.states if i not in self.locations[self.start].coordinates]
        if not Z.is_zero(outside, range(Z.width)):
            raise RejectedError(f"start: a coordinate that {self.start} lacks is not 0")
        if not all(Z.has_row(unit, {0: fmpq(1)}) for unit in self.units):
            raise RejectedError("start: a unit is not 1")
        if not all(Z.has_row(i, {1 + k: fmpq(1)}) for k, i in enumerate(self.noise)):
            raise RejectedError("start: noise is not the column of its own")

    # Outputs, limits and readings.

    def _output(self, entry: Table) -> Output:
        name = name_of(entry.get("name"), "outputs")
        place = f"output {name}"
        fields(entry, place, {"name", "unit", "in"}, {"rows", "velocity", "input", "during_edges"})
        where = names_of(entry["in"], self.locations, place)
        if not where:
            raise RejectedError(f"{place}: it is in no location")
        unit = text_of(entry["unit"], place)
        if ("input" in entry or "velocity" in entry) and not all(self.locations[n].motion for n in where):
            raise RejectedError(f"{place}: a velocity or an input where no time passes")
        if entry.get("during_edges", False) not in (False, True):
            raise RejectedError(f"{place}: during_edges is true or false")
        during = bool(entry.get("during_edges", False))
        if during and ("input" in entry or "velocity" in entry):
            raise RejectedError(f"{place}: a velocity or an input during edges")
        if "input" in entry:
            index = whole(entry["input"])
            inputs = min(self.locations[each].motion[0].input.height for each in where)
            if "rows" in entry or "velocity" in entry or index >= inputs:
                raise RejectedError(f"{place}: not an entry of the input")
            return Output(name, unit, None, None, index, where)
        rows = self._rows(entry.get("rows"), place)
        if not rows.height:
            raise RejectedError(f"{place}: it has no row")
        velocity = None if "velocity" not in entry else read_matrix(entry["velocity"], rows.height, self.size)
        return Output(name, unit, rows, velocity, None, where, during)

    def _limit(self, entry: Table) -> Limit:
        """Read a limit; its output is one of all locations, and is continuous but for edges."""
        fields(entry, "while", {"output", "less"})
        (name,) = names_of([entry["output"]], self.outputs, "while")
        always_moves = all(location.motion for location in self.locations.values())
        if any(edge.duration > 0 for edge in self.edges) or not always_moves:
            raise RejectedError("while: a document with edges that last has no limits")
        less = rational(entry["less"])
        if less <= 0 or {*self.outputs[name].locations} != {*self.locations}:
            raise RejectedError(f"while {name}: not above 0, or the output is not one of all locations")
        if not self._is_continuous(self.outputs[name]):
            raise RejectedError(
                f"while {name}: a velocity, noise or a mixture of inputs may jump at any time"
            )
        return Limit(name, less)

    def _is_continuous(self, output: Output) -> bool:
        """Return whether an output is continuous between edges."""
        every = range(self.size)
        if output.velocity is not None:
            return False
        if output.rows is not None:
            return output.rows.is_zero(range(output.rows.height), self.noise)
        for name in output.locations:
            first, *others = [c.input.take([output.input or 0], every) for c in self.locations[name].motion]
            if not first.is_zero([0], self.noise) or not all(each.equals(first) for each in others):
                return False
        return True

    def _read_reading(self, name: str, value: object) -> None:
        """Read what a recorded column shows of z. Only a comparison with runs uses it."""
        for entry in entries(value, f"reading {name}"):
            fields(entry, f"reading {name}", {"rows", "in"})
            self._rows(entry["rows"], f"reading {name}")
            names_of(entry["in"], self.locations, f"reading {name}")


# Reading.


def read_table(text: str, expected: str, what: str) -> Table:
    """Return the table in a JSON text: exact numbers, no key twice, of the expected format.

    Args:
        text: the content of the file.
        expected: the format.
        what: the file is, for messages: the document, or the proof.

    Raises:
        RejectedError: it is none.
    """
    if len(text) > MOST_BYTES:
        raise RejectedError(f"the {what} is larger than {MOST_BYTES // 2**20} MiB")
    try:
        table = json.loads(
            text,
            parse_float=decimal,
            parse_int=decimal,
            parse_constant=lambda name: decimal(str(name)),
            object_pairs_hook=_once,
        )
    except RecursionError:
        raise RejectedError(f"the {what} is nested too deeply") from None
    except json.JSONDecodeError as error:
        raise RejectedError(f"the {what} is not JSON: {error}") from None
    except RejectedError as error:
        raise RejectedError(f"the {what}: {error}") from None
    found = table.get("format") if isinstance(table, dict) else None
    if found != expected:
        other = f", but one of {found[:40]!r}" if isinstance(found, str) else ""
        raise RejectedError(
            f'the {what} is not a file of the format "{expected}"{other}; '
            "the order is: noack-check DOCUMENT PROOF"
        )
    return dict(table)


def _once(pairs: Sequence[tuple[str, object]]) -> dict[str, object]:
    table = dict[str, object]()
    for key, value in pairs:
        if key in table:
            raise RejectedError(f"the key {key[:40]!r} occurs twice")
        table[key] = value
    return table


def fields(table: Table, place: str, required: set[str], optional: set[str] = frozenset()) -> None:  # type: ignore[assignment]
    """Require a table's keys to be those that it must have, and perhaps those that it may have."""
    if missing := sorted(required - {*table}):
        raise RejectedError(f"{place}: {missing[0]} is missing")
    if unknown := sorted({*table} - required - optional):
        raise RejectedError(f"{place}: unknown key {unknown[0][:40]!r}")


def mapping(value: object, place: str) -> Table:
    """Return a table."""
    if not isinstance(value, dict):
        raise RejectedError(f"{place[:80]}: not a table")
    return value


def entries(value: object, place: str) -> list[Table]:
    """Return a list of tables."""
    if not isinstance(value, list):
        raise RejectedError(f"{place[:80]}: not a list")
    return [mapping(each, place) for each in value]


def strings(value: object, place: str) -> list[str]:
    """Return a list of strings."""
    if not isinstance(value, list) or not all(isinstance(each, str) for each in value):
        raise RejectedError(f"{place[:80]}: not a list of names")
    return value


def text_of(value: object, place: str) -> str:
    """Return a printable text, perhaps empty."""
    if not isinstance(value, str) or not value.isprintable() or len(value) > MOST_NAME:
        raise RejectedError(f"{place[:80]}: not a printable text of at most {MOST_NAME} characters")
    return value


def name_of(value: object, place: str) -> str:
    """Return a name."""
    if not text_of(value, place):
        raise RejectedError(f"{place[:80]}: a name is empty")
    return str(value)


def names_of(value: object, names: Iterable[str], place: str) -> tuple[str, ...]:
    """Return names, all of which are known, each once."""
    found, known = strings(value, place), {*names}
    if unknown := [each for each in found if each not in known]:
        raise RejectedError(f"{place[:80]}: unknown name {unknown[0][:40]!r}")
    _unique(found, place)
    return tuple(found)


def _unique(names: Sequence[str], place: str, most: int | None = None) -> None:
    if len({*names}) < len(names):
        raise RejectedError(f"{place[:80]}: a name occurs twice")
    if most is not None and len(names) > most:
        raise RejectedError(f"{place[:80]}: more than {most}")
