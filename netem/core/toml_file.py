"""Settings files: a TOML file is read into a frozen model, with one line per mistake.

A line is ``file: key = value: what is wrong; what is right``. The first half of this file reads and
validates; the second half turns pydantic's errors into such lines, from :func:`explain` on.
"""

import difflib
import json
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import date, time
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Annotated, Literal, NamedTuple, TypeAlias, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from netem.core.errors import TOO_LARGE, CallerError, did_you_mean, plain_mistake, printable, shortened, why
from netem.core.extension_points import missing_extension
from netem.core.file_access import read_regular
from netem.core.settings_section import ReadTable, ScenarioSection, Table
from netem.core.toml_limits import MOST_LEVELS, TOO_DEEP, TooLargeTextError, parse_toml

M = TypeVar("M", bound=ScenarioSection)
Kind: TypeAlias = object
"""The annotation of a value: a class, a union, a list."""

MOST_BYTES = 2**20  # largest size of a settings file

_PLACE = re.compile(r" \(at (?:line (\d+), column \d+|end of document)\)$")
"""The end of :mod:`tomllib`'s messages."""
_KEY = re.compile(r"\s*(?:[\w.'\"-]+\s*=|\[+\s*[A-Za-z_'\"])")
"""A line that begins with a key or the head of a table."""
_MOST_LOOKED_AT = 100
"""Files beside a missing one that may be suggested instead."""


def read(path: Path, model: type[ScenarioSection] = ScenarioSection, most_bytes: int = MOST_BYTES) -> Table:
    """Read a TOML file of at most ``most_bytes``.

    If the file does not exist, the message suggests a similar file of the type ``model`` beside it.

    Raises:
        CallerError: the file does not exist, is too large, is not a regular file, or is not TOML.
    """
    try:
        text = read_text(path, most_bytes)
    except FileNotFoundError:
        raise CallerError(_missing(path, model)) from None
    return parsed(text, str(path))


def read_text(path: Path, most_bytes: int = MOST_BYTES) -> str:
    """Return the text of a TOML file, which has at most ``most_bytes``.

    Raises:
        FileNotFoundError: there is no such file.
        CallerError: it is empty, too large, not a regular file, or not a text file.
    """
    try:
        text = read_regular(path, most_bytes).decode("utf-8")
    except FileNotFoundError:
        raise
    except UnicodeDecodeError:
        raise CallerError(f"{path}: not a text file; a TOML file is expected") from None
    except (OSError, ValueError) as error:
        raise CallerError(_why_not_read(path, error)) from None
    if not text.strip():
        raise CallerError(f"{path}: the file is empty")
    return text


def _why_not_read(path: Path, error: OSError | ValueError) -> str:
    if not path.is_dir():
        return f"{path}: cannot be read: {why(error)}"
    inner = path / "scenario.toml"  # of a run directory
    return f"{path}: a folder, not a file" + (f"; its scenario is {inner}" if inner.is_file() else "")


def parsed(text: str, source: str) -> Table:
    """Parse TOML; ``source`` names it in error messages.

    Raises:
        CallerError: the text is not TOML, or exceeds a limit.
    """
    try:
        return parse_toml(text)
    except TooLargeTextError as error:
        raise CallerError(f"{source}: {error}") from None
    except tomllib.TOMLDecodeError as error:
        raise CallerError(printable(f"{source}: not valid TOML: {_with_line(text, str(error))}")) from None


def validated(model: type[M], content: ReadTable, source: str, folder: Path | None = None) -> M:
    """Validate parsed content; raise CallerError with one line per mistake, named by ``source``.

    Validators have ``folder`` as their context: names of files are relative to it.
    """
    require_levels(content, source)
    try:
        text = json.dumps(content, default=_unfit)
    except TypeError as error:
        raise CallerError(printable(f"{source}: {error}")) from None
    except ValueError:  # an integer has thousands of digits
        raise CallerError(f"{source}: {TOO_LARGE}") from None
    try:
        # Via JSON, because strict validation accepts an array as a tuple only there.
        return model.model_validate_json(text, context=folder)
    except ValidationError as error:
        raise CallerError("\n".join(explain(error, source, model))) from None


def require_levels(content: ReadTable, source: str) -> None:
    """Raise CallerError if tables and lists are nested too deeply."""
    if _is_deeper(content, MOST_LEVELS):
        raise CallerError(f"{source}: {TOO_DEEP}")


