"""Shared by all programs of noack: errors as text and JSON, JSON Lines on standard error, signals.

As JSON Lines, for log collectors, each line of text is an object with ``time`` (UTC), ``level``
(info, warning, error), ``source`` (the program, e.g. ``noack-netem``) and ``message``. An event has
also its name, ``event``, and its numbers.

A signal that ends a program is a flag that loops poll, an error elsewhere, an exit in the imports.
In the loop of a process no write may be interrupted. A command is interrupted by an error, so that
it cleans up. During the imports an error would be printed from within them, or caught there.
"""

import argparse
import atexit
import io
import json
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn, TextIO

from netem.core.errors import CallerError, ExitStatus, MachineError, printable, why, with_short_words

if TYPE_CHECKING:
    from _typeshed import SupportsWrite

_LINE = re.compile(r"(?P<source>noack(?:[ -][a-z]+)*): (?P<warning>warning: )?(?P<message>.*)")
_COLOURS = re.compile(r"\x1b\[[0-9;]*m")
_ECHO_NS = 500_000_000  # a parent may pass on a signal that the process group has received already
_HANGUP: int | None = getattr(signal, "SIGHUP", None)  # not on Windows
_ENDING: dict[int, tuple[ExitStatus, str]] = {  # exit status and reason after a signal
    signal.SIGINT.value: (ExitStatus.INTERRUPTED, "stopped by the user"),
    signal.SIGTERM.value: (ExitStatus.TERMINATED, "stopped on request"),
}
if _HANGUP:
    _ENDING[_HANGUP] = ExitStatus.TERMINATED, "stopped because the terminal was closed"
END_SIGNALS = tuple(signal.Signals(number).name for number in _ENDING)
"""Names of the signals that end a program."""


def netem_program() -> str:
    """Return how the user of this process calls the emulator: by its own command, or that of noack."""
    return "noack netem" if _program() == "noack" else "noack-netem"


def _program() -> str:
    return Path(sys.argv[0]).name if sys.argv else ""


class LogFormat(StrEnum):
    """Formats of the log on standard error."""

    TEXT = "text"
    JSONL = "jsonl"


class JsonLog(io.TextIOBase):
    """A text stream that writes a JSON object for each line to another stream.

    Raise OSError if the other stream cannot be written.
    """

    encoding = "utf-8"

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._unfinished = threading.local()
        self._lock = threading.Lock()

    def write(self, text: str, /) -> int:
        """Write text; a line is written when it is complete."""
        *lines, unfinished = (getattr(self._unfinished, "text", "") + text).split("\n")
        self._unfinished.text = unfinished
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

    def log(self, level: str, source: str, message: str, **fields: object) -> None:
        """Write an object; a number that is not finite becomes null."""
        from pydantic_core import to_json  # only for logs as JSON Lines

        now = datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        content = {"time": now, "level": level, "source": source, "message": printable(message)}
        line = to_json(content | fields, inf_nan_mode="null", fallback=str).decode()
        with self._lock:
            self._stream.write(line + "\n")
            self._stream.flush()

    def _log_line(self, line: str) -> None:
        match = _LINE.fullmatch(line)
        if match is None:
            self.log("info", "noack", line)
        else:
            self.log("warning" if match["warning"] else "info", match["source"], match["message"])


@contextmanager
def log_format(log_as: LogFormat) -> Iterator[None]:
    """Write standard error in a format within the context."""
    stream = sys.stderr
    if log_as is LogFormat.TEXT or stream is None or isinstance(stream, JsonLog):
        yield
        return
    sys.stderr = JsonLog(stream)
    try:
        yield
    finally:
        sys.stderr = stream


def log_event(level: str, source: str, message: str, **fields: object) -> bool:
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


class _StoreOnce(argparse.Action):
    """The value of an option, which may be given once; argparse's own keeps the last one."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: object,
        option_string: str | None = None,
    ) -> None:
        """Store the values."""
        assert isinstance(parser, Parser)
        if option_string is not None and self.dest in parser.given_options:
            raise argparse.ArgumentError(self, "is given twice; it takes one value")
        parser.given_options.add(self.dest)
        setattr(namespace, self.dest, values)


class Parser(argparse.ArgumentParser):
    """A parser that raises errors instead of printing usage and exiting; an option is given once."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.given_options = set[str]()
        for action in (None, "store"):
            self.register("action", action, _StoreOnce)

    def parse_known_args(self, *args: Any, **options: Any) -> Any:
        """Parse the words; the arguments are those of :class:`argparse.ArgumentParser`."""
        self.given_options.clear()
        return super().parse_known_args(*args, **options)

    def error(self, message: str) -> NoReturn:
        """Raise CallerError."""
        mistake = message.removeprefix("argument ")
        raise CallerError(f"{mistake}; see `{self.prog} --help`")

    def print_help(self, file: "SupportsWrite[str] | None" = None) -> None:
        """Print the help; unlike that of the base class, it raises MachineError on a full disk."""
        try:
            print(self.format_help(), end="", file=file)
            if file is None:
                sys.stdout.flush()
        except BrokenPipeError:  # its reader has seen enough
            discard_output(sys.stdout.fileno())
        except OSError as error:
            raise MachineError(f"cannot write: {why(error)}") from None


