"""The loop document of a loop: coordinates, facts, motions, locations and edges, as the kernel reads them.

A document says nothing of a trigger or a network: losses are locations, deliveries are edges, a threshold is
a fact. It has the form of ``noack.proof.elaborate.hybrid_system``, in which the search finds its proofs.
"""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np
from flint import arb, arb_mat, fmpq

from noack.core.balls import columns_of, identity, is_zero, rows_of
from noack.core.linear_systems import Matrix
from noack.proof.elaborate.hybrid_system import ContinuousFlow, Edge, Location, Model, UnknownSignal
from noack.proof.elaborate.loop import Loop
from noack.proof.no_document import NoDocumentError as NoDocumentError
from noack.proof.numbers import (
    Fractions,
    Number,
    as_written,
    entry,
    exact,
    least_above,
    matrix,
    product,
    quotient,
    squares_of,
    to_fraction,
    written,
)
from noack.proof.search.results import Assumptions, compares_error, last_test_before

FORMAT = "noack-hybrid 1"
Table = dict[str, Any]
_ALL = {
    "x": "all states",
    "e_s": "error of the sensor's model",
    "e_c": "error of the controller's model",
    "drift": "mismatch of the sensor's model",
}
"""Names of outputs with several rows."""
_EDGES = {
    "sent": "an event, whose update is on its way then",
    "delivered": "an event, whose update acts at once",
    "lost": "an event, whose update is lost",
    "event": "an event while an update is on its way",
    "silent": "a test without an event",
    "all lost": "the update that was on its way acts, and all that were sent after it are lost",
    "too early": "an event that is proven not to happen",
}
"""What the ends of names of edges mean."""
ETA, NEXT_ETA = "√η", "next √η"
"""The coordinate of a rule's dynamic variable η, and its value after a test."""
BOUND_OF_E, BOUND_OF_W = "bound of e", "bound of w"
"""What a proof has as bounds of rows."""
ERROR = "e_s"
DRIFT = "drift"
"""The output W(ẋ − Hx), as the search calls it."""


@dataclass(frozen=True)
class Naming:
    """How a document names a loop.

    Attributes:
        loop: the document's name.
        states: names of the states; those that are missing have numbers.
        outputs: names of the outputs.
        state_units: units of the states.
        output_units: units of the outputs. Those that are missing have none.
    """

    loop: str
    states: Sequence[str] = ()
    outputs: Sequence[str] = ()
    state_units: Sequence[str] = ()
    output_units: Sequence[str] = ()

    def state(self, index: int) -> str:
        """Return the name of a state."""
        return self.states[index] if index < len(self.states) else f"x{index}"

    def unit(self, name: str) -> str:
        """Return the unit of an output that the search calls "y[0]" or "x[0]"; others have none."""
        units = {"y": self.output_units, "x": self.state_units}.get(name[0], ()) if "[" in name else ()
        index = int(name[2:-1]) if units else 0
        return units[index] if index < len(units) else ""

    def output(self, name: str) -> str:
        """Return the name of an output that the search calls "y[0]"."""
        if name.startswith("y["):
            index = int(name[2:-1])
            return self.outputs[index] if index < len(self.outputs) else f"output {index}"
        if name.startswith("x["):
            return f"state {self.state(int(name[2:-1]))}"
        if name.startswith("u["):
            return f"input {name[2:-1]}"
        return _ALL.get(name, name)


