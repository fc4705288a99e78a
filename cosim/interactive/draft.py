"""The scenario that is being edited: its text, its mistakes by key, and its address.

A change of one value keeps the comments of the text: the changed text is parsed and compared with
what is wanted. If the value is not found where it is looked for, the whole text is written anew,
without comments.
"""

import copy
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import parse_qsl, urlencode

import tomli_w

from cosim.shipped_files import find_shipped, shipped_names, text_of
from noack.config import toml_file
from noack.config.runtime_parameters import full_key
from noack.config.scenario import Scenario
from noack.config.scenario_file import completed, put, toml_text, value_of
from noack.core.errors import CallerError, NoackError
from noack.core.file_access import read_regular
from noack.settings.user_files import PLACES

_SOURCE = "scenario"
_LINE = re.compile(rf"^{_SOURCE}: ([\w.-]+)(?:: | = )")
_BASE = "scenario"
_MOST_QUERY = 16_384
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
    found = _LINE.match(line)
    return Mistake("" if found is None else found[1], line.removeprefix(f"{_SOURCE}: "))


@dataclass(frozen=True)
class Draft:
    """A scenario file that is being edited."""

    base: str
    """Name of a shipped scenario, or path of a scenario file."""
    folder: Path
    """Relative file names in the text are relative to it."""
    base_text: str
    text: str

    @cached_property
    def content(self) -> dict[str, Any]:
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

    def value(self, key: str) -> Any:
        """Return the value of a key in the text; None if it is not given."""
        found = leaf(self.content, key)
        return None if found is _ABSENT else found

    def with_value(self, key: str, value: Any) -> "Draft":
        """Return the draft with another value of a key; comments are kept where possible."""
        key, content = full_key(key), copy.deepcopy(self.content)
        put(content, key, value, key)
        made = replace(self, text=with_value(self.text, self.content, key, value))
        made.__dict__["content"] = content
        return made

    def without(self, key: str) -> "Draft":
        """Return the draft without a key, which then has its default."""
        content = copy.deepcopy(self.content)
        *path, last = key.split(".")
        table: Any = leaf(content, ".".join(path)) if path else content
        if not isinstance(table, dict) or last not in table:
            return self
        del table[last]
        made = replace(self, text=without_value(self.text, content, key))
        made.__dict__["content"] = content
        return made

    def with_text(self, text: str) -> "Draft":
        """Return the draft with another text."""
        return replace(self, text=text)

    def query(self) -> str:
        """Return the draft as the query of an address: the base and the keys that differ from it.

        Raises:
            DraftError: the text is not TOML.
        """
        base = toml_file.parsed(self.base_text, _SOURCE)
        return urlencode([(_BASE, self.base), *differences(base, self.content)])


def leaf(content: Mapping[str, Any], key: str) -> Any:
    """Return the value of a key, or a mark for its absence."""
    table: Any = content
    for part in key.split("."):
        if not isinstance(table, Mapping) or part not in table:
            return _ABSENT
        table = table[part]
    return table


def differences(base: Any, content: Any, key: str = "") -> list[tuple[str, str]]:
    """Return the keys that differ, with their values as TOML; empty for a key that is gone."""
    if isinstance(base, Mapping) and isinstance(content, Mapping):
        found = []
        for part in [*base, *(part for part in content if part not in base)]:
            inner = f"{key}.{part}" if key else str(part)
            if part not in content:
                found.append((inner, ""))
            else:
                found += differences(base.get(part, _ABSENT), content[part], inner)
        return found
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
            text = read_regular(path, toml_file.MOST_BYTES).decode("utf-8")
        except (OSError, ValueError) as error:
            raise CallerError(f"{name}: cannot be read: {error}") from None
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
    draft = opened = open_draft(known[base])
    for key, text in pairs:
        if key != _BASE and text:
            draft = draft.with_value(key, value_of(text, key))
        elif key != _BASE:
            draft = draft.without(key)
    if _code(opened.content) != _code(draft.content):
        raise CallerError("the address names files to execute, so its settings were not applied")
    return draft


def _code(content: Mapping[str, Any]) -> list[Any]:
    """Return the tables that name code."""
    tables = [leaf(content, place) for place in PLACES]
    return [
        table
        for table in tables
        if isinstance(table, Mapping)
        and ("file" in table or {"python", "fmu"} & {table.get("kind"), table.get("policy")})
    ]


def known_scenarios(folder: Path, given: str) -> dict[str, str]:
    """Return the scenarios that the page offers: shipped ones, those of a folder, the given one."""
    known = {name: name for name in shipped_names("scenarios")}
    for path in sorted(folder.glob("*.toml")):
        try:
            content = toml_file.read(path)
        except CallerError:
            continue
        if {"model", "plant", "network"} <= content.keys():
            known[path.name] = str(path)
    return known | {given: given}


