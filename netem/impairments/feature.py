"""Base classes of a link's features: settings, behaviour, words, description, prediction.

A feature is a loss model, a kind of impairment, a queue discipline, or a constraint on losses: one
class in its own file, derived from one of the classes here. Below them is what several features
share: random events with a correlation (:class:`CorrelatedChance`).

A correlated event: the latent variable z_i = ρ z_{i−1} + √(1 − ρ²) g_i is a stationary Gaussian
process. The event happens to packet i if z_i exceeds the normal quantile of 1 − p, hence with
probability p exactly, for every ρ.
"""

import math
from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, ClassVar, NamedTuple, TypeVar

from pydantic import Field

from netem.core.core_library import core
from netem.core.named_file import NamedFile
from netem.core.settings_section import Correlation, Probability, ScenarioSection
from netem.guarantee.loss_guarantee import LossRule
from netem.impairments.clauses import Clause, Part
from netem.impairments.markov_chain import Chain, PeriodicLosses, chance_chain
from netem.impairments.words import CORRELATION, PERCENT, brief_percent

T = TypeVar("T")
MOST_FLOWS = 65_535
"""Maximum number of flows that settings name one by one."""
LONGEST_NS = 10**18
"""Longest trace: 31 years."""
_MOST_SHOWN = 12
"""Numbers of a list that words show."""
TC_CORRELATION = "its correlation changes the probability, or the spread, of what it is given"
"""The difference to ``tc netem``."""


class Stage(NamedTuple):
    """A feature's settings as numbers, with which the core acts on packets (native/network/public.h)."""

    kind: str
    """Its behaviour: the name of a file in native/impairments."""
    numbers: Mapping[str, float]
    """The fields of its structure."""
    structure: str = ""
    """The field of ``noack_stage`` that has this structure; empty: it is ``kind``."""
    queue_places: int = 0
    """Maximum number of packets in its queue; 0: no queue."""
    schedules: bool = False
    """Its queue chooses when the link is free (native/network/waiting.c)."""


class StageTables:
    """Tables of numbers that the stages of a program read."""

    def __init__(self, *, scored: bool = False) -> None:
        self.scored = scored
        """A delay is correlated with loss, and needs a score of the link's state."""
        self.key = 0, 0
        """Key of the random stream of the stage that is being made."""
        self.integers: list[int] = []
        self.reals: list[float] = []


def add_numbers(table: list[T], numbers: Iterable[T]) -> tuple[int, int]:
    """Append numbers to a table; return the range [begin, end) of their places."""
    begin = len(table)
    table.extend(numbers)
    return begin, len(table)


class Feature(ScenarioSection):
    """Base class of all features."""

    clauses: ClassVar[tuple[Clause, ...]] = ()
    """Its words; of several clauses, the first that can have the settings is written."""
    tc_missing: ClassVar[str] = ""
    """The feature that ``tc netem`` would need for it; empty if it has it."""

    def text(self) -> str:
        """Return words that are read as the same settings."""
        clauses = [clause for clause in self.clauses if clause.writes(self)] or self.clauses
        return clauses[0].text(self) if clauses else ""

    @abstractmethod
    def meaning(self) -> str:
        """Return the effect in plain words."""

    @property
    def prediction_note(self) -> str:
        """The condition under which the prediction of the loss rate holds."""
        return ""

    def tc_lacks(self, earlier: Sequence["Impairment"]) -> str:
        """Return the missing feature of tc, which applies the impairments ``earlier`` before it."""
        return self.tc_missing


def numbers_text(numbers: Sequence[object]) -> str:
    """Return the first numbers of flows in words."""
    ending = ",..." if len(numbers) > _MOST_SHOWN else ""
    return f"{','.join(map(str, numbers[:_MOST_SHOWN]))}{ending}"


class QueueDiscipline(Feature):
    """Base class of queue disciplines of ``rate``; their words follow those of ``rate``."""

    kind: str

    @abstractmethod
    def queue_stage(self, bottleneck: Mapping[str, int], queue_places: int, tables: StageTables) -> Stage:
        """Return the settings as numbers, with those of the bottleneck."""


class Scheduler(QueueDiscipline):
    """Base class of disciplines that choose, when the link is free, what it sends next.

    Each flow has a number; the last number is that of all further flows, too.
    """

    @property
    @abstractmethod
    def numbers(self) -> Sequence[int]:
        """The number of each flow, from which the key of its packets follows."""

    def queue_stage(self, bottleneck: Mapping[str, int], queue_places: int, tables: StageTables) -> Stage:
        begin, _ = add_numbers(tables.integers, self.numbers)
        numbers = {**bottleneck, "begin": begin, "flows": len(self.numbers)}
        return Stage(self.kind, numbers, "bottleneck", queue_places, schedules=True)