def report_failure(message: str, status: ExitStatus, *, source: str, as_json: bool) -> ExitStatus:
    """Print why a command failed, one line per mistake, and return its exit status.

    Each line begins with ``source``, such as ``noack-netem``. With ``as_json`` a JSON document is
    also printed to standard output. Very long words, which the message quotes, are cut off.
    """
    message = with_short_words(message)
    with suppress(OSError):  # standard output may be closed or full
        if as_json and sys.stdout is not None:
            reason = {"status": int(status), "reason": message}
            print(json.dumps({"error": message, "exit": reason}, indent=2), flush=True)
    for line in message.splitlines():
        if not log_event("error", source, line):
            print_to_stderr(f"{source}: {line}")
    return status


def why_not_written(error: Exception) -> str | None:
    """Return why standard output cannot be written; None if this is another error."""
    if not isinstance(error, OSError):
        return None
    try:
        folder_exists = Path.cwd().is_dir()
    except OSError:
        folder_exists = False
    if error.filename is not None:  # not of standard output
        return f"{error.filename}: {why(error)}"
    return f"cannot write: {why(error)}" if folder_exists else "the current folder was deleted"


def discard_output(descriptor: int) -> None:
    """Replace an output that fails by the null device; what is still buffered goes there, too."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, descriptor)
    os.close(null)


def print_to_stderr(line: str) -> None:
    """Print a line; ignore a closed pipe and a full disk."""
    if sys.stderr is not None:
        with suppress(OSError, ValueError):  # full or broken pipe; closed
            print(line, file=sys.stderr, flush=True)


class Signals:
    """Turns signals into a flag; a loop ends when it polls the flag."""

    def __init__(self) -> None:
        self.received: int | None = None
        self._received_ns = 0

    @contextmanager
    def handled(self) -> Iterator["Signals"]:
        """Handle the signals while the context lasts; under nohup, SIGHUP stays ignored."""
        handled = set(_ENDING)
        if _HANGUP and signal.getsignal(_HANGUP) == signal.SIG_IGN:
            handled.remove(_HANGUP)
        handlers = {number: signal.signal(number, self._note) for number in handled}
        try:
            yield self
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)

    def _note(self, number: int, _frame: FrameType | None) -> None:
        now_ns = time.monotonic_ns()
        if self.received is None:
            self.received, self._received_ns = number, now_ns
        elif now_ns - self._received_ns > _ECHO_NS:  # a second request: end at once
            raise SystemExit(self.status)

    @property
    def status(self) -> ExitStatus:
        """Exit status for the received signal, or OK."""
        return ExitStatus.OK if self.received is None else _ENDING[self.received][0]


def stop_reason(number: int) -> str:
    """Return why a program stops after a signal, with the signal's name."""
    return f"{_ENDING[number][1]} ({signal.Signals(number).name})"


class StopRequestError(KeyboardInterrupt):
    """A signal asks the program to stop: what cleans up after Ctrl-C does so after each of them."""

    def __init__(self, number: int = signal.SIGINT) -> None:
        super().__init__(stop_reason(number))
        self.exit_status, _ = _ENDING[number]


@contextmanager
def stop_requests_raised() -> Iterator[None]:
    """Raise StopRequestError on SIGINT, SIGTERM and SIGHUP while the context lasts.

    Ignored signals stay ignored, and a handler that another program has set is not replaced.
    """
    came_ns: int | None = None

    def stop(number: int, _frame: FrameType | None) -> None:
        nonlocal came_ns
        now_ns = time.monotonic_ns()
        if came_ns is None or now_ns - came_ns > _ECHO_NS:
            came_ns = now_ns
            raise StopRequestError(number)

    with _default_replaced(stop):
        yield


@contextmanager
def stoppable_imports() -> Iterator[None]:
    """End the process with one line and its exit status on a signal, while the context lasts."""
    with _default_replaced(_end_at_once):
        yield


def stoppable_until_exit() -> None:
    """End the process with one line and its exit status on a signal, until it has done everything.

    In its last moments, when Python cleans up, it ignores signals: its exit status is decided.
    """
    if threading.current_thread() is threading.main_thread():
        atexit.register(_ignore_signals)
        for number in _ENDING:
            if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
                signal.signal(number, _end_at_once)


def _ignore_signals() -> None:
    for number in _ENDING:
        signal.signal(number, signal.SIG_IGN)


def _end_at_once(number: int, _frame: FrameType | None) -> None:
    with suppress(OSError):  # standard error may be closed or full
        program = "noack-netem" if _program() == "noack-netem" else "noack"
        os.write(2, f"{program}: {stop_reason(number)}\n".encode())
    os._exit(_ENDING[number][0])


@contextmanager
def _default_replaced(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    usual = (signal.SIG_DFL, signal.default_int_handler, _end_at_once)
    handlers = {number: signal.getsignal(number) for number in _ENDING}
    replaced = {number: previous for number, previous in handlers.items() if previous in usual}
    for number in replaced:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, previous in replaced.items():
            signal.signal(number, previous)