class LoopDocument:
    """The document of a loop, and what a proof needs of it.

    Args:
        loop: the loop.
        rate: r in f1 = e^{−rt}, 1/s.
        assumed: what the model assumes; it becomes facts of the document.
        outputs: names of what is bounded, as the search has them.
        naming: of the loop.

    Raises:
        NoDocumentError: the document has no words for the loop.
    """

    def __init__(
        self, loop: Loop, rate: arb, assumed: Assumptions, outputs: Iterable[str], naming: Naming
    ) -> None:
        if loop.rule.memory is not None and loop.noise.ncols():
            raise NoDocumentError("a rule with a dynamic variable has no loop document with noise")
        if loop.rule.integrates:
            raise NoDocumentError("a rule that integrates has no loop document")
        self.loop, self.rate, self._assumed, self.naming = loop, rate, assumed, naming
        try:
            self.model = Model(loop, rate, arb(0), assumed.errors, assumed.noise, **assumed.of_model)
        except ValueError as error:  # it is too large
            raise NoDocumentError(str(error)) from None
        self._noise = {*self.model.sources, *self._next_memory}
        """Coordinates that have no motion."""
        used = {c for place in self.model.locations for c in place.coordinates} | self._noise
        self.used = sorted(used)
        self._select = columns_of(identity(self.model.size), self.used)
        self._units: dict[int, str] = {}
        self.labels = self._labels()
        self.rows: Table = {}
        self.facts: dict[str, Table] = {}
        self._named: dict[tuple[object, ...], str] = {}
        """Names of facts by the symmetric matrix that the model has for them."""
        self._name_facts()
        self.motions: dict[str, list[Table]] = {}
        self._motion_names: dict[int, str] = {}
        self.location_facts = [
            [*map(self.fact, place.silent), *map(self._assumption, place.facts)]
            for place in self.model.locations
        ]
        self.clocks = [self._clock(place, index) for index, place in enumerate(self.model.locations)]
        locations = [self._location(index) for index in range(len(self.model.locations))]
        self.edge_names = self._edge_names()
        edges = [self._edge(edge, name) for edge, name in self.edges]
        self.dead_edges = [*self._dead_edges()]
        self.output_names = self._output_names([*dict.fromkeys(outputs)])
        self.outputs = [self._output(name) for name in self.output_names]
        self.table: Table = {
            "format": FORMAT,
            "name": naming.loop,
            "about": self._about(),
            "coordinates": [self._coordinate(index) for index in self.used],
            "rows": self.rows,
            "facts": self.facts,
            "motions": self.motions,
            "locations": locations,
            "edges": [*edges, *self._silent_edges(), *self.dead_edges],
            "start": self._start(),
            "outputs": self.outputs,
            "readings": self._readings(),
        }
        if self.has("f1"):
            self.table["decaying"] = {"coordinate": "f1", "rate": exact(rate)}
        if self.has("f2"):
            self.table["constant"] = "f2"
        if loop.region is not None:
            self.table["while"] = [*self._limits()]

    # Coordinates.

    def _labels(self) -> dict[int, str]:
        """Return the name of each coordinate of the model; one that is taken has a number."""
        model, n = self.model, self.loop.n
        found = {model.size - 2: "f1", model.size - 1: "f2"}
        found |= dict.fromkeys(self._memory, ETA) | dict.fromkeys(self._next_memory, NEXT_ETA)
        for kind, rows in (("s", model.s), ("n", model.p)):
            found |= {
                c: f"{kind}{i}" for i in range(rows.nrows()) for c in range(model.size) if rows[i, c] != 0
            }
        parts = [("", model.x), ("e ", model.error_rows[0]), ("w ", model.error_rows[1])]
        parts += [(f"v{k} ", rows) for k, rows in enumerate(model.error_rows[2:], 1)]
        for prefix, rows in parts:
            for i in range(rows.nrows()):
                name = prefix + (self.naming.state(i) if rows.nrows() == n else f"entry {i}")
                for c in (c for c in range(model.size) if rows[i, c] != 0 and c not in found):
                    found[c] = _untaken(name, found.values())
                    if rows.nrows() == n:
                        self._units[c] = self.naming.unit(f"x[{i}]")
        return found

    def _coordinate(self, index: int) -> Table:
        entry = {"name": self.labels[index], "unit": self._units.get(index, "")}
        return entry | ({"noise": True} if index in self._noise else {})

    @property
    def _memory(self) -> range:
        """The coordinate of a dynamic variable, which is √η⁺, if the rule has one."""
        first = self.model.sources.stop
        return range(first, first + (self.model.memory is not None))

    @property
    def _next_memory(self) -> range:
        """The coordinate of its value after a test."""
        return range(self._memory.stop, self._memory.stop + len(self._memory))

    def has(self, unit: str) -> bool:
        """Return whether the document has a unit, "f1" or "f2"."""
        return any(self.labels[index] == unit for index in self.used)

    def _about(self) -> str:
        """Return what the names of coordinates and locations mean."""
        model, parts = self.model, []
        prefixes = {self.labels[c].split(" ")[0] for c in self.used}
        parts.append("e is x_s − x, the error of the sensor's model")
        parts.append("w is x_c − x_s with the x_c from which the input that acts now was computed")
        if "v1" in prefixes:
            parts.append("v1, v2, ... are what w will be when a later update acts, the newest one first")
        if model.s.nrows():
            parts.append(
                "s0, s1, ... are errors of the estimate that no noise causes; the rows of e are without them"
            )
        if model.sources:
            parts.append("n0, n1, ... are the noise of a measurement")
        if model.memory is not None:
            parts.append(f"{ETA} is the root of the rule's dynamic variable η, or 0 where η is below 0")
        parts.append('"j lost": j updates were sent since the one that acts, and all are lost')
        if any("later" in place.name for place in model.locations):
            parts.append('"k later": an update is on its way, and k were sent after it')
        names = {kind for edge in model.edges for kind in _EDGES if edge.name.endswith(f", {kind}")}
        names |= {"silent"} if self.silent_locations else set()
        names |= {"too early"} if self.dead_edges else set()
        parts += [f'"{kind}": {words}' for kind, words in _EDGES.items() if kind in names]
        return ". ".join(parts) + "."

    def columns(self, rows: arb_mat) -> list[list[Number | list[float]]]:
        """Return rows of the document's coordinates."""
        return matrix(rows * self._select)

    # Facts.

    def _name_facts(self) -> None:
        model, rule = self.model, self.loop.rule
        if rule.positive.nrows():
            self.rows["compared"] = self.columns(rule.positive * model.pair)
        if rule.negative.nrows():
            self.rows["share"] = self.columns(rule.negative * model.pair)
        for name, row in (("f1", model.f1), ("f2", model.f2)):
            if self.has(name):
                self.rows[name] = self.columns(row)
        for name, size, unit in (("level", model.level, "f1"), ("floor", model.floor, "f2")):
            if size > 0 and self.has(unit):
                self.rows[name] = self._multiple(unit, size)
        if self._memory:
            self.rows[ETA] = self.columns(model.y)
        sizes: list[str] = [name for name in ("share", ETA, "level", "floor") if name in self.rows]
        if "compared" in self.rows:
            words = "no event: the comparison is at most the threshold"
            self._add_fact("silent", ["compared"], [*sizes], words, model.silent)
        guards = model.exceeded()
        if "" in guards and rule.floor > 0:  # the least threshold, where "floor" is the largest
            least = [quotient(_lower(rule.floor)) if self.labels[c] == "f2" else 0 for c in self.used]
            self.rows["least threshold"] = [least]
            sizes.append("least threshold")
        for guard, Q in guards.items():
            unit = {"c1": "level", "c2": "floor", "": "least threshold"}[guard]
            kept = ["share", ETA, unit]
            name = {"c1": "event, level", "c2": "event, floor", "": "event"}[guard]
            words = "an event: the comparison is at least the threshold"
            self._add_fact(name, [size for size in kept if size in sizes], ["compared"], words, Q)
        if self._has_plain_terms:
            self._add_plain_rows()
        for k, (source, Q) in enumerate(zip(model.sources, model.noise_bounds, strict=True)):
            unit = "f1" if k < model.bounds.decaying else "f2"
            name = self.labels[source]
            self.rows[name] = [[int(c == source) for c in self.used]]
            self._add_fact(f"noise {name}", [name], [unit], "bound of the noise of a measurement", Q)
        for edge in model.edges:
            if edge.memory is not None and not is_zero(edge.memory):
                self._add_memory(edge.memory)

    def _add_memory(self, following: arb_mat) -> None:
        """Add the facts of a test at which η becomes a form of z: it is at least 0, or it is not."""
        if _key(-1 * following) in self._named:
            return
        number = 1 + len(self._named)
        self.rows[NEXT_ETA] = [[int(c in self._next_memory) for c in self.used]]
        for is_positive in (True, False):
            terms = squares_of(following, self.used, is_above=is_positive)
            names: dict[bool, list[str]] = {True: [], False: []}
            for index, (row, sign) in enumerate(terms):
                name = f"η {number}.{index}{'' if is_positive else ' below 0'}"
                self.rows[name] = [row]
                names[sign].append(name)
            if is_positive:
                words = "η after the test is at least 0"
                self._add_fact(f"η {number}", [NEXT_ETA, *names[False]], names[True], words, -1 * following)
            else:
                words = "η after the test is below 0"
                self._add_fact(f"η {number} below 0", names[True], names[False], words, following)

    @property
    def _has_plain_terms(self) -> bool:
        """Whether forms have terms of a comparison without its noise."""
        return bool(self.model.sources) and "compared" in self.rows

    def _add_plain_rows(self) -> None:
        for name in ("compared", "share"):
            if name in self.rows:
                noisy = {self.used.index(c) for c in self.model.sources}
                rows = [[0 if j in noisy else v for j, v in enumerate(row)] for row in self.rows[name]]
                self.rows[f"{name} without noise"] = rows

    def _assumption(self, Q: arb_mat) -> str:
        """Return the name of what the model assumes: a bound of rows, which the proof has."""
        is_of_e = _key(Q) == _key(self.model.at_most(self.model.e, arb(1))[0])
        return BOUND_OF_E if is_of_e else BOUND_OF_W

    def _multiple(self, unit: str, size: arb) -> list[list[Number]]:
        return [[least_above(size) if self.labels[c] == unit else 0 for c in self.used]]

    def _add_fact(self, name: str, less: list[str], more: list[str], words: str, Q: arb_mat) -> None:
        self.facts[name] = {"less": less, "more": more, "words": words}
        self._named.setdefault(_key(Q), name)

    def threshold_squared(self, fact: str) -> float:
        """Return c² of a fact that says that the comparison is at least a threshold c f1, or c f2."""
        names = [name for name in self.facts[fact]["less"] if name not in ("share", ETA)]
        return sum(float(Fraction(str(value))) ** 2 for name in names for value in self.rows[name][0])

    def noise_columns(self) -> tuple[list[str], Matrix]:
        """Return the names of noise coordinates, and WC of the noise Cp of a measurement, (n, names)."""
        model = self.model
        columns = self.loop.weight * columns_of(model.noise, [*model.sources])
        shape = columns.nrows(), columns.ncols()
        values = [float(value.mid()) for value in columns.entries()]
        return [self.labels[c] for c in model.sources], np.array(values).reshape(shape)

    def fact(self, Q: arb_mat) -> str:
        """Return the name of a fact of the model."""
        if (name := self._named.get(_key(Q))) is None:
            raise NoDocumentError("the model has a fact that the document has no words for")
        return name

    # Motions and locations.

    def _motion(self, flows: tuple[ContinuousFlow, ...]) -> str:
        if id(flows) not in self._motion_names:
            name = "driven" if any(not is_zero(flow.input) for flow in flows) else "without input"
            name = name if name not in self.motions else f"{name} {len(self.motions)}"
            self._motion_names[id(flows)] = name
            self.motions[name] = [self._corner(flow) for flow in flows]
        return self._motion_names[id(flows)]

    def _corner(self, flow: ContinuousFlow) -> Table:
        signals = [signal.plain for signal in self.model.signals(flow.input)]
        others = flow.unknowns[len(signals) :]
        return {
            "matrix": self._square(flow.matrix),
            "input": self.columns(flow.input),
            "unknown": [self._unknown(each) for each in (*signals, *others)],
        }

    def _square(self, M: arb_mat) -> list[list[Number | list[float]]]:
        return matrix(rows_of(M * self._select, self.used))

    def _unknown(self, unknown: UnknownSignal) -> Table:
        column = [[entry(unknown.column[c, 0])] for c in self.used]
        found: Table = {"column": column, "rows": self.columns(unknown.rows)}
        if unknown.along is not None:
            found |= {
                "along": self.columns(unknown.along.row),
                "least": quotient(_lower(unknown.along.least)),
            }
        return found

    def _location(self, index: int) -> Table:
        place, clock = self.model.locations[index], self.clocks[index]
        units = (self.model.size - 2, self.model.size - 1)
        found: Table = {
            "name": place.name,
            "coordinates": [self.labels[c] for c in place.coordinates if c not in units],
            "motion": self._motion(place.flows),
            "facts": [fact for fact in self.location_facts[index] if fact in self.facts],
        }
        return found if clock is None else found | {"clock": exact(clock)}

    def _clock(self, place: Location, index: int) -> fmpq | None:
        """Return the largest time since the last test, since an update was sent, or since the last event."""
        model, times = self.model, self.loop.times
        if model.is_by_tests:
            return model.clock_of_place(index)
        until = times.start if place.name.startswith("start") else times.delay
        if model.is_periodic:
            if place.is_tested:
                return times.period
            return min(until - _later(place.name) * times.least_period, times.period)
        if place.is_tested:
            return times.sampling if times.sampling > 0 else None
        return until

    # Edges.

    def _edge_names(self) -> list[str]:
        names: list[str] = []
        for edge in self.model.edges:
            target = self.model.locations[edge.target].name
            names.append(edge.name if edge.name not in names else f"{edge.name} to {target}")
        return names

    @property
    def edges(self) -> list[tuple[Edge, str]]:
        """Edges of the model that are possible, with their names."""
        pairs = zip(self.model.edges, self.edge_names, strict=True)
        return [(edge, name) for edge, name in pairs if self._when(edge)[0] <= self._when(edge)[1]]

    def _when(self, edge: Edge) -> tuple[fmpq, fmpq]:
        end, least = self.clocks[edge.source] or fmpq(0), fmpq(0)
        if self.model.is_by_tests and edge.is_test:
            return end, end
        if self.model.is_periodic and edge.is_test:
            least = self.loop.times.least_period
        return least, end

    def _clock_after(self, edge: Edge) -> str:
        if self.model.is_by_tests:
            return "zero" if edge.is_test else "keeps"
        waits = not self.model.locations[edge.source].is_tested
        if edge.is_test:
            return "keeps" if waits and not self.model.is_periodic else "zero"
        return "keeps" if self.model.is_periodic else "any"

    def facts_of(self, edge: Edge) -> list[str]:
        """Return the names of an edge's facts."""
        return [self.fact(Q) for Q in edge.facts]

    def _edge(self, edge: Edge, name: str) -> Table:
        source, target = self.model.locations[edge.source], self.model.locations[edge.target]
        found: Table = {"name": name, "from": source.name, "to": target.name}
        if self.clocks[edge.source] is not None:
            found["when"] = [exact(end) for end in self._when(edge)]
        jump = self._square(edge.jump)
        for row, c in enumerate(self.used):
            if c not in target.coordinates:  # also of noise, which does not follow from a jump
                jump[row] = [0] * len(self.used)
            elif c in self._memory and edge.memory is not None:
                jump[row] = [int(d in self._next_memory and not is_zero(edge.memory)) for d in self.used]
        if edge.is_test and ", silent" not in edge.name:
            found["event"] = True
        return found | {"clock": self._clock_after(edge), "facts": self.facts_of(edge), "jump": jump}

    def _dead_edges(self) -> Iterator[Table]:
        """Yield the events of locations in which they are proven not to happen: they lead nowhere.

        Such an event is no test's that comes as early as tests may come: the times of tests exclude others.
        """
        model, times = self.model, self.loop.times
        if model.is_by_tests or model.is_periodic or not compares_error(self.loop):
            return
        ends = {} if self._assumed.later else {"0 later": times.delay}
        if not self._assumed.later_at_start:
            ends["start, 0 later"] = times.start
        for place in model.locations:
            if place.name not in ends:
                continue
            last = last_test_before(times, ends[place.name])
            is_due = self.loop.rule.always and times.due <= last
            if last < times.least_apart or (last == 0 and times.sampling > 0) or is_due:
                continue
            yield {
                "name": f"{place.name}, too early",
                "from": place.name,
                "to": None,
                "when": [exact(times.least_apart), exact(last)],
                "clock": "zero",
                "facts": [*self._event_facts(), *(self.fact(Q) for Q in model.noise_bounds)],
                "event": True,
            }

    def require_counted(self) -> None:
        """Require that the document has all events that the times of tests allow, or excludes them.

        Raises:
            NoDocumentError: it has not, so a proof would not be about the loop.
        """
        times, dead = self.loop.times, {str(edge["from"]) for edge in self.dead_edges}
        counts = {
            "0 later": (self._assumed.later, times.delay),
            "start, 0 later": (self._assumed.later_at_start, times.start),
        }
        for name, (count, end) in counts.items():
            is_late = (count + 1) * times.least_apart < end
            has_test = last_test_before(times, end) > 0 or times.sampling == 0
            if is_late and has_test and name not in dead:
                raise NoDocumentError(f"more events than {count} may happen in {name!r}")

    def _event_facts(self) -> list[str]:
        """Return the facts of an event by the rule's comparison."""
        return [name for name in ("event, level", "event, floor", "event") if name in self.facts]

    def _silent_edges(self) -> Iterator[Table]:
        """Yield a test without an event for each location that has none: it sets the clock to 0."""
        for index in self.silent_locations:
            name = self.model.locations[index].name
            noise = [self.fact(Q) for Q in self.model.noise_bounds]
            yield {
                "name": f"{name}, silent",
                "from": name,
                "to": name,
                "when": [0, exact(self.clocks[index] or fmpq(0))],
                "clock": "zero",
                "facts": (["silent"] if "silent" in self.facts else []) + noise,
                "jump": [[int(c == d and c not in self._noise) for d in self.used] for c in self.used],
            }

    @property
    def silent_locations(self) -> list[int]:
        """Locations with tests whose silent ones the model need not show."""
        if self.model.is_by_tests or self.model.is_periodic or not self.loop.times.sampling > 0:
            return []
        present = {edge.source for edge in self.model.edges if edge.name.endswith(", silent")}
        tested = [i for i, place in enumerate(self.model.locations) if place.is_tested]
        return [index for index in tested if index not in present]

    def _start(self) -> Table:
        model = self.model
        columns = matrix(rows_of(model.start_columns, self.used))
        if self._memory:
            columns = [[*row, int(c in self._next_memory)] for c, row in zip(self.used, columns, strict=True)]
            first = least_above(model.first_memory()[0, 0].max(arb(0)).sqrt())
            columns[self.used.index(self._memory[0])] = [first, 0]
        facts = [self.fact(Q) for Q in model.noise_bounds]
        location = model.locations[model.start_location].name
        return {"location": location, "columns": columns, "facts": facts}

    # Outputs and limits.

    def _output_names(self, outputs: Sequence[str]) -> dict[str, str]:
        """Return the document's name of each output; a name that is taken has a number."""
        found: dict[str, str] = {}
        for name in outputs:
            found[name] = _untaken(self.naming.output(name), found.values())
        return found

    def _output(self, name: str) -> Table:
        model, places = self.model, [place.name for place in self.model.locations]
        label = self.output_names[name]
        found: Table = {"name": label, "unit": self.naming.unit(name), "in": places}
        if name.startswith("u["):
            return found | {"input": int(name[2:-1])}
        if name == DRIFT:
            where = [place for place in places if not place.startswith("start")]
            rows = product(self.error_matrix, self.error_rows)
            velocity = [[-entry for entry in row] for row in self.error_rows]
            return found | {"in": where, "rows": written(rows), "velocity": written(velocity)}
        return found | {"rows": self.columns(model.output(name, model.locations[0])[0][0])}

    @cached_property
    def error_matrix(self) -> Fractions:
        """M = WHW⁻¹ to within rounding: d(We)/dt = M We − W(ẋ − Hx), without errors of an observer."""
        loop = self.loop
        M = loop.H if loop.weight == identity(loop.n) else loop.weight * loop.H * loop.weight.inv()
        return [[as_written(float(M[i, j].mid())) for j in range(loop.n)] for i in range(loop.n)]

    @cached_property
    def error_rows(self) -> Fractions:
        """The rows We, as decimals of the document."""
        rows = self.loop.weight * self.model.error_rows[0] * self._select
        return [
            [as_written(float(rows[i, j].mid())) for j in range(rows.ncols())] for i in range(rows.nrows())
        ]

    def _readings(self) -> Table:
        """Return what a record shows of z: x, and x_s and x_c where z has all of their entries."""
        model, places = self.model, self.model.locations
        every = [place.name for place in places]
        found = {"x": [{"rows": self.columns(model.x), "in": every}]}
        if not model.sees_all:
            return found
        # Where updates of a periodic rule are lost, e is x_c − x.
        sensed = [name for name in every if not (model.is_periodic and name.endswith("lost"))]
        driven = [name for name in every if not name.startswith("start")]
        for reading, rows, where in (
            ("x_s", model.x + model.e, sensed),
            ("x_c", model.x + model.e + model.w, driven),
        ):
            if where:
                found[reading] = [{"rows": self.columns(rows), "in": where}]
        return found

    def add_output(self, name: str) -> None:
        """Add an output, as the search calls it, to the document."""
        self.output_names[name] = _untaken(self.naming.output(name), self.output_names.values())
        self.outputs.append(self._output(name))

    def _limits(self) -> Iterator[Table]:
        """Yield the limits of a region; each is one of an output that is bounded."""
        region, names = self.loop.region, self.output_names
        assert region is not None
        for kind, limits in zip("xu", region, strict=True):
            for index, limit in enumerate(limits):
                if limit is None:
                    continue
                name = f"{kind}[{index}]"
                if name not in names:
                    raise NoDocumentError(f"the limit of {self.naming.output(name)} has no bound by forms")
                yield {"output": names[name], "less": quotient(_lower(limit))}


def _untaken(name: str, taken: Iterable[str]) -> str:
    """Return the name, with a number if it is taken."""
    names = {*taken}
    more = (f"{name} ({k})" for k in itertools.count(2))
    return name if name not in names else next(each for each in more if each not in names)


def _later(name: str) -> int:
    """Return k of a location "k later" or "start, k later"."""
    return int(name.removeprefix("start, ").split(" ")[0])


def _key(Q: arb_mat) -> tuple[object, ...]:
    """Return what is equal for matrices that are the same, balls included."""
    return tuple((v.mid().man_exp(), v.rad().man_exp()) for v in Q.entries())


def _lower(value: arb) -> Fraction:
    return to_fraction(value.lower())
