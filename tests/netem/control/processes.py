"""Real emulators in separate processes, and terminals."""

import os
import pty
import select
import sys
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

_PATIENCE_S = 60.0


def read_until(descriptor: int, done: Callable[[str], bool]) -> str:
    """Read text until ``done(text)`` is true; return the text."""
    text = b""
    deadline_s = time.monotonic() + _PATIENCE_S
    while not done(text.decode(errors="replace")):
        ready, _, _ = select.select([descriptor], (), (), deadline_s - time.monotonic())
        more = os.read(descriptor, 65_536) if ready else b""
        assert more, f"no more than this: {text.decode(errors='replace')}"
        text += more
    return text.decode(errors="replace")


@contextmanager
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """A terminal as standard input and output; yield the user's side of it."""
    user, end = pty.openpty()
    termios.tcsetwinsize(end, (24, 80))
    before = termios.tcgetattr(end)
    monkeypatch.setenv("TERM", "xterm-256color")
    with os.fdopen(os.dup(end)) as stdin, os.fdopen(os.dup(end), "w") as stdout:
        monkeypatch.setattr(sys, "stdin", stdin)
        monkeypatch.setattr(sys, "stdout", stdout)
        yield user
    assert termios.tcgetattr(end) == before
    os.close(user)
    os.close(end)


def press_q(terminal: int, *drawn: str) -> str:
    """Wait until a terminal shows some texts, and press q; return what it has shown."""
    text = read_until(terminal, lambda text: all(part in text for part in drawn))
    os.write(terminal, b"q")
    return text
