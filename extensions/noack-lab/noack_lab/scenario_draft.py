"""The scenario that is being edited, as text; a change of one value keeps its comments."""

import copy
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

import noack
from noack.extend import CallerError

Table = dict[str, Any]


class DraftError(CallerError):
    """The text is not a valid scenario."""


@dataclass(frozen=True)
class Draft:
    """A scenario file that is being edited."""

    name: str
    """Name of a shipped scenario, or path of a scenario file."""
    text: str

    @cached_property
    def content(self) -> Table:
        """The parsed text; raise DraftError if it is not TOML."""
        try:
            return tomllib.loads(self.text)
        except tomllib.TOMLDecodeError as error:
            raise DraftError(f"not TOML: {error}") from None

    @cached_property
    def scenario(self) -> noack.Scenario:
        """The validated scenario; raise NoackError with all mistakes, one per line."""
        return noack.load(self.content)

    def value(self, key: str) -> Any:
        """Return the value of a key in the text, with dots between its parts; None if it is not given."""
        table: Any = self.content
        for part in key.split("."):
            if not isinstance(table, Mapping) or part not in table:
                return None
            table = table[part]
        return table

    def with_value(self, key: str, value: object) -> "Draft":
        """Return the draft with another value of a key; None removes it, so that it has its default."""
        content = copy.deepcopy(self.content)
        _put(content, key, value)
        text = ""
        with suppress(TOMLKitError, ValueError):  # what cannot keep its comments is written anew
            document = tomlkit.parse(self.text)
            _put(document, key, value)
            text = document.as_string()
        if not text or _parsed(text) != content:
            text = tomlkit.dumps(content)
        return replace(self, text=text)


def _put(content: Any, key: str, value: object) -> None:
    """Change a value in a table of tables, or remove it."""
    *tables, last = key.split(".")
    for part in tables:
        content = content.setdefault(part, {})
    if value is None:
        content.pop(last, None)
    else:
        content[last] = value


def _parsed(text: str) -> Table | None:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return None


def open_draft(name: str) -> Draft:
    """Open a scenario given by path, or by the name of a shipped one.

    Raises:
        NoackError: there is no such scenario, or its file cannot be read.
    """
    shipped = noack.scenarios()
    if name in shipped and not Path(name).is_file():
        return Draft(name, shipped[name])
    noack.load(name)  # its messages name the file, and similar names
    return Draft(name, Path(name).read_text(encoding="utf-8"))


def draft_of(scenario: noack.Scenario) -> Draft:
    """Return a draft that begins with a scenario."""
    return Draft(scenario.name, tomlkit.dumps(scenario.model_dump(mode="json", exclude_none=True)))


def setting(word: str) -> tuple[str, object]:
    """Return key and value of a word ``KEY=VALUE``; a value that is no TOML is a text."""
    key, equals, text = word.partition("=")
    if not (key and equals):
        raise DraftError(f"--set {word}: expected KEY=VALUE")
    parsed = _parsed(f"value = {text}")
    return key, text if parsed is None else parsed["value"]
