"""Converts words to settings and back: the words of ``tc netem``, and additional ones.

    delay 10ms 2ms distribution normal loss gemodel 1% 10% mansd 4
    like dsl mansd 4

``like NAME`` stands for the words of a preset (:mod:`netem.presets`).

The order of the words is the order of the impairments; the position of ``mansd``, ``atmost``,
``recover``, ``first``, ``limit`` and ``seed`` does not matter. Words cannot be abbreviated.
"""

import json
import shlex
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, TypeVar

from pydantic import TypeAdapter, ValidationError

from netem.core.errors import CallerError, plain_mistake
from netem.core.settings_section import Seed, Table
from netem.impairments.constraints import CONSTRAINTS, AnyConstraint
from netem.impairments.feature import Constraint, Feature, Impairment
from netem.impairments.kinds import IMPAIRMENTS, AnyImpairment
from netem.impairments.kinds.reorder import Reorder
from netem.impairments.link_settings import LinkSettings
from netem.impairments.words import COUNT, WordReader
from netem.presets.preset import Direction, find_preset

T = TypeVar("T")
_REFUSED = {
    "slot": "this emulator does not gather packets into slots; it has rate and blackout",
    "jitter": "is no word; the jitter is the second time of delay, e.g. delay 10ms 2ms",
    "ecn": "this emulator cannot mark packets: it sees payloads, not IP headers",
}
_KINDS: Sequence[type[Feature]] = (*IMPAIRMENTS, *CONSTRAINTS)
_CLAUSES = {
    name: (kind, clause)
    for kind in _KINDS
    for clause in kind.clauses
    for name in (clause.word, *clause.synonyms)
}
_SETTINGS = {"mansd": "mansd", "first": "first_delivered", "limit": "limit"}
_LIKE, _PRESET_NAME = "like", "the name of a preset, or its file NAME.toml"
KEYWORDS = (*_CLAUSES, *_SETTINGS, "seed", _LIKE)
"""Words that begin a clause."""
_WORDS = [word for kind in _KINDS for clause in kind.clauses for word in clause.list_words()]
_AFTER = {
    word.name: ", or after ".join(same_word.preceding for same_word in _WORDS if same_word.name == word.name)
    for word in _WORDS
    if word.name not in _CLAUSES
}
"""For each word that begins no clause: the words after which it is allowed."""
EXAMPLES: Mapping[str, str] = {
    **{word.name: word.example for word in _WORDS},
    "mansd": "mansd 4",
    "first": "first",
    "limit": "limit 1000",
    _LIKE: "like dsl",
}
"""By word; ``seed`` is missing because it is also an option."""
GRAMMAR = [
    word.grammar
    for kind in IMPAIRMENTS
    for clause in kind.clauses
    for word in clause.list_words()
    if word.grammar
]
"""The words of each impairment, for ``--help``."""
_IMPAIRMENT, _CONSTRAINT = TypeAdapter(AnyImpairment), TypeAdapter(AnyConstraint)
_LINK, _SEED = TypeAdapter(LinkSettings), TypeAdapter[int](Seed)
_LIMIT = LinkSettings.model_fields["limit"].default


class LinkWords(NamedTuple):
    """Settings in words."""

    settings: LinkSettings
    seed: int | None
    """Seed of the random streams, if the words contain one."""
    presets: tuple[str, ...] = ()
    """The presets that the words name."""


def parse(
    words: str | Sequence[str],
    expected: Collection[str] = KEYWORDS,
    *,
    direction: Direction = "forward",
    folder: Path = Path(),
) -> LinkWords:
    """Read the settings of one direction of a link; see :class:`WordReader`.

    Args:
        words: the words.
        expected: the words that are named in place of an unknown one.
        direction: a preset stands for its words of this direction.
        folder: the file of a preset is relative to it.

    Raises:
        CallerError: one line with the wrong word, the expected words, and the nearest known word.
    """
    reader = WordReader(words)
    presets: list[str] = []
    impairments: list[Impairment] = []
    constraints: list[Constraint] = []
    settings: dict[str, int] = {}
    while (word := reader.begin()) is not None:
        if word in _REFUSED:
            reader.wrong(_REFUSED[word])
        if word in _AFTER:
            reader.wrong(f"goes right after {_AFTER[word]}")
        if word not in KEYWORDS:
            reader.unknown(word, expected)
        if word == _LIKE:
            presets.append(reader.file(_PRESET_NAME))
            reader.insert(_preset_words(reader, presets[-1], direction, folder))
            continue
        if word in _CLAUSES:
            kind, clause = _CLAUSES[word]
            table = {"kind": kind.model_fields["kind"].default, **clause.read(reader)}
            if issubclass(kind, Constraint):
                constraints.append(_validate(_CONSTRAINT, table, reader))
                continue
            impairment = _validate(_IMPAIRMENT, table, reader)
            _check_place(reader, impairment, impairments, bare_gap=word == "gap")
            impairments.append(impairment)
            continue
        if word in settings:
            reader.wrong("given twice")
        settings[word] = True if word == "first" else reader.value(COUNT)
        if word == "seed":
            _validate(_SEED, settings[word], reader)
        else:
            _validate(_LINK, {_SETTINGS[word]: settings[word]}, reader)
    seed = settings.pop("seed", None)
    content: Table = {_SETTINGS[word]: value for word, value in settings.items()}
    content |= {"impairments": tuple(impairments), "constraints": tuple(constraints)}
    try:
        return LinkWords(LinkSettings.model_validate(content), seed, tuple(presets))
    except ValidationError as error:
        # Each setting is valid by itself; the error is a combination of settings.
        key, _, message = _message(error).partition(": ")
        word = "lossrel: " if key.endswith("loss_correlation") else ""
        raise CallerError(f"{word}{message}") from None