class StageFeature(Feature):
    """Base class of the features that are a stage of a link."""

    @abstractmethod
    def stage(self, tables: StageTables) -> Stage | None:
        """Return its settings as numbers; None if they never have an effect.

        Raises:
            ValueError: it names a file that has not been read.
        """

    def chains(self) -> Sequence[Chain | PeriodicLosses]:
        """Return its effect on packets as Markov chains, to predict the loss rate.

        Raises:
            NotPredictableError: the loss rate cannot be predicted.
        """
        return ()

    def without_files(self, folder: Path, place: str) -> Feature:
        """Return settings with the files' contents instead of their names.

        Args:
            folder: folder to which relative names refer.
            place: position of the settings, for messages; empty: messages name only the file.

        Raises:
            CallerError: a file cannot be read, or has wrong content.
        """
        return self

    def tc_text(self) -> str:
        """Return the words of ``tc netem`` for it; empty if it has no effect."""
        return self.text()

    def tc_qdisc(self) -> str:
        """Return the words of another qdisc of tc that has the effect; empty: ``tc netem`` has it."""
        return ""

    def tc_notes(self) -> Sequence[str]:
        """Return the differences of tc in behaviour."""
        return ()


class FileFeature(StageFeature):
    """Base class of features that name a file, or have its content."""

    file: Annotated[str, Field(min_length=1)] | None = None

    @abstractmethod
    def read_file(self, file: NamedFile) -> Feature:
        """Return settings with the file's content.

        Raises:
            CallerError: as :meth:`StageFeature.without_files`.
        """

    def without_files(self, folder: Path, place: str) -> Feature:
        return self if self.file is None else self.read_file(NamedFile(self.file, folder, place))

    def require_content(self, error: type[Exception] = ValueError) -> None:
        """Raise an error of this class if the file has not been read."""
        if self.file is not None:
            raise error(f"{self.file} has not been read")


class Constraint(Feature):
    """Base class of constraints on the losses of a flow; each has its own first word."""

    kind: str

    @property
    @abstractmethod
    def rule(self) -> LossRule:
        """Return the constraint as a counter over the outcomes of packets."""

    @property
    @abstractmethod
    def scope(self) -> str:
        """Return what two constraints of a link must not have in common."""


class LossModel(StageFeature):
    """Base class of loss models; their words follow ``loss``."""

    model: str
    gives_score: ClassVar[bool] = False
    """Whether a delay after it can be correlated with its losses."""


class PacketOrder(NamedTuple):
    """What may have happened to packets: whether some were delayed, and whether some leave out of order."""

    delayed: bool = False
    reordered: bool = False


class Impairment(StageFeature):
    """Base class of impairments; each has its own first word."""

    kind: str
    flips_bits: ClassVar[bool] = False
    """Whether it changes payloads."""
    delays: ClassVar[bool] = False
    """Whether it may delay packets."""
    queues: ClassVar[bool] = False
    """Whether packets wait in a queue, for a time that depends on what else is sent."""

    @property
    def longest_s(self) -> float:
        """Maximum delay in seconds; for an unbounded delay, its value at four times the jitter."""
        return 0.0

    @property
    def is_bounded(self) -> bool:
        """Whether no packet is delayed for longer than :attr:`longest_s`."""
        return True

    def order_after(self, before: PacketOrder) -> PacketOrder:
        """Return the order of the packets after it, given that before it."""
        return before


CHANCE = (Part("probability", PERCENT, "P"), Part("correlation", CORRELATION, "CORR"))
"""The words of a probability and its correlation."""


class CorrelatedChance(StageFeature):
    """Settings of a feature that draws a correlated random event for each packet."""

    probability: Probability
    """Probability of the event."""
    correlation: Correlation = 0.0
    """Between successive packets."""

    behaviour: ClassVar[str]
    """See :class:`netem.impairments.feature.Stage`."""
    action: ClassVar[str] = ""
    """Its action as a Markov chain; see :class:`Chain`; empty: it does not change the loss rate."""

    @property
    def correlation_meaning(self) -> str:
        """The explanation of the correlation."""
        return f", correlation {brief_percent(self.correlation)}" if self.correlation else ""

    def stage(self, tables: StageTables) -> Stage:
        p = self.probability
        certain = math.copysign(math.inf, 0.5 - p)
        numbers = {
            "probability": p,
            "threshold": -core.noack_normal_score(p) if 0 < p < 1 else certain,
            "correlation": self.correlation,
            "innovation": math.sqrt(1 - self.correlation**2),
            "gap": 1,
            "scored": int(tables.scored),
        }
        return Stage(self.behaviour, numbers, "chance")

    def chains(self) -> Sequence[Chain]:
        if not self.action:
            return ()
        return (chance_chain(self.probability, self.correlation, self.action),)

    def tc_notes(self) -> Sequence[str]:
        return (TC_CORRELATION,) if self.correlation else ()
