"""Standard error as JSON Lines, for log collectors: one object for each line of text.

Each object has ``time`` (UTC), ``level`` (info, warning, error), ``source`` (the program, e.g.
``noack netem``) and ``message``. An event has also its name, ``event``, and its numbers.
"""

import io
import re
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from enum import StrEnum
from typing import Any, TextIO

from noack.core.errors import printable

_LINE = re.compile(r"(?P<source>noack(?: [a-z]+)?): (?P<warning>warning: )?(?P<message>.*)")
_COLOURS = re.compile(r"\x1b\[[0-9;]*m")


class LogFormat(StrEnum):
    """Formats of the log on standard error."""

    TEXT = "text"
    JSONL = "jsonl"


class JsonLog(io.TextIOBase):
    """A text stream that writes a JSON object for each line to another stream.

    Raises:
        OSError: the other stream cannot be written.
    """

    encoding = "utf-8"

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._unfinished = threading.local()
        self._lock = threading.Lock()

    def write(self, text: str, /) -> int:
        """Write text; a line is written when it is complete."""
        *lines, rest = (getattr(self._unfinished, "text", "") + text).split("\n")
        self._unfinished.text = rest
        for line in lines:
            if line.strip():
                self._log_line(_COLOURS.sub("", line).strip())
        return len(text)

    def flush(self) -> None:
        """Flush the other stream."""
        self._stream.flush()

    def fileno(self) -> int:
        """Return the descriptor of the other stream."""
        return self._stream.fileno()

    def writable(self) -> bool:
        """Return whether the stream can be written."""
        return True

    def log(self, level: str, source: str, message: str, **fields: Any) -> None:
        """Write an object; a number that is not finite becomes null."""
        from pydantic_core import to_json

        now = datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        content = {"time": now, "level": level, "source": source, "message": printable(message)}
        line = to_json(content | fields, inf_nan_mode="null", fallback=str).decode()
        with self._lock:
            self._stream.write(line + "\n")
            self._stream.flush()

    def _log_line(self, line: str) -> None:
        found = _LINE.fullmatch(line)
        if found is None:
            self.log("info", "noack", line)
        else:
            self.log("warning" if found["warning"] else "info", found["source"], found["message"])


@contextmanager
def log_format(wanted: LogFormat) -> Iterator[None]:
    """Write standard error in a format within the context."""
    before = sys.stderr
    if wanted is LogFormat.TEXT or before is None or isinstance(before, JsonLog):
        yield
        return
    sys.stderr = JsonLog(before)
    try:
        yield
    finally:
        sys.stderr = before


def log_event(level: str, source: str, message: str, **fields: Any) -> bool:
    """Write an event if standard error is JSON Lines; return whether it is.

    A full disk or a closed pipe is ignored.
    """
    stream = sys.stderr
    if not isinstance(stream, JsonLog):
        return False
    try:
        stream.log(level, source, message, **fields)
    except (OSError, ValueError):
        return True
    return True
