"""What watches and changes a relay, at its side while it runs: options, threads, housekeeping."""

import argparse
import math
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from netem.control.command_queue import CommandQueue, Snapshot
from netem.control.control_server import ControlServer
from netem.control.emulator_statistics import statistics
from netem.control.live_screen import Screen
from netem.control.statistics_lines import StatisticsLines
from netem.engine.relay_interface import Relay
from noack.core.errors import CallerError, PeerError

_VIEW_S = 1.0
_LOOK_S = 0.05
_PATIENCE_S = 2.0
_SWITCH_S = 0.0002
"""How long another thread may keep the interpreter while the relay's wants it."""


class Options(NamedTuple):
    """How a relay is watched and changed."""

    name: str | None = None
    """Under which it can be reached while it runs; None: not at all."""
    stats_s: float | None = None
    """Between two lines of statistics; None for no lines."""
    stats_file: Path | None = None
    """Where the lines go; None: to the standard output."""
    view: bool = False
    """Show it in the terminal."""

    @property
    def takes_output(self) -> bool:
        """Whether the standard output is a view's, or of lines of statistics."""
        return self.view or (self.stats_s is not None and self.stats_file is None)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options on watching a relay to a command line."""
    group = parser.add_argument_group("to watch it, and change it while it runs")
    group.add_argument(
        "--control", metavar="NAME", help="let `noack netem show|set|watch NAME` reach it"
    )
    group.add_argument(
        "--stats", metavar="SECONDS", type=float, help="print statistics as JSON lines, so often"
    )
    group.add_argument("--stats-file", metavar="FILE", help="write them there instead")
    group.add_argument("--view", action="store_true", help="show it live in this terminal")


def options_of(parsed: argparse.Namespace) -> Options:
    """Return what the options of :func:`add_options` say.

    Raises:
        CallerError: they do not go together.
    """
    stats_s, file = parsed.stats, parsed.stats_file
    if stats_s is not None and not (math.isfinite(stats_s) and stats_s >= 0.01):
        raise CallerError(f"--stats {stats_s:g}: must be 0.01 s or more")
    if file is not None and stats_s is None:
        stats_s = 1.0
    if parsed.view and stats_s is not None and file is None:
        raise CallerError("--view and --stats both want the terminal; give --stats-file FILE")
    return Options(parsed.control, stats_s, Path(file) if file is not None else None, parsed.view)


class AttachedTaps:
    """What the relay's thread has to know of those at its side."""

    def __init__(self, commands: CommandQueue) -> None:
        self._errands = commands
        self.left = False
        """Whether the person at the terminal wants to end."""

    def look(self) -> Snapshot:
        """What has happened; in the relay's thread, or when the relay has ended."""
        return self._errands.look()

    def housekeeping(self) -> None:
        """Serve them; called in the relay's thread at least every 50 ms."""
        self._errands.run()


@contextmanager
def attached(relay: Relay, options: Options) -> Iterator[AttachedTaps]:
    """Watch a relay while the context lasts, in which it runs; it is closed after that.

    Enter before the relay's thread takes real-time settings, which new threads would inherit.

    Raises:
        CallerError: an option is wrong.
        MachineError: the live control cannot be opened.
    """
    commands = CommandQueue(relay)
    side = AttachedTaps(commands)
    with ExitStack() as stack:
        if options.stats_s is not None:
            stack.enter_context(StatisticsLines(commands, options.stats_s, options.stats_file))
        if options.name is not None:
            stack.enter_context(ControlServer(options.name, commands))
        if options.view:
            stack.enter_context(_view(commands, side, options.name))
        stack.callback(commands.close)
        stack.enter_context(_short_turns())
        yield side


@contextmanager
def _view(commands: CommandQueue, side: AttachedTaps, name: str | None) -> Iterator[None]:
    stopping = threading.Event()
    with Screen(f"noack netem {name}" if name is not None else "noack netem") as screen:

        def run() -> None:
            before: Snapshot | None = None
            due_s = time.monotonic()
            while not stopping.wait(_LOOK_S):
                side.left = screen.look()
                if time.monotonic() < due_s:
                    continue
                due_s = max(due_s + _VIEW_S, time.monotonic())
                with suppress(PeerError):
                    snapshot = commands.snapshot()
                    screen.show(statistics(snapshot, before))
                    before = snapshot

        thread = threading.Thread(target=run, name="view", daemon=True)
        thread.start()
        try:
            yield
        finally:
            stopping.set()
            thread.join(_PATIENCE_S)


@contextmanager
def _short_turns() -> Iterator[None]:
    before = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)