@cache
def json_schema(model: type[ScenarioSection]) -> Table:
    """Return the JSON Schema of a file, for editors."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | model.model_json_schema()


def _is_deeper(value: object, levels: int) -> bool:
    if not isinstance(value, dict | list | tuple):
        return False
    inner = value.values() if isinstance(value, dict) else value
    return levels == 0 or any(_is_deeper(entry, levels - 1) for entry in inner)


def _missing(path: Path, model: type[ScenarioSection]) -> str:
    required_keys = {name for name, field in model.model_fields.items() if field.is_required()}
    candidates = []
    for file in sorted(path.parent.glob("*.toml"))[:_MOST_LOOKED_AT]:
        with suppress(CallerError):
            if required_keys <= read(file).keys():
                candidates.append(str(file))
    hint = did_you_mean(str(path), candidates)
    return f"{path}: no such file" + (f"; {hint}" if hint else "")


def _with_line(text: str, error: str) -> str:
    """Return a message of :mod:`tomllib` with the text of its line, which has the key."""
    match = _PLACE.search(error)
    if match is None:
        return error
    message = error[: match.start()]
    lines = text.rstrip().split("\n")
    number = min(int(match[1] or len(lines)), len(lines))
    while message.startswith("Cannot") and number > 1 and not _KEY.match(lines[number - 1]):
        number -= 1  # the place is the end of a value, the mistake its key
    line = shortened(lines[number - 1].strip())
    return f"line {number}{line and ': '}{line}: {message[:1].lower()}{message[1:]}"


def _unfit(value: object) -> None:
    """Raise TypeError: a value has no equivalent in JSON."""
    if isinstance(value, type):
        written = json.dumps({"kind": "python", "file": "my_plant.py", "name": value.__name__})
        raise TypeError(f"{value.__name__}: a class is given by its file and its name: {written}")
    if isinstance(value, date | time):
        raise TypeError(f"{value}: a date or time cannot be the value of a setting; write text in quotes")
    raise TypeError(f"a value of type {type(value).__name__} cannot be the value of a setting")


_PATTERNS = {
    r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$": "use letters, digits, _ and -, beginning with a letter "
    "or digit, at most 64",
    r"^[a-z][a-z0-9_]{0,31}$": "use small letters, digits and _, beginning with a letter, at most 32",
    r"^[A-Za-z_][\w.:-]*$": "use an entry point's name, or package.module:Class",
    "^[0-9a-f]{64}$": "use 64 hexadecimal digits, in small letters",
}
_MOST_LINES = 50
"""Mistakes that are reported one by one."""
_SIMILAR = 0.8
"""Least similarity of a suggested key, or of its last part, as difflib measures it."""
_MATRIX = "expected a list; a matrix is a list of rows, e.g. [[0.0, 1.0], [2.0, 3.0]]"
_LISTS: dict[object, str] = {
    float: "expected a list of numbers, e.g. [1.0, 0.0]",
    int: "expected a list of numbers, e.g. [1, 2]",
    str: 'expected a list of names, e.g. ["a", "b"]',
    tuple: _MATRIX,
}
"""By the type of the list's entries."""
_WITH_UNIT = re.compile(r"\s*[-+]?\.?[0-9].*")
_KIND_OF_VALUE = re.compile(r"str|literal\[.*\]|tuple\[.*\]")
_PERCENT = re.compile(r"\s*([0-9]+(?:\.[0-9]*)?|\.[0-9]+)\s*%\s*")


def explain(error: ValidationError, source: str, root: type[ScenarioSection]) -> list[str]:
    """Return one line per mistake, and one line for all mistakes beyond the first fifty.

    ``source`` names the file; ``root`` is the model of the whole file.
    """
    mistakes = [mistake for mistake in error.errors(include_url=False) if _concerns(mistake)]
    places = [mistake["loc"] for mistake in mistakes]
    lines = [
        printable(f"{source}: {_explain(mistake, root)}")
        for mistake in mistakes[:_MOST_LINES]
        if not (mistake["type"] == "too_short" and _has_inner(mistake["loc"], places))
        if mistake["type"] != "default_factory_not_called"  # after another mistake
    ]
    surplus = len(mistakes) - _MOST_LINES
    return [*lines, printable(f"{source}: {surplus} more mistakes")] if surplus > 0 else lines


