"""From words to settings: what ``tc netem`` understands, and what it has no words for.

    delay 10ms 2ms distribution normal loss gemodel 1% 10% mansd 4

The order of the words is the order of the impairments; ``mansd``, ``first``, ``limit`` and ``seed``
are settings, wherever they stand.
"""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, get_args

from pydantic import TypeAdapter, ValidationError

from netem.words.loss_words import Table, read_loss
from netem.words.quantities import (
    CORRELATION,
    COUNT,
    OWN_TIME_S,
    PERCENT,
    RATE_BPS,
    SIGNED_COUNT,
    SIGNED_PERCENT,
    TIME,
    TIME_S,
)
from netem.words.word_reader import WordReader
from noack.config.impairments import Delay, Distribution, Impairment, LinkSettings, Rate, Reorder
from noack.core.errors import CallerError
from noack.settings.section import Seed

SHAPES = tuple(shape for shape in get_args(Distribution) if shape != "empirical")
"""Names of distributions; any other word after ``distribution`` is a file's name."""

_REFUSED = {
    "slot": "this emulator does not gather datagrams into slots; rate and blackout are what it has",
    "ecn": "this emulator cannot mark datagrams: it sees payloads, not IP headers",
}
_AFTER = {
    "distribution": "delay TIME JITTER", "samples": "delay TIME", "lossrel": "delay TIME",
    "queue": "rate RATE", "once": "loss trace FILE", "from": "loss periodic BURST/PERIOD",
    "every": "loss script NUMBERS, or after blackout BEGIN-END", "gemodel": "loss",
    "random": "loss", "state": "loss",
}  # fmt: skip
_INTERVALS = "intervals of time, e.g. 2s-3s,5s-5500ms"
_SAMPLES = "delays with their units, e.g. 1ms,2ms,10ms"
_SEED: TypeAdapter[int] = TypeAdapter(Seed)


class LinkWords(NamedTuple):
    """What words say."""

    settings: LinkSettings
    seed: int | None
    """Of the random streams, if the words give one."""


def parse(words: str | Sequence[str]) -> LinkWords:
    """Read the settings of one direction of a link from words.

    Args:
        words: one string of words, as on a shell's line, or the words; of these one may be a string
            of several again.

    Raises:
        CallerError: one line; which word, what was expected there, the nearest known word.
    """
    reader = WordReader(words)
    impairments: list[Impairment] = []
    settings: Table = {}
    while (word := reader.begin()) is not None:
        word = _keyword(reader, word)
        if word in _IMPAIRMENTS:
            table = _IMPAIRMENTS[word](reader)
            impairment: Impairment = _validated(_IMPAIRMENT, table, reader)
            _check_place(reader, impairment, impairments, bare_gap=word == "gap")
            impairments.append(impairment)
            continue
        if word in settings:
            reader.wrong("given twice")
        settings[word] = True if word == "first" else reader.value(COUNT)
        _check_setting(reader, word, settings[word])
    return LinkWords(
        _settings(impairments, settings),
        settings.get("seed"),
    )


def settings_of(words: str | Sequence[str]) -> LinkSettings:
    """Read the settings of one direction of a link from words that name no seed.

    Raises:
        CallerError: as :func:`parse`.
    """
    settings, seed = parse(words)
    if seed is not None:
        raise CallerError(f"seed {seed}: belongs to the link, not to one of its directions")
    return settings


def _keyword(reader: WordReader, word: str) -> str:
    if word in _REFUSED:
        reader.wrong(_REFUSED[word])
    if word in _AFTER:
        reader.wrong(f"goes right after {_AFTER[word]}")
    word = reader.choose(word, KEYWORDS)
    return _SYNONYMS.get(word, word)


def _settings(impairments: list[Impairment], settings: Mapping[str, Any]) -> LinkSettings:
    given: Table = {}
    for word, key in _SETTINGS.items():
        if word in settings:
            given[key] = settings[word]
    try:
        return LinkSettings(impairments=tuple(impairments), **given)
    except ValidationError as error:
        # Of single settings all are checked; what remains is what goes together.
        raise CallerError(f"lossrel: {_message(error).partition(': ')[2]}") from None


def _check_setting(reader: WordReader, word: str, value: Any) -> None:
    if word == "seed":
        try:
            _SEED.validate_python(value)
        except ValidationError as error:
            reader.wrong(_message(error))
    else:
        _validated(TypeAdapter(LinkSettings), {_SETTINGS[word]: value}, reader)


def _validated(kind: TypeAdapter[Any], table: Table, reader: WordReader) -> Any:
    try:
        return kind.validate_json(json.dumps(table))  # strict takes lists for tuples only in JSON
    except ValidationError as error:
        reader.wrong(_message(error))


