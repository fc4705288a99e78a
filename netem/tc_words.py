"""Converts words to settings and back: the words of ``tc netem``, and additional ones.

    delay 10ms 2ms distribution normal loss gemodel 1% 10% mansd 4

The order of the words is the order of the impairments; the position of ``mansd``, ``atmost``,
``recover``, ``first``, ``limit`` and ``seed`` does not matter. Words cannot be abbreviated.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple, Self, TypeVar

from pydantic import BeforeValidator, Field, FiniteFloat, TypeAdapter, ValidationError, model_validator

from netem.relay.relay_links import LinkSpec
from noack.core.errors import CallerError, plain_mistake, shortened
from noack.impairments.constraints import CONSTRAINTS, AnyConstraint
from noack.impairments.feature import Constraint, Feature, Impairment
from noack.impairments.kinds import IMPAIRMENTS, AnyImpairment
from noack.impairments.kinds.reorder import Reorder
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_prediction import read_files
from noack.impairments.words import COUNT, WordReader, percent_text
from noack.runtime.address import parse_address, parse_destination
from noack.scenario import toml_file
from noack.settings.section import ScenarioSection, Seed, Table

T = TypeVar("T")
_REFUSED = {
    "slot": "this emulator does not gather packets into slots; it has rate and blackout",
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
KEYWORDS = (*_CLAUSES, *_SETTINGS, "seed")
"""Words that begin a clause."""
_WORDS = [word for kind in _KINDS for clause in kind.clauses for word in clause.described()]
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
}
"""By word; ``seed`` is missing because it is also an option."""
GRAMMAR = [
    word.grammar
    for kind in IMPAIRMENTS
    for clause in kind.clauses
    for word in clause.described()
    if word.grammar
]
"""The words of each impairment, for ``--help``."""
_IMPAIRMENT, _CONSTRAINT = TypeAdapter(AnyImpairment), TypeAdapter(AnyConstraint)
_LINK, _SEED = TypeAdapter(LinkSettings), TypeAdapter[int](Seed)
_LIMIT = LinkSettings.model_fields["limit"].default


class LinkWords(NamedTuple):
    """Settings in words."""

    settings: LinkSettings
    seed: int | None  # Seed of the random streams, if the words contain one


def parse(words: str | Sequence[str]) -> LinkWords:
    """Read the settings of one direction of a link; see :class:`WordReader`.

    Raises:
        CallerError: one line with the wrong word, the expected words, and the nearest known word.
    """
    reader = WordReader(words)
    impairments: list[Impairment] = []
    constraints: list[Constraint] = []
    settings: dict[str, int] = {}
    while (word := reader.begin()) is not None:
        if word in _REFUSED:
            reader.wrong(_REFUSED[word])
        if word in _AFTER:
            reader.wrong(f"goes right after {_AFTER[word]}")
        if word not in KEYWORDS:
            reader.unknown(word, KEYWORDS)
        if word in _CLAUSES:
            kind, clause = _CLAUSES[word]
            table = {"kind": kind.model_fields["kind"].default, **clause.read(reader)}
            if issubclass(kind, Constraint):
                constraints.append(_validated(_CONSTRAINT, table, reader))
                continue
            impairment = _validated(_IMPAIRMENT, table, reader)
            _check_place(reader, impairment, impairments, bare_gap=word == "gap")
            impairments.append(impairment)
            continue
        if word in settings:
            reader.wrong("given twice")
        settings[word] = True if word == "first" else reader.value(COUNT)
        if word == "seed":
            _validated(_SEED, settings[word], reader)
        else:
            _validated(_LINK, {_SETTINGS[word]: settings[word]}, reader)
    seed = settings.pop("seed", None)
    content: Table = {_SETTINGS[word]: value for word, value in settings.items()}
    content |= {"impairments": tuple(impairments), "constraints": tuple(constraints)}
    try:
        return LinkWords(LinkSettings.model_validate(content), seed)
    except ValidationError as error:
        # Each setting is valid by itself; the error is a combination of settings.
        key, _, message = _message(error).partition(": ")
        word = "lossrel: " if key.endswith("loss_correlation") else ""
        raise CallerError(f"{word}{message}") from None


def settings_of(words: str | Sequence[str]) -> LinkSettings:
    """Read the settings of one direction of a link from words without a seed.

    Raises:
        CallerError: as :func:`parse`, or the words contain a seed.
    """
    settings, seed = parse(words)
    if seed is not None:
        raise CallerError(f"seed {seed}: belongs to the link, not to one of its directions")
    return settings


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


def _validated(kind: TypeAdapter[T], content: object, reader: WordReader) -> T:
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


_FIXED_ORDER = ("duplicate", "loss", "corrupt", "delay", "reorder", "rate")
"""tc applies its impairments in this order, whatever the order of the words."""
_LONGEST = 60
"""Words that are left out are cut to this number of characters."""


class TcCommand(NamedTuple):
    """The nearest settings that ``tc`` supports."""

    words: str | None
    """After ``tc qdisc add dev DEVICE root netem``; None if tc supports none of the settings."""
    lacks: tuple[str, ...]
    """The words that are left out, each with the missing tc feature."""
    notes: tuple[str, ...]
    """Differences in behaviour."""


def tc_command(settings: LinkSettings, written: LinkSettings | None = None) -> TcCommand:
    """Return the nearest words of tc's own netem, and the settings that they leave out.

    ``written`` are the same settings, with the names of files instead of their content.
    """
    supported: list[Impairment] = []
    lacks: list[str] = []
    pairs = zip(settings.impairments, (written or settings).impairments, strict=True)
    expressible = [(impairment, original.text()) for impairment, original in pairs if impairment.tc_text()]
    for impairment, words in expressible:
        if share := getattr(impairment, "loss_correlation", 0.0):
            lacks.append(f"lossrel {percent_text(share)} (a delay correlated with loss)")
        lack = impairment.tc_lacks(supported)
        if any(earlier.kind == impairment.kind for earlier in supported):
            lack = f"a second {impairment.kind}"
        if lack:
            lacks.append(f"{shortened(words, _LONGEST)} ({lack})")
        else:
            supported.append(impairment)
    if settings.mansd is not None:
        lacks.append(f"mansd {settings.mansd} (a cap on consecutive losses)")
    lacks += [f"{constraint.text()} (a constraint on losses)" for constraint in settings.constraints]
    if settings.first_delivered:
        lacks.append("first (that the first packet of each flow is delivered)")
    if expressible and not supported:
        return TcCommand(None, tuple(lacks), ())
    text = " ".join([f"limit {settings.limit}", *(impairment.tc_text() for impairment in supported)])
    notes = [note for impairment in supported for note in impairment.tc_notes()]
    kinds = [impairment.kind for impairment in supported]
    order = [_FIXED_ORDER.index(kind) for kind in kinds if kind in _FIXED_ORDER]
    if order != sorted(order):
        notes.append(f"its order is fixed: {', '.join(_FIXED_ORDER)}")
    return TcCommand(text, tuple(lacks), tuple(dict.fromkeys(notes)))


def _settings(value: object) -> LinkSettings:
    if isinstance(value, LinkSettings):
        return value
    if not isinstance(value, str):
        # Strict validation accepts lists for tuples only in JSON, so that this goes through JSON.
        return LinkSettings.model_validate_json(json.dumps(value))
    try:
        return settings_of(value)
    except CallerError as error:
        raise ValueError(str(error)) from None


Side = Annotated[LinkSettings, BeforeValidator(_settings, json_schema_input_type=str | LinkSettings)]


class LinkTable(ScenarioSection):
    """One link of a relay: its addresses, and its settings in each direction."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")]
    """Names the link in reports, and its random streams: letters, digits, _ and -."""
    listen: str
    """Where clients send to: HOST:PORT; port 0 takes a free one."""
    to: str
    """The server: HOST:PORT."""
    forward: Side = LinkSettings()
    """From clients to the server: words, e.g. "delay 10ms loss 5%", or a table."""
    reverse: Side = LinkSettings()
    """From the server to the clients: words or a table, as for forward."""
    words: Side | None = None
    """Another name for forward."""
    seed: Seed = 0
    """Seed of the link's random streams."""
    return_path: bool = True
    """false: forward direction only; the server's answers are discarded."""
    idle_s: Annotated[FiniteFloat, Field(gt=0, le=1e6)] = LinkSpec.idle_s
    """A client without a datagram in either direction for this time, in seconds, is removed."""
    most_clients: Annotated[int, Field(ge=1, le=1_000_000)] = LinkSpec.most_clients
    """Maximum number of clients; datagrams of further clients are refused and counted."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.words is not None and "forward" in self.model_fields_set:
            raise ValueError("words: is short for forward; give one of them")
        return self

    def spec(self, folder: Path, place: str, *, read: bool = True) -> LinkSpec:
        """Return the link for a relay; resolves its addresses, and reads its files in a folder.

        Raises:
            CallerError: the table has a mistake; one line, which begins with ``place``.
        """
        listen = parse_address(self.listen, f"{place}.listen")
        forward, reverse = self.words or self.forward, self.reverse
        if read:
            forward = read_files(forward, folder, f"{place}.forward")
            reverse = read_files(reverse, folder, f"{place}.reverse")
        return LinkSpec(
            listen=listen,
            to=parse_destination(self.to, f"{place}.to", listen),
            forward=forward,
            reverse=reverse,
            **self.model_dump(include={"name", "seed", "return_path", "idle_s", "most_clients"}),
        )


class LinksFile(ScenarioSection):
    """Links of one relay."""

    link: Annotated[tuple[LinkTable, ...], Field(min_length=1)]
    """The links, [[link]] each."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        names: set[str] = set()
        for number, link in enumerate(self.link):
            if link.name in names:
                raise ValueError(f"link.{number}.name: another link has this name already")
            names.add(link.name)
        return self


def load_links(path: Path, *, read: bool = True) -> tuple[LinkSpec, ...]:
    """Read a links file; ``read`` also the files that it names.

    Raises:
        CallerError: one line per mistake, each with file, key, value and remedy.
    """
    links = toml_file.validated(LinksFile, toml_file.read(path, LinksFile), str(path)).link
    specs = tuple(
        link.spec(path.parent, f"{path}: link.{number}", read=read) for number, link in enumerate(links)
    )
    listening: dict[object, str] = {}
    for number, spec in enumerate(specs):
        if spec.listen[1] and spec.listen in listening:
            raise CallerError(
                f'{path}: link.{number}.listen = "{links[number].listen}": '
                f"link {listening[spec.listen]} listens there already; take another port, or 0"
            )
        listening[spec.listen] = spec.name
    return specs


def json_schema() -> Table:
    """Return the JSON Schema of links files, for editors."""
    return toml_file.json_schema(LinksFile)