_HEADER = re.compile(r"^\s*\[([^\[\]]+)\]\s*(?:#.*)?$")
_VALUE = r"(?:\"[^\"\n]*\"|'[^'\n]*'|\[(?:[^\[\]\n]|\[[^\[\]\n]*\])*\]|[^\s,}#\[{]+)"


def with_value(text: str, content: Mapping[str, Any], key: str, value: Any) -> str:
    """Return the text with another value of a key such as ``trigger.beta``.

    Args:
        text: the TOML text; without comments it says the same as ``content``.
        content: its parsed content.
        key: parts with dots between them.
        value: a TOML value; a table replaces the whole table.
    """
    wanted = copy.deepcopy(dict(content))
    put(wanted, key, value, key)
    lines = text.splitlines()
    for changed in _candidates(lines, key.split("."), value):
        new = "\n".join(changed) + "\n"
        if _means(new, wanted):
            return new
    return toml_text(wanted)


def without_value(text: str, wanted: Mapping[str, Any], key: str) -> str:
    """Return the text without a key; ``wanted`` is the content that remains."""
    lines = text.splitlines()
    *path, last = key.split(".")
    begin, end = _table(lines, path)
    for i in range(begin if begin is not None else end, end):
        if re.match(rf"\s*{re.escape(last)}\s*=", lines[i]):
            for after in range(i + 1, end + 1):
                new = "\n".join([*lines[:i], *lines[after:]]) + "\n"
                if _means(new, wanted):
                    return new
    return toml_text(wanted)


def _means(text: str, wanted: Mapping[str, Any]) -> bool:
    try:
        return tomllib.loads(text) == wanted
    except tomllib.TOMLDecodeError:
        return False


def value_text(value: Any) -> str:
    """Return a value as TOML on one line; tables are inline tables."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {value_text(one)}" for key, one in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(value_text, value)) + "]"
    return tomli_w.dumps({"value": value}).removeprefix("value = ").strip()


def _candidates(lines: list[str], path: list[str], value: Any) -> Any:
    """Yield changed lines, in the order in which they should be tried."""
    if isinstance(value, Mapping):
        yield _with_table(lines, path, value)
    for depth in range(len(path) - 1, -1, -1):
        begin, end = _table(lines, path[:depth])
        if begin is None:
            continue
        for i in range(begin, end):
            if re.match(rf"\s*{re.escape(path[depth])}\s*=", lines[i]):
                line = _replaced(lines[i], path[depth:], value)
                yield [*lines[:i], line, *lines[i + 1 :]]
                if depth == len(path) - 1 and isinstance(value, list):
                    for last in range(i + 1, end):
                        yield [*lines[:i], *_rows(path[-1], value), *lines[last + 1 :]]
        if depth == len(path) - 1:
            yield [*lines[:begin], f"{path[-1]} = {value_text(value)}", *lines[begin:]]


def _rows(key: str, value: list[Any]) -> list[str]:
    """Return a list, which was on several lines, with an entry on each line."""
    return [f"{key} = [", *(f"  {value_text(one)}," for one in value), "]"]


def _table(lines: list[str], path: list[str]) -> tuple[int | None, int]:
    """Return the lines of a table, without its header; None as begin if there is no header."""
    headers = [(i, found[1].strip()) for i, line in enumerate(lines)
               if (found := _HEADER.match(line))]  # fmt: skip
    begin = None if path else 0
    for i, name in headers:
        if begin is not None and i >= begin:
            return begin, i
        if name == ".".join(path):
            begin = i + 1
    return begin, len(lines)


def _replaced(line: str, path: list[str], value: Any) -> str:
    """Return a line ``a = …`` or ``a = { b = … }`` with another value of its last key."""
    place = 0
    for part in path:
        found = re.compile(rf"(?<![\w.-]){re.escape(part)}\s*=\s*").search(line, place)
        if found is None:
            return line
        place = found.end()
    old = re.compile(r"\{[^{}\n]*\}" if line[place:].startswith("{") else _VALUE).match(line, place)
    return line if old is None else line[:place] + value_text(value) + line[old.end() :]


def _with_table(lines: list[str], path: list[str], table: Mapping[str, Any]) -> list[str]:
    begin, end = _table(lines, path)
    if begin is None:
        return lines
    while end > begin and not lines[end - 1].strip():
        end -= 1
    rows = [f"{key} = {value_text(one)}" for key, one in table.items()]
    return [*lines[:begin], *rows, *lines[end:]]
