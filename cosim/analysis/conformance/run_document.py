"""A loop document as runs are compared with it: its table, and what a trace needs to name what a run did."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from flint import fmpq

from cosim.analysis.conformance.document_numbers import DocumentNumbers
from cosim.analysis.conformance.verdicts import EdgeKind, Place, Transition
from cosim.analysis.witnesses import WitnessedStatement
from netem.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix
from noack.proof.elaborate.hybrid_system import Edge
from noack.proof.elaborate.loop import Loop
from noack.proof.elaborate.noise import noise_of
from noack.proof.elaborate.tables import read_number
from noack.proof.files import document_of
from noack.proof.loop_document import LoopDocument, Naming, NoDocumentError
from noack.proof.search.results import Assumptions
from noack.theory.witnesses.coordinates import floats

_MOST_LATER, _FEW_LATER = 12, 2
"""Most events while an update is on its way in a document without a proof; with tests at exact times."""


class Target(NamedTuple):
    """An edge, and the location to which it leads."""

    edge: str
    location: str


@dataclass(frozen=True)
class RunDocument:
    """A loop document with what its coordinates and names mean, as numbers."""

    table: Mapping[str, Any]
    places: Mapping[str, Place]
    """By the name of a location."""
    targets: Mapping[Transition, Target]
    H: Matrix
    """Of both models, (n, n)."""
    seen: Matrix
    """The rows of errors that the document has, (q, n)."""
    states: Matrix
    """z = x ``states`` + ..., (n, coordinates)."""
    errors: tuple[Matrix, ...]
    """The same of e, w, v1, v2, ..., (q, coordinates) each."""
    decaying: Matrix
    """The same of s, (k, coordinates)."""
    noise: tuple[int, ...]
    """The coordinates of noise."""
    noise_columns: Matrix
    """What each noise coordinate adds to a measurement, (n, noise)."""
    decaying_noise: int
    """So many of them, the first ones, are at most f1."""
    smooth: tuple[Matrix, Matrix, Matrix]
    """Of the part of an estimate's error that no noise causes: its effect on x̂, (n, k), rates and start."""
    rate_per_s: float
    delay_ns: float
    """An update acts within this time, if at all."""
    test_ns: float
    """The rule is tested at least this often; 0: at all times, or it compares nothing."""
    dwell_ns: float
    """The first test after an event comes this time after it; 0: as after other tests."""
    is_periodic: bool
    is_by_tests: bool
    """A location says how many tests ago the updates on their way were sent."""

    @cached_property
    def numbers(self) -> DocumentNumbers:
        """The document as numbers: runs of equal loops share them."""
        return DocumentNumbers(self.table)


def document_of_statement(statement: WitnessedStatement, naming: Naming) -> RunDocument:
    """Return the loop document of a statement; of one by gains, a document of the loop without a proof.

    Raises:
        NoDocumentError: no document describes the loop; the message says why.
    """
    loop, found = statement.loop, statement.document
    if loop is None or found is None:
        raise NoDocumentError(statement.reason)
    if loop.rule.memory is not None:
        raise NoDocumentError("the variable of a dynamic rule is not recorded, so no run is compared")
    if found.get("bounds"):
        return run_document(document_of(loop, found, naming))
    rate = read_number(found, "rate")
    later, at_start = (_most_later(loop, time) for time in (loop.times.delay, loop.times.start))
    if loop.needs_tests_apart:
        later = at_start = min(later, _FEW_LATER)
    noise = noise_of(loop, rate)
    by_tests = loop.needs_tests_apart
    assumed = Assumptions(None, later, at_start, noise=noise, by_tests=by_tests)
    try:
        return run_document(LoopDocument(loop, rate, assumed, (), naming))
    except ValueError as error:  # it would have too many locations
        raise NoDocumentError(str(error)) from None


def _most_later(loop: Loop, within: fmpq) -> int:
    """Return how many updates may be sent while one is on its way for a time, up to a limit."""
    if not loop.times.least_apart > 0:
        return _MOST_LATER
    return min(int((within / loop.times.least_apart).floor()), _MOST_LATER)


def run_document(document: LoopDocument) -> RunDocument:
    """Return a loop document as runs are compared with it."""
    model, loop = document.model, document.loop
    used, locations = document.used, model.locations
    places = {location.name: _place(location.name) for location in locations}
    targets: dict[Transition, Target] = {}
    for edge, name in document.edges:
        source, target = locations[edge.source].name, locations[edge.target].name
        targets[Transition(source, _kind(edge, source, target), places[target])] = Target(name, target)
    for index in document.silent_locations:
        name = locations[index].name
        targets[Transition(name, EdgeKind.SILENT, places[name])] = Target(f"{name}, silent", name)
    smooth = model.bounds.smooth
    return RunDocument(
        table=document.table,
        places=places,
        targets=targets,
        H=floats(loop.H),
        seen=np.eye(loop.n) if model.sees_all or loop.seen is None else floats(loop.seen),
        states=floats(model.x)[:, used],
        errors=tuple(floats(rows)[:, used] for rows in model.error_rows),
        decaying=floats(model.s)[:, used],
        noise=tuple(used.index(c) for c in model.sources),
        noise_columns=floats(model.bounds.columns),
        decaying_noise=model.bounds.decaying,
        smooth=(floats(smooth.columns), floats(smooth.rates), floats(smooth.start)),
        rate_per_s=float(document.rate),
        delay_ns=_ns(loop.times.delay),
        test_ns=_ns(loop.times.sampling),
        dwell_ns=_ns(loop.times.dwell),
        is_periodic=model.is_periodic,
        is_by_tests=model.is_by_tests,
    )


def _ns(time_s: fmpq) -> float:
    return float(time_s.p) / float(time_s.q) * NS_PER_S


def _place(name: str) -> Place:
    """Return what the name of a location says, as "2 lost" or "start, 1 later, 3 2 tests ago"."""
    rest = name.removeprefix("start, ")
    count, kind = rest.split(",")[0].split(" ")
    return Place(rest != name, kind == "later", int(count))


def _kind(edge: Edge, source: str, target: str) -> EdgeKind:
    """Return the kind of an edge of the model, whose name says it."""
    if not edge.is_test:
        return EdgeKind.ARRIVAL
    named = edge.name.removeprefix(f"{source}, ").removesuffix(f", {target}")
    return EdgeKind.SILENT if named == "silent" else EdgeKind.EVENT
