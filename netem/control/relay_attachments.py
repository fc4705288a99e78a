"""Live control, statistics lines and the live screen of a running relay."""

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
from netem.control.emulator_statistics import Statistics
from netem.control.live_screen import Screen
from netem.control.statistics_thread import StatisticsThread
from netem.engine.relay import Relay
from netem.standard_error import say
from noack.core.errors import CallerError, why
from noack.core.file_access import open_growing
from noack.runtime.address import text_of
from noack.runtime.command_line import LogFormat
from noack.runtime.metrics_server import OPTION, metrics_server, require_package

_VIEW_S = 1.0
_POLL_S = 0.05
_SWITCH_S = 0.0002
"""Maximum time for which another thread holds the interpreter lock before the relay's thread."""


class Options(NamedTuple):
    """Options for watching and changing a relay."""

    name: str | None = None
    """Name for live control; None: no live control."""
    stats_s: float | None = None
    """Time between two lines of statistics; None: no lines."""
    stats_file: Path | None = None
    """File for the lines; None: standard output."""
    metrics: str | None = None
    """Address of the metrics; None: no metrics."""
    view: bool = False
    """Show live statistics in the terminal."""

    @property
    def takes_output(self) -> bool:
        """Whether the live screen or the lines of statistics use standard output."""
        return self.view or (self.stats_s is not None and self.stats_file is None)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for watching and changing a relay to a command line."""
    group = parser.add_argument_group("statistics and changes during operation")
    group.add_argument(
        "--control", metavar="NAME", help="accept `noack netem show|set|watch NAME`"
    )  # fmt: skip
    group.add_argument(
        "--stats", metavar="SECONDS", type=float,
        help="print statistics as JSON lines every SECONDS",
    )  # fmt: skip
    group.add_argument("--stats-file", metavar="FILE", help="write these lines to FILE instead")
    group.add_argument(
        OPTION, metavar="[HOST]:PORT",
        help="serve the statistics for Prometheus (OpenMetrics); the loopback without a HOST",
    )  # fmt: skip
    group.add_argument(
        "--log-format", choices=[*LogFormat], type=LogFormat, default=LogFormat.TEXT,
        help="format of standard error: text, or JSON Lines for log collectors (text)",
    )  # fmt: skip
    group.add_argument("--view", action="store_true", help="show live statistics in this terminal")


def options_of(parsed: argparse.Namespace) -> Options:
    """Return the options of :func:`add_options`.

    Raises:
        CallerError: two options contradict each other.
    """
    stats_s, file = parsed.stats, parsed.stats_file
    if stats_s is not None and not (math.isfinite(stats_s) and stats_s >= 0.01):
        raise CallerError(f"--stats {stats_s:g}: must be 0.01 s or more")
    if file is not None and stats_s is None:
        stats_s = 1.0
    if parsed.view and stats_s is not None and file is None:
        raise CallerError("--view and --stats both use standard output; add --stats-file FILE")
    path = Path(file) if file is not None else None
    return Options(parsed.control, stats_s, path, parsed.metrics, parsed.view)


class AttachedRelay(NamedTuple):
    """The relay thread's access to the threads that watch the relay."""

    commands: CommandQueue
    """To be run in the relay's thread, at least every 50 ms."""
    screen: Screen | None

    @property
    def quit_requested(self) -> bool:
        """Whether the user has pressed q on the live screen."""
        return self.screen is not None and self.screen.quit_requested


@contextmanager
def attached(relay: Relay, options: Options) -> Iterator[AttachedRelay]:
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
        if options.stats_s is not None:
            stack.enter_context(_statistics_lines(commands, options.stats_s, options.stats_file))
        if options.metrics is not None:
            stack.enter_context(_metrics(commands, options.metrics))
        if options.name is not None:
            stack.enter_context(ControlServer(options.name, commands))
        if options.view:
            title = "noack netem" if options.name is None else f"noack netem {options.name}"
            screen = stack.enter_context(Screen(title))
            stack.enter_context(
                StatisticsThread(commands, _VIEW_S, screen.show, poll=screen.poll, poll_s=_POLL_S)
            )
        stack.callback(commands.close)
        stack.callback(sys.setswitchinterval, sys.getswitchinterval())
        sys.setswitchinterval(_SWITCH_S)
        yield AttachedRelay(commands, screen)


@contextmanager
def _metrics(commands: CommandQueue, where: str) -> Iterator[None]:
    """Serve metrics within the context."""
    require_package()
    from netem.control.emulator_metrics import EmulatorMetrics

    with metrics_server(where, EmulatorMetrics(commands).collect) as address:
        say(f"metrics: http://{text_of(address)}/metrics")
        yield


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
            say(f"statistics cannot be written to {name} ({error.strerror}); the relay continues")
            # Also, closing the file writes the buffer once more; this must not fail.
            nothing = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nothing, file.fileno())
            os.close(nothing)

    try:
        with StatisticsThread(commands, period_s, write, at_end=True):
            yield
    finally:
        if path is not None:
            file.close()
