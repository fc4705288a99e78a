"""Whether a run is a run of its loop document, as data: the words of it are in ``cosim/output``."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple


class EdgeKind(StrEnum):
    """What happens at an edge of a document."""

    EVENT = "event"
    SILENT = "silent"
    ARRIVAL = "arrival"


class Place(NamedTuple):
    """What the name of a location says."""

    starts: bool
    """No input acts yet."""
    waits: bool
    """An update is on its way that will act."""
    number: int
    """So many updates were sent after it; or so many are lost, if none is on its way."""


class Transition(NamedTuple):
    """A change of location: from where, by what, and to what kind of place."""

    source: str
    kind: EdgeKind
    target: Place


class Unknown(NamedTuple):
    """What happened, for which a document has no edge."""

    transition: Transition
    most: int
    """The largest number of the places of this kind that the document has."""


class Failed(StrEnum):
    """What of a trace is not as its document says."""

    PATH = "path"
    """Items do not follow each other, or steps of the record are missing."""
    EDGE = "edge"
    """The document has no such transition, or does not say what follows it."""
    WHEN = "when"
    """An edge is taken outside of its interval of the clock."""
    CLOCK = "clock"
    """The clock is another one."""
    LIMIT = "limit"
    """A location lasts longer than its clock may show."""
    FACT = "fact"
    """A fact does not hold."""
    JUMP = "jump"
    """z is another one at the start, or after an edge."""
    ZERO = "zero"
    """A coordinate that a location lacks is not 0."""
    MOTION = "motion"
    """No motion of the document leads from one step to the next."""
    INPUT = "input"
    """The input is none that the document allows."""
    READING = "reading"
    """What was recorded is not what z shows."""


@dataclass(frozen=True)
class Failure:
    """What of a run is first not as its document says."""

    t_s: float
    kind: Failed
    place: str = ""
    """The location or the edge."""
    detail: str = ""
    """The name of a fact, of a reading or of a motion."""
    found: float | None = None
    """What the clock showed, in s."""
    low: float | None = None
    high: float | None = None
    """What it may show, in s."""
    unknown: Unknown | None = None
    """What happened, for which the document has no edge."""
    at: Place | None = None
    """What the name of the location says, or that of the edge's source."""
    input_age_s: float | None = None
    """The age of the input at this time."""


class Conformance(NamedTuple):
    """Whether a run is one of a document."""

    document: str
    """Name of the document."""
    until_s: float
    """Up to this time."""
    failure: Failure | None
    """What failed then; None: the whole run is one of the document."""
    edges: Mapping[str, int]
    """How often each edge of the document was taken."""
    clocks: Mapping[str, float]
    """By location, the largest share of its clock's limit that was reached."""
    share: float = 1.0
    """Of the path's items, so many were compared in all numbers; edges, clocks and times always are."""

    @property
    def conforms(self) -> bool:
        """Whether the whole run is a run of the document."""
        return self.failure is None
