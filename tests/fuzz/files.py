"""Files that parsers read, and dictionary words for the fuzzer."""

import json
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from tests.fuzz.edits import Vocabulary
from tests.fuzz.harness import FOLDER

NAMED: Mapping[str, bytes] = {
    "trace.txt": b"0100 1\n",
    "delays.txt": b"# delays\n0.01\n12.5ms\n",
    "table.dist": b"-8192 0 8192\n",
}
"""Files in the same folder as the input file."""


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