def _message(error: ValidationError) -> str:
    first = error.errors()[0]
    if first["type"] == "value_error":
        return str(first["ctx"]["error"])
    name = next((f"{part} " for part in reversed(first["loc"]) if isinstance(part, str)), "")
    return name + first["msg"].removeprefix("Input ").removeprefix("Tuple ")


def _check_place(
    reader: WordReader, impairment: Impairment, before: Sequence[Impairment], *, bare_gap: bool
) -> None:
    if isinstance(impairment, Reorder):
        if not any(isinstance(one, Delay | Rate) for one in before):
            reader.wrong("nothing before it delays a datagram; it goes after delay or rate")
        if isinstance(before[-1], Reorder):
            how = "reorder PERCENT gap N"
            reader.wrong(f"there is a reorder before it; write {how}" if bare_gap else
                         f"there is a reorder, or a gap, before it; write {how}")  # fmt: skip


def _loss(reader: WordReader) -> Table:
    table = {"kind": "loss", "loss": read_loss(reader)}
    if reader.accept("ecn"):
        reader.wrong(_REFUSED["ecn"])
    return table


def _chance(kind: str) -> Callable[[WordReader], Table]:
    def read(reader: WordReader) -> Table:
        table: Table = {"kind": kind, "probability": reader.value(PERCENT)}
        if reader.number_follows():
            table["correlation"] = reader.value(CORRELATION)
        return table

    return read


def _reorder(reader: WordReader) -> Table:
    table = _chance("reorder")(reader)
    if reader.accept("gap"):
        table["gap"] = reader.value(COUNT)
    return table


def _gap(reader: WordReader) -> Table:
    return {"kind": "reorder", "gap": reader.value(COUNT)}


def _delay(reader: WordReader) -> Table:
    table: Table = {"kind": "delay", "delay_s": reader.value(TIME_S)}
    if reader.number_follows():
        table["jitter_s"] = reader.value(TIME_S)
        if reader.number_follows():
            table["correlation"] = reader.value(CORRELATION)
    while True:
        if reader.accept("distribution", "dist"):
            _once(reader, table, "distribution")
            _distribution(reader, table)
        elif reader.accept("samples"):
            _once(reader, table, "distribution")
            table["distribution"] = "empirical"
            table["samples_s"] = reader.values(OWN_TIME_S, _SAMPLES)
        elif reader.accept("lossrel"):
            _once(reader, table, "loss_correlation")
            table["loss_correlation"] = reader.value(SIGNED_PERCENT)
        else:
            return table


def _once(reader: WordReader, table: Table, key: str) -> None:
    if key in table:
        reader.wrong("this delay has one already")


def _distribution(reader: WordReader, table: Table) -> None:
    name = reader.file(f"one of {', '.join(SHAPES)}, or a file")
    if name not in SHAPES:
        table |= {"distribution": "empirical", "file": name}
        return
    table["distribution"] = name
    if "jitter_s" not in table:
        reader.wrong("says nothing without jitter; write delay TIME JITTER distribution NAME")


def _rate(reader: WordReader) -> Table:
    table: Table = {"kind": "rate", "rate_bps": reader.value(RATE_BPS)}
    for key, signs in (("overhead_bytes", "-"), ("cell_bytes", ""), ("cell_overhead_bytes", "-")):
        if not reader.number_follows(signs):
            break
        table[key] = reader.value(SIGNED_COUNT)
    if reader.accept("queue"):
        table["queue"] = reader.value(COUNT)
    return table


def _blackout(reader: WordReader) -> Table:
    intervals: list[tuple[float, ...]] = []
    for part in reader.word(_INTERVALS).split(","):
        found = re.fullmatch(f"({TIME})-({TIME})", part)
        if found is None:
            reader.wrong(f"expected {_INTERVALS}")
        intervals.append(tuple(reader.read(time, OWN_TIME_S) for time in found.groups()))
    table: Table = {"kind": "blackout", "intervals_s": intervals}
    if reader.accept("every"):
        table["every_s"] = reader.value(OWN_TIME_S)
    return table


_IMPAIRMENT: TypeAdapter[Any] = TypeAdapter(Impairment)
_IMPAIRMENTS: Mapping[str, Callable[[WordReader], Table]] = {
    "loss": _loss,
    "delay": _delay,
    "duplicate": _chance("duplicate"),
    "corrupt": _chance("corrupt"),
    "reorder": _reorder,
    "gap": _gap,
    "rate": _rate,
    "blackout": _blackout,
}
_SETTINGS = {"mansd": "mansd", "first": "first_delivered", "limit": "limit"}
_SYNONYMS = {"latency": "delay", "drop": "loss"}
KEYWORDS = (*_IMPAIRMENTS, *_SETTINGS, "seed", *_SYNONYMS)
