"""The live screen: a full-screen view on a terminal, lines of text or JSON on other outputs."""

import contextlib
import io
import json
import os
import select
import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Self

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from netem.control.emulator_statistics import Statistics
from netem.control.statistics_view import History, plain_lines, render

_MESSAGES_SHOWN = 3


class Screen:
    """Shows statistics within the context; the last picture remains afterwards.

    Messages on standard error are shown below the picture, and written at the end. With ``as_json``
    it prints each document as a line of JSON instead.
    """

    def __init__(self, title: str, *, as_json: bool = False) -> None:
        self._title = title
        self._as_json = as_json
        self._console = Console()
        self._history = History()
        self._live: Live | None = None
        self._size = self._console.size
        self._messages = io.StringIO()
        self._keys = False
        self._stack = ExitStack()
        self.quit_requested = False
        """Whether the user has pressed q."""

    def __enter__(self) -> Self:
        if self._console.is_terminal and not self._console.is_dumb_terminal and not self._as_json:
            live = Live(
                console=self._console, screen=True, auto_refresh=False,
                redirect_stdout=False, redirect_stderr=False,
            )  # fmt: skip
            with ExitStack() as stack:
                stack.callback(self._leave)
                stack.enter_context(contextlib.redirect_stderr(self._messages))
                self._keys = stack.enter_context(_single_keys())
                self._live = stack.enter_context(live)
                self._stack = stack.pop_all()
            self._draw()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def show(self, statistics: Statistics) -> None:
        """Show new statistics."""
        if self._as_json:
            print(json.dumps(statistics), flush=True)
        elif self._live is None:
            print("\n".join(plain_lines(statistics)), flush=True)
        else:
            self._history.add(statistics)
            self._draw()

    def poll(self) -> None:
        """Read the keyboard, and draw again if the terminal's size has changed."""
        while self._keys and select.select([sys.stdin], (), (), 0)[0]:
            keys = os.read(sys.stdin.fileno(), 64)
            self._keys = bool(keys)
            self.quit_requested |= b"q" in keys.lower()
        if self._live is not None and self._console.size != self._size:
            self._size = self._console.size
            self._draw()

    def _draw(self) -> None:
        assert self._live is not None
        messages = self._messages.getvalue().splitlines()[-_MESSAGES_SHOWN:]
        height = self._console.height - len(messages) - 1
        picture = render(self._history, self._title, self._console.width, height)
        below = [Text(f" {message}", "yellow", no_wrap=True) for message in messages]
        help_line = Text(" q ends" if self._keys else " Ctrl-C ends", "dim")
        self._live.update(Group(picture, *below, help_line), refresh=True)

    def _leave(self) -> None:
        if self._history.latest is not None:
            self._console.print(render(self._history, self._title, self._console.width, None))
        print(self._messages.getvalue(), end="", file=sys.stderr)


@contextlib.contextmanager
def _single_keys() -> Iterator[bool]:
    """Read keys at once and without echo; yield whether there is a keyboard."""
    if not sys.stdin.isatty():
        yield False
        return
    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    try:
        yield True
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
