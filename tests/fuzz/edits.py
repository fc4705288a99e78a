"""Edit valid content: put the parser's own keys and values in wrong places."""

import copy
import datetime
import json
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from tests.fuzz.choices import Choices
from tests.fuzz.harness import FOLDER

NAMED: Mapping[str, bytes] = {
    "trace.txt": b"0100 1\n",
    "delays.txt": b"# delays\n0.01\n12.5ms\n",
    "table.dist": b"-8192 0 8192\n",
}
"""Files in the same folder as the input file."""


class Vocabulary(NamedTuple):
    """Keys and values that edits insert."""

    keys: Sequence[str]
    words: Sequence[str]
    dates: bool = False
    """Whether the format has dates and no null, as TOML does."""


def vocabulary(schema: Mapping[str, Any], *, dates: bool = False) -> Vocabulary:
    """Return the keys and constant strings of a JSON Schema, in order."""
    keys, words = dict[str, None](), dict[str, None]()
    parts: list[Any] = [schema]
    while parts:
        part = parts.pop(0)
        if isinstance(part, Mapping):
            keys |= dict.fromkeys(part.get("properties", {}))
            constants = [part.get("const"), part.get("default"), *part.get("enum", ())]
            words |= dict.fromkeys(one for one in constants if isinstance(one, str))
            parts += part.values()
        elif isinstance(part, list):
            parts += part
    return Vocabulary(tuple(keys), tuple(words), dates)


def edited(choices: Choices, tree: Any, known: Vocabulary, most: int = 6) -> Any:
    """Return a copy of a tree of dicts and lists with some edits."""
    root = {"": copy.deepcopy(tree)}
    for _ in range(choices.below(most)):
        _edit(choices, root[""], known)
    return root[""]


def value(choices: Choices, known: Vocabulary, depth: int = 0) -> Any:
    """Return a value of any type."""
    match choices.below(9 if depth < 3 else 6):
        case 0:
            return choices.integer()
        case 1:
            return choices.real()
        case 2:
            return choices.flag()
        case 3:
            return choices.one(known.words) if known.words else ""
        case 4:
            return choices.text()
        case 5:
            return datetime.date(1970, 1, 1) if known.dates else None
        case 6:
            return [value(choices, known, depth + 1) for _ in range(choices.below(4))]
        case 7:
            return {
                key(choices, known): value(choices, known, depth + 1)
                for _ in range(choices.below(4))
            }
        case _:
            nested: Any = value(choices, known, depth + 1)
            for _ in range(choices.below(20)):
                nested = [nested]
            return nested


def key(choices: Choices, known: Vocabulary) -> str:
    """Return a key of the format or any other key."""
    return choices.one(known.keys) if known.keys and choices.below(8) else choices.text()


def _edit(choices: Choices, tree: Any, known: Vocabulary) -> None:
    places = list(_containers(tree))
    if not places:
        return
    container = choices.one(places)
    at: Any
    if isinstance(container, dict):
        at = choices.one(list(container)) if container and choices.below(3) else key(choices, known)
    elif container:
        at = choices.below(len(container))
    else:
        container.append(value(choices, known))
        return
    match choices.below(5):
        case 0 | 1:
            container[at] = value(choices, known)
        case 2:
            container[at] = copy.deepcopy(choices.one(places))
        case 3 if isinstance(container, list):
            container.insert(at, copy.deepcopy(container[at]))
        case _ if isinstance(container, dict):
            container.pop(at, None)
        case _:
            del container[at]


def _containers(tree: Any) -> Any:
    """Return the tables and lists of a tree; of a long list, only the first entries."""
    if isinstance(tree, dict):
        yield tree
        for one in tree.values():
            yield from _containers(one)
    elif isinstance(tree, list):
        yield tree
        for one in tree[:4]:
            yield from _containers(one)


def write_named(folder: Path, name: str, data: bytes) -> Path:
    """Write a file into a folder, together with the files that it may name."""
    _named(folder)
    path = folder / name
    path.write_bytes(data)
    return path


@cache
def _named(folder: Path) -> None:
    for name, data in NAMED.items():
        (folder / name).write_bytes(data)


def bases(folder: str, *more: Mapping[str, Any]) -> Sequence[Mapping[str, Any]]:
    """Return the content of the shipped TOML files of a folder, and ``more``."""
    paths = sorted((FOLDER.parents[1] / folder).glob("*.toml"))
    return [*(tomllib.loads(path.read_text(encoding="utf-8")) for path in paths), *more]


def quoted(known: Vocabulary) -> Sequence[bytes]:
    """Return plain keys, quoted words and some numbers, for a fuzzer that makes text."""
    words: Iterable[str] = (*known.keys, *(json.dumps(word) for word in known.words))
    return [word.encode() for word in (*words, "1e400", "nan", "-inf", "[[", "]]", "{", "}", "=")]
