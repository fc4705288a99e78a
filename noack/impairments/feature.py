"""What a feature of a link has to say: settings, behaviour, words, description, prediction.

A feature is a loss model, a kind of impairment, or a discipline of a queue: one class, in a file of
its own, derived from one of the three classes at the end.
"""

import importlib
import pkgutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self, TypeVar

from noack.impairments.link_records import QueueState, RuleStage
from noack.impairments.markov_chain import Chain, Pattern
from noack.impairments.word_reader import WordReader
from noack.settings.section import ScenarioSection

Table = dict[str, Any]
"""A table of settings, before it is validated."""


class Word(NamedTuple):
    """A word of the command line."""

    name: str
    example: str
    read: Callable[[WordReader], Table] | None = None
    """Reads what follows it; None: it stands within the words of its feature."""
    after: str = ""
    """Behind what it stands, if it stands within."""


class Behaviour(NamedTuple):
    """What a feature does to packets."""

    stage: type[RuleStage]
    """Its settings as numbers."""
    apply: Callable[..., None]
    """``apply(program, state, stage, memory, flow, decision)`` changes the decision for a packet.
    It is called for every packet of a flow, lost or not, so that what a stage draws depends on no
    other stage. ``memory`` is the stage's, of the packet's flow."""
    queue: type[QueueState] = QueueState
    """What it remembers of all flows together."""


class StageTables:
    """Tables of numbers that the stages of a program read.

    Args:
        scored: a delay is correlated with loss, and so wants to know how bad the link's state is.
    """

    def __init__(self, *, scored: bool = False) -> None:
        self.scored = scored
        self.integers: list[int] = []
        self.reals: list[float] = []

    def add_integers(self, numbers: Iterable[int]) -> tuple[int, int]:
        """Add whole numbers; return where they begin and end."""
        begin = len(self.integers)
        self.integers.extend(map(int, numbers))
        return begin, len(self.integers)

    def add_reals(self, numbers: Iterable[float]) -> tuple[int, int]:
        """Add numbers; return where they begin and end."""
        begin = len(self.reals)
        self.reals.extend(numbers)
        return begin, len(self.reals)


class Feature(ScenarioSection):
    """What all features have in common."""

    words: ClassVar[Sequence[Word]] = ()
    behaviour: ClassVar[Behaviour | None] = None
    """None: it does nothing by itself."""

    @classmethod
    def examples(cls) -> Sequence[Self]:
        """Settings for tests, harsh ones above all; together they use every key."""
        raise NotImplementedError

    def text(self) -> str:
        """Return words that are read back to the same settings."""
        raise NotImplementedError

    def meaning(self) -> str:
        """Say what it does, in plain words."""
        raise NotImplementedError

    def stage(self, tables: StageTables) -> RuleStage | None:
        """Return its settings as numbers; None if it never does anything.

        Raises:
            ValueError: it names a file that has not been read.
        """
        raise NotImplementedError

    def chains(self) -> Sequence[Chain | Pattern]:
        """Return what it does to packets as Markov chains, to predict the loss rate.

        Raises:
            NotPredictableError: the loss rate cannot be predicted.
        """
        return ()

    @property
    def prediction_note(self) -> str:
        """Under which condition the prediction holds."""
        return ""

    def without_files(self, folder: Path, place: str) -> "Feature":
        """Return settings that name no file: what the files say stands in them.

        Args:
            folder: where relative names begin.
            place: where the settings stand, for messages; empty: only the file is named.

        Raises:
            CallerError: a file cannot be read, or does not contain what it should.
        """
        return self

    def tc_text(self) -> str:
        """Return the words of ``tc netem`` for it; empty if it does nothing."""
        return self.text()

    def tc_lacks(self, before: Sequence["Impairment"]) -> str:
        """Return what ``tc netem`` lacks for it; empty if it lacks nothing.

        Args:
            before: the impairments that tc does before it.
        """
        return ""

    def tc_notes(self) -> Sequence[str]:
        """Return what ``tc netem`` does differently."""
        return ()


class LossModel(Feature):
    """Base class of loss models; their words follow ``loss``."""

    model: str
    gives_score: ClassVar[bool] = False
    """Whether a delay after it can be correlated with its losses."""


class QueueDiscipline(Feature):
    """Base class of disciplines of the ``rate`` bottleneck; their words end those of ``rate``."""

    kind: str

    def queue_stage(self, bottleneck: Mapping[str, int]) -> RuleStage:
        """Return the settings as numbers.

        Args:
            bottleneck: the fields of :class:`noack.impairments.bottleneck.BottleneckStage`.
        """
        raise NotImplementedError


class Impairment(Feature):
    """Base class of impairments; their words begin with one of their own."""

    kind: str
    flips_bits: ClassVar[bool] = False
    """Whether it changes payloads."""
    delays: ClassVar[bool] = False
    """Whether it may delay packets."""

    @property
    def rule(self) -> Behaviour | None:
        """What it does to packets."""
        return type(self).behaviour

    @property
    def longest_s(self) -> float:
        """Upper end of the delay, in seconds; of an unbounded one at four times the jitter."""
        return 0.0

    @property
    def is_bounded(self) -> bool:
        """Whether it never delays a packet for longer."""
        return True

    def reorders(self, delayed: bool, reordered: bool) -> tuple[bool, bool]:
        """Return whether packets may be delayed, and reordered, after it.

        Args:
            delayed: whether they may be delayed before it.
            reordered: whether they may be reordered before it.
        """
        return delayed, reordered


F = TypeVar("F", bound=Feature)


def features_in(package: str, path: Iterable[str], base: type[F]) -> tuple[type[F], ...]:
    """Return the features that the modules of a package define, by the modules' names."""
    found: list[type[F]] = []
    for name in sorted(module.name for module in pkgutil.iter_modules(path)):
        module = importlib.import_module(f"{package}.{name}")
        found += [
            one for one in vars(module).values()
            if isinstance(one, type) and issubclass(one, base) and one.__module__ == module.__name__
        ]  # fmt: skip
    return tuple(found)