def _concerns(mistake: ErrorDetails) -> bool:
    """Whether a mistake is of the kind of value that is given; its place then is that of the value.

    Of a value that may be a text or a list, pydantic has mistakes of both, and a part of their place
    is the kind.
    """
    place = mistake["loc"]
    kinds = [at for at, part in enumerate(place) if at and _KIND_OF_VALUE.fullmatch(str(part))]
    if not kinds or mistake["type"] == "extra_forbidden":
        return True
    at = kinds[0]
    mistake["loc"] = place[:at] + place[at + 1 :]
    if str(place[at]).startswith("tuple["):
        return mistake["type"] != "tuple_type" or len(place) > at + 1
    mistake["msg"] += ", or a list"
    return not isinstance(mistake["input"], list | tuple)


def nearest_key(key: str, known_keys: Iterable[str]) -> str | None:
    """Return the known key most similar to a key, as a whole or in its last part, if one is."""

    def similarity(known_key: str) -> tuple[float, float]:
        pairs = (key, known_key), (key.rpartition(".")[2], known_key.rpartition(".")[2])
        whole_ratio, last_ratio = (difflib.SequenceMatcher(None, *pair).ratio() for pair in pairs)
        return max(whole_ratio, last_ratio), whole_ratio

    best = max(known_keys, key=similarity, default="")
    return best if similarity(best)[0] >= _SIMILAR else None


def keys(section: type[BaseModel]) -> list[str]:
    """Return the keys of a settings file, each once; of a union of tables, the keys of all."""
    return list(dict.fromkeys(_keys(section, "", ())))


def _keys(section: type[BaseModel], prefix: str, within: tuple[type[BaseModel], ...]) -> Iterator[str]:
    for name, field in section.model_fields.items():
        inner = [table for table in sections_of(field.annotation) if table not in within]
        for table in inner:  # a trigger may contain another
            yield from _keys(table, f"{prefix}{name}.", (*within, *inner))
        if not inner:
            yield f"{prefix}{name}"


def brief(error: ValidationError) -> str:
    """Return the first mistake, ``key: what is wrong``, without the value, which may be secret."""
    first = error.errors(include_url=False, include_input=False)[0]
    place = ".".join(map(str, first["loc"]))
    message = plain_mistake(first["msg"])
    return printable(f"{place}: {message}" if place else message)


def _has_inner(place: Sequence[str | int], places: Iterable[Sequence[str | int]]) -> bool:
    """Whether an entry of this list is itself wrong, so that the list seems too short."""
    return any(len(other_place) > len(place) and other_place[: len(place)] == place for other_place in places)


def _explain(mistake: ErrorDetails, root: type[ScenarioSection]) -> str:
    place = _locate(mistake["loc"], root)
    key = shortened(".".join(map(str, place.path)))
    value, kind = mistake["input"], mistake["type"]
    assignment = f"{key} = {show_value(value)}"
    if kind == "missing":
        return f"{key}: missing{_purpose(place.section, str(place.path[-1]))}"
    if kind == "extra_forbidden":
        return f"{assignment}: unknown key; {_nearest(str(place.path[-1]), place.section, root.key_hints)}"
    if kind == "value_error":
        return _own_check(key, value, str(mistake["ctx"]["error"]))
    chosen = kind in ("union_tag_invalid", "union_tag_not_found")
    if chosen and isinstance(value, Mapping):
        return _choice(key, value, place, root.extension_groups)
    if chosen or kind in ("model_type", "model_attributes_type", "dict_type"):
        return f"{assignment}: expected a table{_table_example(value, place)}"
    if kind == "too_short":
        least = mistake["ctx"]["min_length"]
        return f"{assignment}: needs at least {'one entry' if least == 1 else f'{least} entries'}"
    if kind == "string_pattern_mismatch" and mistake["ctx"]["pattern"] in _PATTERNS:
        return f"{assignment}: {_PATTERNS[mistake['ctx']['pattern']]}"
    if kind == "tuple_type":
        return f"{assignment}: {_LISTS.get(_entry_of(place)) or _list_of_tables(value, place)}"
    message = plain_mistake(mistake["msg"])
    message = message[0].lower() + message[1:]
    if isinstance(value, str) and _WITH_UNIT.fullmatch(value) and message.endswith("number"):
        message += " alone, without a unit or quotes"
    return f"{assignment}: {message}{_share(value, place)}"