def settings_of(
    words: str | Sequence[str],
    expected: Collection[str] = KEYWORDS,
    *,
    direction: Direction = "forward",
    folder: Path = Path(),
) -> LinkSettings:
    """Read the settings of one direction of a link from words without a seed.

    Raises:
        CallerError: as :func:`parse`, or the words contain a seed.
    """
    settings, seed, _ = parse(words, expected, direction=direction, folder=folder)
    if seed is not None:
        raise CallerError(f"seed {seed}: belongs to the link, not to one of its directions")
    return settings


def preset_names(words: str | Sequence[str]) -> tuple[str, ...]:
    """Return the names of the presets in words, up to a word that is wrong."""
    reader, names = WordReader(words), list[str]()
    with suppress(CallerError):
        while (word := reader.begin()) is not None:
            if word == _LIKE:
                names.append(reader.file(_PRESET_NAME))
    return tuple(names)


def reverse_words(presets: Sequence[str]) -> str:
    """Return the words of the reverse direction, where none are given, of a link with presets."""
    return " ".join(f"{_LIKE} {shlex.quote(name)}" for name in presets)


def _preset_words(reader: WordReader, name: str, direction: Direction, folder: Path) -> str:
    """Return the words that a preset stands for; raise CallerError if they are wrong."""
    try:
        words = find_preset(name, folder).words(direction)
    except CallerError as error:
        reader.wrong(str(error))
    try:
        if preset_names(words):
            raise CallerError("a preset cannot name another preset")
        settings_of(words)
    except CallerError as error:
        reader.wrong(f"{direction}: {error}")
    return words


def words_of(settings: LinkSettings) -> str:
    """Return words that :func:`parse` reads back to the same settings."""
    words = [impairment.text() for impairment in settings.impairments]
    words += guarantee_words(settings)
    if settings.first_delivered:
        words.append("first")
    if settings.limit != _LIMIT:
        words.append(f"limit {settings.limit}")
    return " ".join(words)


def guarantee_words(settings: LinkSettings) -> list[str]:
    """Return the words of the guarantee's parts."""
    cap = [] if settings.mansd is None else [f"mansd {settings.mansd}"]
    return [*cap, *(constraint.text() for constraint in settings.constraints)]


def require_no_dashes(arguments: Sequence[str]) -> None:
    """Raise a CallerError if a word begins with dashes."""
    for argument in arguments:
        word = argument.lstrip("-").partition("=")[0]
        if argument.startswith("-") and word in EXAMPLES:
            raise CallerError(f"{argument}: write words without the dashes, e.g. {EXAMPLES[word]}")


def _validate(kind: TypeAdapter[T], content: object, reader: WordReader) -> T:
    try:
        return kind.validate_json(json.dumps(content))  # strict mode: lists for tuples only in JSON
    except ValidationError as error:
        reader.wrong(_message(error))


def _message(error: ValidationError) -> str:
    first = error.errors()[0]
    if first["type"] == "value_error":
        return str(first["ctx"]["error"])
    name = next((part for part in reversed(first["loc"]) if isinstance(part, str)), "")
    if first["type"] == "missing":
        return f"{name} is missing"
    problem = plain_mistake(first["msg"]).removeprefix("Tuple ")
    return f"{name}: {problem}" if name else problem


def _check_place(
    reader: WordReader, impairment: Impairment, earlier: Sequence[Impairment], *, bare_gap: bool
) -> None:
    if isinstance(impairment, Reorder):
        if not any(other.delays for other in earlier):
            reader.wrong("nothing before it delays a packet; it goes after delay or rate")
        if isinstance(earlier[-1], Reorder):
            example = "reorder PERCENT gap N"
            reader.wrong(
                f"there is a reorder before it; write {example}"
                if bare_gap
                else f"there is a reorder, or a gap, before it; write {example}"
            )
