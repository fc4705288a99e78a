"""What watches and changes a relay while it runs: control, statistics lines, the live screen.

:func:`add_watching_options` declares the options, :func:`watch_relay` starts what they ask for.
"""

import argparse
import json
import math
import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

from netem.control.command_queue import CommandQueue
from netem.control.control_server import ControlServer
from netem.control.emulator_statistics import Statistics, StatisticsThread
from netem.control.statistics_view import Screen
from netem.relay.relay import Relay
from netem.relay.relay_reports import report_line
from noack.core.errors import CallerError, why
from noack.core.file_access import open_growing
from noack.runtime.command_line import LogFormat, discard_output

_VIEW_S = 1.0
_POLL_S = 0.05
_SWITCH_S = 0.0002
"""Maximum time for which another thread holds the interpreter lock before the relay's thread."""


def add_watching_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for what watches and changes a relay while it runs."""
    group = parser.add_argument_group("statistics and changes during operation")
    group.add_argument("--control", metavar="NAME", help="accept `noack netem show|set|watch NAME`")
    group.add_argument(
        "--stats",
        metavar="SECONDS",
        type=float,
        help="print statistics as JSON lines every SECONDS",
    )
    group.add_argument("--stats-file", metavar="FILE", type=Path, help="write these lines to FILE instead")
    group.add_argument(
        "--log-format",
        choices=[*LogFormat],
        type=LogFormat,
        default=LogFormat.TEXT,
        help="format of standard error: text, or JSON Lines for log collectors (text)",
    )
    group.add_argument("--view", action="store_true", help="show live statistics in this terminal")


def check_watching_options(options: argparse.Namespace) -> None:
    """Check the options of :func:`add_watching_options`; a file alone gets a line each second.

    Raises:
        CallerError: two options contradict each other.
    """
    if options.stats is not None and not (math.isfinite(options.stats) and options.stats >= 0.01):
        raise CallerError(f"--stats {options.stats:g}: must be 0.01 s or more")
    if options.stats is None and options.stats_file is not None:
        options.stats = 1.0
    if options.view and options.stats is not None and options.stats_file is None:
        raise CallerError("--view and --stats both use standard output; add --stats-file FILE")


class RelayWatch(NamedTuple):
    """The relay thread's access to the threads that watch the relay."""

    commands: CommandQueue
    """To be run in the relay's thread, at least every 50 ms."""
    screen: Screen | None

    @property
    def quit_requested(self) -> bool:
        """Whether the user has pressed q on the live screen."""
        return self.screen is not None and self.screen.quit_requested


@contextmanager
def watch_relay(relay: Relay, options: argparse.Namespace) -> Iterator[RelayWatch]:
    """Watch a relay within the context; the relay runs within it and is closed after it.

    Enter the context before the relay's thread applies real-time settings: new threads would
    inherit them.

    Raises:
        CallerError: an option is wrong.
        MachineError: live control cannot be opened.
    """
    commands = CommandQueue(relay)
    screen = None
    with ExitStack() as stack:
        if options.stats is not None:
            stack.enter_context(_statistics_lines(commands, options.stats, options.stats_file))
        if options.control is not None:
            stack.enter_context(ControlServer(options.control, commands))
        if options.view:
            screen = stack.enter_context(Screen(f"noack netem {options.control or ''}".strip()))
            stack.enter_context(
                StatisticsThread(commands, _VIEW_S, screen.show, poll=screen.poll, poll_s=_POLL_S)
            )
        stack.callback(commands.close)
        stack.callback(sys.setswitchinterval, sys.getswitchinterval())
        sys.setswitchinterval(_SWITCH_S)
        yield RelayWatch(commands, screen)


@contextmanager
def _statistics_lines(commands: CommandQueue, period_s: float, path: Path | None) -> Iterator[None]:
    """Write JSON lines to a file, or to standard output, until the relay has ended.

    If a line cannot be written, a message on standard error reports it, and the relay continues.
    """
    try:
        file = sys.stdout if path is None else os.fdopen(open_growing(path, follow=True), "w")
    except (OSError, ValueError) as error:
        raise CallerError(f"--stats-file {path}: cannot be written ({why(error)})") from None

    def write(document: Statistics) -> None:
        try:
            file.write(json.dumps(document) + "\n")
            file.flush()
        except OSError as error:
            name = "standard output" if path is None else path
            report_line(f"statistics cannot be written to {name} ({error.strerror}); the relay continues")
            # Also, closing the file writes the buffer once more; this must not fail.
            discard_output(file.fileno())

    try:
        with StatisticsThread(commands, period_s, write, at_end=True):
            yield
    finally:
        if path is not None:
            file.close()
