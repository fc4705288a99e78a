"""Settings files: a TOML file is read into a frozen model, with one line per mistake."""

import json
import re
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from datetime import date, time
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from noack.config.validation_messages import explain
from noack.core.errors import CallerError, did_you_mean, printable, shortened
from noack.core.file_access import read_regular
from noack.settings.section import ScenarioSection

M = TypeVar("M", bound=ScenarioSection)

MOST_BYTES = 2**20  # largest size of a settings file
MOST_LEVELS = 32  # largest number of parts of a dotted key, and of nested tables and lists

_STRING = re.compile(
    r"""
      (?P<comment> \# [^\n]*+ )
    | \"{3} (?: [^"\\] | \\.? | "(?!"") )*+ (?: \"{3,5} )?
    | '{3} (?: [^'] | '(?!'') )*+ (?: '{3,5} )?
    | " (?: [^"\\\n] | \\[^\n]? )*+ "?
    | ' [^'\n]*+ '?
    """,
    re.VERBOSE | re.DOTALL,
)
"""Strings and comments of TOML; an unterminated one ends at the last possible place."""
_TWICE = re.compile(
    r"(?:Cannot (?:overwrite|declare|redefine|mutate)|Duplicate inline table key '(?P<inner>.*)').*"
    r"\(at (?:line (?P<line>\d+)|end)"
)
"""Errors of :mod:`tomllib` about a key that is defined already: most do not name it."""
_TABLE = re.compile(r"\s*\[+([^\]\n]+)\]")
_TOO_DEEP = f"tables and lists lie within each other more than {MOST_LEVELS} levels deep"
_TOO_LARGE = "an integer is too large"
_MOST_LOOKED_AT = 100
_LONG_KEY = re.compile(rf"(?<![\w-])(?:[\w-]++[ \t]*+\.[ \t]*+){{{MOST_LEVELS}}}")


def read(
    path: Path, model: type[ScenarioSection] = ScenarioSection, most_bytes: int = MOST_BYTES
) -> dict[str, Any]:
    """Read a TOML file of at most ``most_bytes``.

    If the file does not exist, the message suggests a similar file of the type ``model`` beside it.

    Raises:
        CallerError: the file does not exist, is too large, is not a regular file, or is not TOML.
    """
    try:
        text = read_regular(path, most_bytes).decode("utf-8")
    except FileNotFoundError:
        raise CallerError(_missing(path, model)) from None
    except (OSError, ValueError) as error:
        raise CallerError(f"{path}: cannot be read: {error}") from None
    return parsed(text, str(path))


def parsed(text: str, source: str) -> dict[str, Any]:
    """Parse TOML; ``source`` names it in error messages.

    :mod:`tomllib` needs memory for n² parts for a key of n parts. So keys with too many parts are
    refused before the text is parsed.

    Raises:
        CallerError: the text is not TOML, or a key in it has too many parts.
    """
    bare = _STRING.sub(lambda found: "" if found["comment"] else "_", text)
    if _LONG_KEY.search(bare):
        raise CallerError(f"{source}: a key has more than {MOST_LEVELS} parts")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise CallerError(f"{source}: {_TOO_DEEP}") from None
    except tomllib.TOMLDecodeError as error:
        wrong = _defined_twice(text, str(error)) or str(error)
        raise CallerError(printable(f"{source}: not valid TOML: {wrong}")) from None
    except ValueError:  # an integer has thousands of digits
        raise CallerError(f"{source}: {_TOO_LARGE}") from None


def validated(model: type[M], content: Mapping[str, Any], source: str) -> M:
    """Validate parsed content; raise CallerError with one line per mistake, named by ``source``."""
    if _is_deeper(content, MOST_LEVELS):
        raise CallerError(f"{source}: {_TOO_DEEP}")
    try:
        text = json.dumps(content, default=_unfit)
    except TypeError as error:
        raise CallerError(printable(f"{source}: {error}")) from None
    except ValueError:  # an integer has thousands of digits
        raise CallerError(f"{source}: {_TOO_LARGE}") from None
    try:
        # Via JSON, because strict validation accepts an array as a tuple only there.
        return model.model_validate_json(text)
    except ValidationError as error:
        raise CallerError("\n".join(explain(error, source, model))) from None


def json_schema(model: type[ScenarioSection]) -> dict[str, Any]:
    """Return the JSON Schema of a file, for editors."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | model.model_json_schema()


def _is_deeper(value: Any, levels: int) -> bool:
    if not isinstance(value, dict | list | tuple):
        return False
    inner = value.values() if isinstance(value, dict) else value
    return levels == 0 or any(_is_deeper(one, levels - 1) for one in inner)


def _missing(path: Path, model: type[ScenarioSection]) -> str:
    needed = {name for name, field in model.model_fields.items() if field.is_required()}
    others = []
    for other in sorted(path.parent.glob("*.toml"))[:_MOST_LOOKED_AT]:
        with suppress(CallerError):
            if needed <= read(other).keys():
                others.append(str(other))
    near = did_you_mean(str(path), others)
    return f"{path}: no such file" + (f"; {near}" if near else "")


def _defined_twice(text: str, error: str) -> str | None:
    """Return which key is defined twice, and in which lines; None if the error is another one."""
    found = _TWICE.match(error)
    if found is None:
        return None
    keys = _keys(text, int(found["line"] or text.count("\n") + 1))
    line, key = keys.pop()
    if (inner := found["inner"]) is not None:
        return f"line {line}: {shortened(f'{key}.{inner}')} is defined twice"
    before = [one for one, other in keys if other == key] or [
        one for one, other in keys if key.startswith(f"{other}.") or other.startswith(f"{key}.")
    ]
    where = f"already defined in line {before[-1]}" if before else "a table with a key twice"
    return f"line {line}: {shortened(key)} is {where}"


def _keys(text: str, last: int) -> list[tuple[int, str]]:
    """Return line and full key of each key and table that begins in the lines up to the last."""

    def hidden(found: re.Match[str]) -> str:
        return re.sub(r"[^\n]", " " if found["comment"] else "_", found[0])

    keys, table, depth = list[tuple[int, str]](), "", 0
    lines = zip(text.split("\n"), _STRING.sub(hidden, text).split("\n"), strict=True)
    for number, (line, bare) in enumerate(list(lines)[:last], 1):
        header = _TABLE.match(bare) if depth == 0 else None
        if header is not None:
            table = _plain(line[slice(*header.span(1))])
            keys.append((number, table))
        elif depth == 0 and "=" in bare:
            key = _plain(line[: bare.index("=")])
            keys.append((number, f"{table}.{key}" if table else key))
        depth += sum(map(bare.count, "[{")) - sum(map(bare.count, "]}"))
    return keys


def _plain(key: str) -> str:
    return ".".join(part.strip() for part in key.split("."))


def _unfit(value: object) -> None:
    """Raise TypeError: a value has no equivalent in JSON."""
    if isinstance(value, type):
        written = json.dumps({"kind": "python", "file": "my_plant.py", "name": value.__name__})
        raise TypeError(f"{value.__name__}: a class is given by its file and its name: {written}")
    if isinstance(value, date | time):
        raise TypeError(f"{value}: a date or time is no value of a setting; write text in quotes")
    raise TypeError(f"a value of type {type(value).__name__} is no value of a setting")
