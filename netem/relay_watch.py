"""What watches and changes a relay while it runs: control, and lines of statistics.

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
from typing import TYPE_CHECKING, NamedTuple

from netem.control.command_queue import CommandQueue
from netem.control.emulator_statistics import Statistics, StatisticsThread
from netem.core.command_line import LogFormat, discard_output, netem_program
from netem.core.errors import CallerError, why
from netem.core.file_access import open_growing
from netem.relay.relay import Relay
from netem.relay.relay_reports import report_line

if TYPE_CHECKING:
    from netem.control.control_server import ControlAddresses

_SWITCH_S = 0.0002
"""Maximum time for which another thread holds the interpreter lock before the relay's thread."""


def add_watching_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for what watches and changes a relay while it runs."""
    group = parser.add_argument_group("statistics and changes during operation")
    group.add_argument(
        "--control", metavar="NAME", help=f"accept `{netem_program()} show|set|watch NAME`, and HTTP"
    )
    group.add_argument(
        "--control-port",
        metavar="PORT",
        type=int,
        help="with --control: also accept HTTP with a token at 127.0.0.1:PORT; 0 takes a free port",
    )
    group.add_argument(
        "--control-token",
        metavar="FILE",
        type=Path,
        help="the token of that port (by default that in NOACK_NETEM_TOKEN, else a new one in NAME.token)",
    )
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


def check_watching_options(options: argparse.Namespace) -> None:
    """Check the options of :func:`add_watching_options`; a file alone gets a line each second.

    Raises:
        CallerError: the time between two lines is too short, a port is wrong, or an option is missing.
    """
    if options.control_token is not None and options.control_port is None:
        raise CallerError(f"--control-token {options.control_token}: also needs --control-port PORT")
    if options.control_port is not None and options.control is None:
        raise CallerError(f"--control-port {options.control_port}: also needs --control NAME")
    if options.control_port is not None and not 0 <= options.control_port <= 65535:
        raise CallerError(f"--control-port {options.control_port}: expected 0 to 65535")
    if options.stats is not None and not (math.isfinite(options.stats) and options.stats >= 0.01):
        raise CallerError(f"--stats {options.stats:g}: must be 0.01 s or more")
    if options.stats is None and options.stats_file is not None:
        options.stats = 1.0


class RelayWatch(NamedTuple):
    """What watches a relay."""

    commands: CommandQueue
    """The commands of the threads that watch it, to be run in the relay's thread at least every 50 ms."""
    control: "ControlAddresses | None"
    """Where requests are accepted, with ``--control``."""


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
    with ExitStack() as stack:
        if options.stats is not None:
            stack.enter_context(_statistics_lines(commands, options.stats, options.stats_file))
        control = None
        if options.control is not None:
            from netem.control.control_server import TcpAccess, control_server  # the relay starts without it

            port = options.control_port
            tcp = None if port is None else TcpAccess(port, options.control_token)
            control = stack.enter_context(control_server(options.control, commands, tcp))
        stack.callback(commands.close)
        stack.callback(sys.setswitchinterval, sys.getswitchinterval())
        sys.setswitchinterval(_SWITCH_S)
        yield RelayWatch(commands, control)


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