class _Place(NamedTuple):
    """The place of a mistake in a file."""

    path: Sequence[str | int]  # of the key
    section: type[ScenarioSection] | None  # which contains the key
    choices: Mapping[str, type[ScenarioSection]]  # possible tables, by the discriminator's value
    discriminator: str  # the key that selects the table
    kind: Kind  # the annotation of the value


def _locate(place: Sequence[str | int], root: type[ScenarioSection]) -> _Place:
    """Find a place; pydantic's path also has the names of selected tables, which are not keys."""
    kind: Kind = root
    path: list[str | int] = []
    section: type[ScenarioSection] | None = None
    alternatives = _choices(kind)
    for part in place:
        choices, _ = _choices(kind)
        if part in choices:
            kind = choices[str(part)]
            continue
        path.append(part)
        kind, section = _entry_kind(kind, part)
        alternatives = _choices(kind)
    return _Place(path, section, *alternatives, kind)


def _entry_kind(kind: Kind, part: str | int) -> tuple[Kind, type[ScenarioSection] | None]:
    """Return the annotation of an entry of ``kind``, and the section that contains the entry."""
    section = _section_of(kind)
    if section is not None:
        field = section.model_fields.get(str(part))
        return (None if field is None else field.annotation), section
    entries = [entry for inner in _alternatives(kind) for entry in get_args(inner)]
    return (entries[0] if isinstance(part, int) and entries else None), None


def _entry_of(place: _Place) -> Kind:
    """Return the entry type of the expected list; for an entry of a row, ``tuple``."""
    lists = [alternative for alternative in _alternatives(place.kind) if get_origin(alternative) is tuple]
    if isinstance(place.path[-1], int) or not lists:
        return tuple
    entry = _alternatives(get_args(lists[0])[0])[0]
    return get_origin(entry) or entry


def _list_of_tables(value: object, place: _Place) -> str:
    """Say that a list of tables is expected; of a table that is given, how it is written as one."""
    lists = [alternative for alternative in _alternatives(place.kind) if get_origin(alternative) is tuple]
    choices, key = _choices(get_args(lists[0])[0])
    if not isinstance(value, Mapping):
        example = _table_example(value, place._replace(choices=choices, discriminator=key)) if choices else ""
        return "expected a list of tables" + example.replace("e.g. {", "such as [{").replace("}", "}]")
    fitting = [kind for kind, section in choices.items() if value.keys() <= section.model_fields.keys()]
    kind = {key: fitting[0]} if len(fitting) == 1 else {}
    entries = ", ".join(f"{name} = {show_value(entry)}" for name, entry in (kind | dict(value)).items())
    in_list = any(isinstance(part, int) for part in place.path)
    header = "" if in_list else f"[[{'.'.join(map(str, place.path))}]], or "
    return f"expected a list of tables: write {header}[{{ {entries} }}]"


def _share(value: object, place: _Place) -> str:
    """Suggest a share if a percentage was given for a number that is at most 1."""
    field = place.section.model_fields.get(str(place.path[-1])) if place.section and place.path else None
    limits = [] if field is None else [*field.metadata, *_metadata(field.annotation)]
    if not any(1 in (getattr(limit, "le", None), getattr(limit, "lt", None)) for limit in limits):
        return ""
    percent = _PERCENT.fullmatch(value) if isinstance(value, str) else None
    if percent is not None:
        value = float(percent[1])
    if isinstance(value, bool) or not isinstance(value, int | float) or not 1 < value <= 100:
        return ""
    return f"; {value:g} % is {value / 100:g}"


def _metadata(kind: Kind) -> list[Kind]:
    """Return the metadata of an annotation's alternatives, e.g. that they are at most 1."""
    metadata = [extra for inner in get_args(kind) for extra in getattr(inner, "__metadata__", ())]
    return [constraint for entry in metadata for constraint in getattr(entry, "metadata", (entry,))]


def _alternatives(kind: Kind) -> list[Kind]:
    """Return a value's possible types, without metadata: A and B for ``Annotated[A | B, ...]``."""
    if get_origin(kind) is Annotated:
        return _alternatives(get_args(kind)[0])
    if get_origin(kind) in (Union, UnionType):
        return [inner for member in get_args(kind) for inner in _alternatives(member)]
    return [kind]


def sections_of(kind: Kind) -> list[type[ScenarioSection]]:
    """Return the tables that a value of an annotation may be."""
    types = [alternative for alternative in _alternatives(kind) if isinstance(alternative, type)]
    return [candidate for candidate in types if issubclass(candidate, ScenarioSection)]


