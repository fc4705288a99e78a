"""Reading files that nobody vouches for: JSON, TOML and text, with limits of size and depth.

:mod:`tomllib` needs memory for n² parts for a key of n parts. So keys with too many parts are refused
before the text is parsed.
"""

import json
import os
import re
import stat
import tomllib
from pathlib import Path

MOST_JSON_BYTES, MOST_TEXT_BYTES = 20 * 2**20, 4 * 2**20
MOST_LEVELS = 32
"""Most parts of a dotted key, and levels of nested tables and lists."""
TOO_DEEP = f"tables and lists lie within each other more than {MOST_LEVELS} levels deep"

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
_LONG_KEY = re.compile(rf"(?<![\w-])(?:[\w-]++[ \t]*+\.[ \t]*+){{{MOST_LEVELS}}}")
_UNBLOCKED = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)
"""So that a FIFO does not block."""


class TooLargeError(ValueError):
    """A text has too large numbers, too long keys, or is nested too deeply; the message says which."""


class UnreadableError(ValueError):
    """A file cannot be read; the message names it."""


def parse_toml(text: str) -> dict[str, object]:
    """Return the tables of a TOML text.

    Raises:
        TooLargeError: it exceeds a limit.
        tomllib.TOMLDecodeError: it is no TOML.
    """
    masked = _STRING.sub(lambda match: "" if match["comment"] else "_", text)
    if _LONG_KEY.search(masked):
        raise TooLargeError(f"a key has more than {MOST_LEVELS} parts")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise TooLargeError(TOO_DEEP) from None
    except tomllib.TOMLDecodeError:
        raise
    except ValueError:  # an integer has thousands of digits
        raise TooLargeError("an integer is too large") from None


def read_json(path: Path) -> dict[str, object]:
    """Return the table in a JSON file; raise UnreadableError if there is none."""
    try:
        found = json.loads(read_text(path, MOST_JSON_BYTES))
    except UnreadableError:
        raise
    except (ValueError, RecursionError):
        raise UnreadableError(f"{path}: not a JSON file") from None
    if not isinstance(found, dict):
        raise UnreadableError(f"{path}: not a table")
    return found


def read_toml(path: Path) -> dict[str, object]:
    """Return the tables in a TOML file; raise UnreadableError if there are none."""
    text = read_text(path, MOST_TEXT_BYTES)
    try:
        return parse_toml(text)
    except TooLargeError as error:
        raise UnreadableError(f"{path}: {error}") from None
    except ValueError:
        raise UnreadableError(f"{path}: not a TOML file") from None


def read_text(path: Path, most_bytes: int = MOST_TEXT_BYTES) -> str:
    """Return the text of a regular file.

    Raises:
        UnreadableError: it is no regular file, such as a FIFO or a device, is too large, or is no text.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | _UNBLOCKED)
        with os.fdopen(descriptor, "rb") as file:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise UnreadableError(f"{path}: not a regular file")
            content = file.read(most_bytes + 1)
    except OSError as error:
        raise UnreadableError(f"{path}: {error.strerror}") from None
    if len(content) > most_bytes:
        raise UnreadableError(f"{path}: larger than {most_bytes // 2**20} MiB")
    try:
        return content.decode()
    except ValueError:
        raise UnreadableError(f"{path}: not a text file") from None
