"""Changes one value in the text of a TOML file and keeps its comments.

The changed text is parsed and compared with what is wanted. If the value is not where this module
looks for it, the whole text is written anew, without comments.
"""

import copy
import re
import tomllib
from collections.abc import Mapping
from typing import Any

import tomli_w

from noack.config.scenario_file import put, toml_text

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