def _section_of(kind: Kind) -> type[ScenarioSection] | None:
    sections = sections_of(kind)
    return sections[0] if len(sections) == 1 else None


def _choices(kind: Kind) -> tuple[Mapping[str, type[ScenarioSection]], str]:
    """Return the possible tables of a value by their discriminator, and the discriminator."""
    sections = sections_of(kind)
    if len(sections) < 2:
        return {}, ""
    key = next(
        name for name, field in sections[0].model_fields.items() if get_origin(field.annotation) is Literal
    )
    return {get_args(section.model_fields[key].annotation)[0]: section for section in sections}, key


def _own_check(key: str, value: object, message: str) -> str:
    """Add key and value to the message of a section's check, ``inner key: what is wrong``."""
    inner, colon, problem = message.partition(": ")
    if not colon or not isinstance(value, Mapping):
        value_text = "" if isinstance(value, Mapping) else f" = {show_value(value)}"
        return f"{key}{value_text}: {message}" if key else message
    path = f"{key}.{inner}" if key else inner
    for part in inner.split("."):
        if isinstance(value, list) and part.isdecimal() and int(part) < len(value):
            value = value[int(part)]
        elif isinstance(value, Mapping) and part in value:
            value = value[part]
        else:
            return f"{path}: {problem}"
    return f"{path} = {show_value(value)}: {problem}"


def _choice(key: str, value: object, place: _Place, groups: Mapping[str, str]) -> str:
    choices_text = ", ".join(place.choices)
    key = f"{key}.{place.discriminator}"
    if not isinstance(value, Mapping) or place.discriminator not in value:
        return f"{key}: missing; one of {choices_text}"
    chosen = value[place.discriminator]
    if missing := missing_extension(groups.get(str(place.path[-1]), ""), str(chosen)):
        return f"{key} = {show_value(chosen)}: {missing}"
    close = difflib.get_close_matches(str(chosen), place.choices, n=1)
    hint = f"; did you mean {close[0]}?" if close else ""
    return f"{key} = {show_value(chosen)}: must be one of {choices_text}{hint}"


def _table_example(value: object, place: _Place) -> str:
    """Return an example of the table: of the kind that the value names, or for a user's class."""
    names_kind = isinstance(value, str) and value in place.choices
    if not names_kind and "python" in place.choices and str(value).isidentifier():
        file = f"my_{place.path[0]}.py"
        return f', e.g. {{ {place.discriminator} = "python", file = "{file}", name = "{value}" }}'
    if place.choices:
        required = {
            choice: [
                name
                for name, field in settings.model_fields.items()
                if field.is_required() and name != place.discriminator
            ]
            for choice, settings in place.choices.items()
        }
        # The simplest that has settings shows how they are written.
        chosen = str(value) if names_kind else min(required, key=lambda choice: len(required[choice]) or 99)
        keys = "".join(f", {name} = ..." for name in required[chosen])
        return f', e.g. {{ {place.discriminator} = "{chosen}"{keys} }}'
    in_list = any(isinstance(part, int) for part in place.path)
    return "" if in_list else f", [{'.'.join(map(str, place.path))}]"


def _purpose(section: type[ScenarioSection] | None, key: str) -> str:
    field = section.model_fields.get(key) if section is not None else None
    inner = _section_of(field.annotation) if field is not None else None
    if inner is not None:
        text = inner.__doc__ or ""
    else:
        text = section.key_descriptions().get(key, "") if section is not None else ""
    purpose = " ".join(text.split("\n\n")[0].split()).rstrip(".")
    if purpose[1:2].islower() or purpose.startswith("A "):  # a word, not M or UDP
        purpose = purpose[0].lower() + purpose[1:]
    return f" ({purpose})" if purpose else ""


def _nearest(key: str, section: type[ScenarioSection] | None, hints: Mapping[str, str]) -> str:
    if key in hints:
        return hints[key]
    section_keys = sorted(section.model_fields) if section is not None else []
    close = difflib.get_close_matches(key, section_keys, n=1)
    return f"did you mean {close[0]}?" if close else f"the keys here are {', '.join(section_keys)}"


def show_value(value: object) -> str:
    """Return a value as JSON, cut off after 60 characters."""
    text = json.dumps(value, default=str, ensure_ascii=False)
    return text if len(text) <= 60 else text[:57] + "..."
