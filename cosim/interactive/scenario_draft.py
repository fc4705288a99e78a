"""The scenario that is being edited: its text, its mistakes by key, and its address.

A change of one value keeps the comments of the text.
"""

import copy
import re
import tomllib
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple
from urllib.parse import parse_qsl, urlencode

import tomlkit
from tomlkit.exceptions import TOMLKitError

from cosim.shipped_files import find_shipped, shipped_names, text_of
from noack.core.errors import CallerError, NoackError
from noack.scenario import toml_file
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import completed, put, remove, toml_text, value_of
from noack.settings.section import ReadTable, Table
from noack.settings.user_files import FILE_TABLES

_SOURCE = "scenario"
_LINE = re.compile(rf"^{_SOURCE}: ([\w.-]+)(?:: | = )")
_BASE = "scenario"
_MOST_QUERY = 16_384
"""Most characters of an address."""
_ABSENT = object()


class Mistake(NamedTuple):
    """A mistake in the edited text."""

    key: str
    """The key at which it is shown, with dots between its parts; empty for the whole text."""
    text: str


class DraftError(CallerError):
    """The text is not a valid scenario."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.mistakes = [_mistake(line) for line in text.splitlines()]


def _mistake(line: str) -> Mistake:
    match = _LINE.match(line)
    return Mistake("" if match is None else match[1], line.removeprefix(f"{_SOURCE}: "))


@dataclass(frozen=True)
class Draft:
    """A scenario file that is being edited."""

    base: str
    """Name of a shipped scenario, or path of a scenario file."""
    folder: Path
    """Relative file names in the text are relative to it."""
    base_text: str
    unedited_text: str
    """The text before the edits."""
    edits: Mapping[str, Callable[[Table], object]] = field(default_factory=dict)
    """Changes of the content by key, in order."""

    @cached_property
    def text(self) -> str:
        """The text; while a slider is dragged nobody needs it, and it takes milliseconds."""
        if not self.edits:
            return self.unedited_text

        def change(content: Table) -> None:
            for edit in self.edits.values():
                edit(content)

        return changed_text(self.unedited_text, self.content, change)

    @cached_property
    def content(self) -> Table:
        """The parsed text; raise DraftError if it is not TOML."""
        try:
            return toml_file.parsed(self.text, _SOURCE)
        except CallerError as error:
            raise DraftError(str(error)) from None

    @cached_property
    def scenario(self) -> Scenario:
        """The validated scenario; raise DraftError with all mistakes."""
        try:
            return completed(self.content, self.folder / "scenario.toml", _SOURCE)
        except DraftError:
            raise
        except NoackError as error:
            raise DraftError(str(error)) from None

    def require_valid(self) -> None:
        """Raise DraftError with all mistakes, unless the text is a valid scenario."""
        _ = self.scenario

    def value(self, key: str) -> object:
        """Return the value of a key in the text; None if it is not given."""
        value = leaf(self.content, key)
        return None if value is _ABSENT else value

    def with_value(self, key: str, value: object) -> "Draft":
        """Return the draft with another value of a key; comments are kept where possible."""
        return self._change(key, lambda content: put(content, key, value, key))

    def without(self, key: str) -> "Draft":
        """Return the draft without a key, which then has its default."""
        if leaf(self.content, key) is _ABSENT:
            return self
        return self._change(key, lambda content: remove(content, key))

    def _change(self, key: str, change: Callable[[Table], object]) -> "Draft":
        content = copy.deepcopy(self.content)
        change(content)
        if "text" in self.__dict__:
            draft = replace(self, unedited_text=self.text, edits={key: change})
        else:
            others = {other: edit for other, edit in self.edits.items() if other != key}
            draft = replace(self, edits={**others, key: change})
        draft.__dict__["content"] = content
        return draft

    def with_text(self, text: str) -> "Draft":
        """Return the draft with another text."""
        return Draft(self.base, self.folder, self.base_text, text)

    def query(self) -> str:
        """Return the draft as the query of an address: the base and the keys that differ from it.

        Raises:
            DraftError: the text is not TOML.
        """
        base = toml_file.parsed(self.base_text, _SOURCE)
        return urlencode([(_BASE, self.base), *differences(base, self.content)])


def leaf(content: ReadTable, key: str) -> object:
    """Return the value of a key, or a mark for its absence; an empty key is the whole content."""
    table: object = content
    for part in key.split(".") if key else ():
        if not isinstance(table, Mapping) or part not in table:
            return _ABSENT
        table = table[part]
    return table


def differences(base: object, content: object, key: str = "") -> list[tuple[str, str]]:
    """Return the keys that differ, with their values as TOML; empty for a key that is gone."""
    if isinstance(base, Mapping) and isinstance(content, Mapping):
        pairs = []
        for part in [*base, *(part for part in content if part not in base)]:
            inner = f"{key}.{part}" if key else str(part)
            if part not in content:
                pairs.append((inner, ""))
            else:
                pairs += differences(base.get(part, _ABSENT), content[part], inner)
        return pairs
    return [] if base == content else [(key, value_text(content))]


def open_draft(name: str) -> Draft:
    """Open a scenario given by path, or by the name of a shipped one.

    Raises:
        CallerError: there is no such file, or it cannot be read.
    """
    path = find_shipped(name, "scenarios")
    if name in shipped_names("scenarios") and not Path(name).is_file():
        text = text_of(name)
    else:
        try:
            text = toml_file.read_text(path)
        except FileNotFoundError:
            raise CallerError(f"{name}: no such file") from None
    return Draft(name, path.absolute().parent, text, text)


def draft_of(scenario: Scenario) -> Draft:
    """Return a draft that begins with a scenario; relative files are those of this folder."""
    text = toml_text(scenario.model_dump(mode="json", exclude_none=True))
    return Draft(scenario.name, Path.cwd(), text, text)


def draft_of_query(query: str, default: str, known: Mapping[str, str]) -> Draft:
    """Return the draft of an address's query, as :meth:`Draft.query` writes it.

    Args:
        query: the query.
        default: the base if the query names none.
        known: names of scenarios that an address may open, and what :func:`open_draft` opens.

    Raises:
        CallerError: the base is not known, a value is not TOML, or the settings name code that
            would be executed: such settings are not taken from an address.
    """
    if len(query) > _MOST_QUERY:
        raise CallerError("the address is too long")
    pairs = parse_qsl(query, keep_blank_values=True)
    base = dict(pairs).get(_BASE, default)
    if base not in known:
        raise CallerError(f"{base}: an address opens shipped scenarios and files of this folder")
    draft = base_draft = open_draft(known[base])
    for key, text in pairs:
        if key != _BASE and text:
            draft = draft.with_value(key, value_of(text, key))
        elif key != _BASE:
            draft = draft.without(key)
    if _code(base_draft.content) != _code(draft.content):
        raise CallerError("the address names files to execute, so its settings were not applied")
    return draft


def _code(content: ReadTable) -> list[object]:
    """Return the tables that name code."""
    tables = [leaf(content, key) for key in FILE_TABLES]
    return [
        table
        for table in tables
        if isinstance(table, Mapping)
        and ("file" in table or "python" in (table.get("kind"), table.get("policy")))
    ]


def known_scenarios(folder: Path, base: str) -> dict[str, str]:
    """Return the scenarios that the page offers: shipped ones, those of a folder, the draft's base."""
    known = {name: name for name in shipped_names("scenarios")}
    for path in sorted(folder.glob("*.toml")):
        try:
            content = toml_file.read(path)
        except CallerError:
            continue
        if {"model", "plant", "network"} <= content.keys():
            known[path.name] = str(path)
    return known | {base: base}


def changed_text(text: str, content: ReadTable, change: Callable[[Table], object]) -> str:
    """Return a changed TOML text with its comments; without them if they cannot be kept.

    Args:
        text: the text.
        content: its content after the change.
        change: changes a document of tomlkit as it has changed the content.
    """
    with suppress(TOMLKitError, tomllib.TOMLDecodeError, ValueError):
        document = tomlkit.parse(text)
        change(document)
        if tomllib.loads(new := document.as_string()) == content:
            return new
    return toml_text(content)


def value_text(value: object) -> str:
    """Return a value as TOML on one line; tables are inline tables."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {value_text(entry)}" for key, entry in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(value_text, value)) + "]"
    return str(tomlkit.item(value).as_string())
