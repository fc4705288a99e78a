"""A process becomes part of a run, from its command line to its exit status.

It waits for a run descriptor, and is admitted to the run. ``run_process.py`` has
the rest. Read :func:`join_run` first.
"""

import argparse
import json
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TypeVar

from setproctitle import setproctitle

from netem.core.address import address_text
from netem.core.command_line import Parser, Signals, report_failure
from netem.core.errors import ExitStatus, NoackError, NoAnswerError, PeerError
from netem.core.system_processes import exhausted_limit, require_limits
from noack.runtime.connections.credentials import read_credentials
from noack.runtime.control_plane import ControlPlane
from noack.runtime.end_reasons import HORIZON
from noack.runtime.run_descriptor import (
    DEFAULT_SESSION,
    DESCRIPTOR_ON_STDIN,
    RunDescriptor,
    find_descriptor,
    parse_descriptor,
)
from noack.runtime.run_process import RunProcess, launcher_has_ended

_RUNS = Path("runs")
_POLL_S = 0.1
_DESCRIPTOR_TIMEOUT_S = 24 * 3600.0  # a person may start the recorder late; Ctrl-C ends the wait
T = TypeVar("T")


RUN_OPTIONS = ("--session", "--credentials", "--runs")


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """Add the options :data:`RUN_OPTIONS`, which say which run a process joins."""
    origin = parser.add_mutually_exclusive_group()
    origin.add_argument("--session", default=DEFAULT_SESSION, help="name of the recorder's session")
    origin.add_argument(
        "--credentials", type=Path, metavar="FOLDER", help="of this role, from `noack record --listen`"
    )
    parser.add_argument(
        "--runs",
        type=Path,
        default=_RUNS,
        metavar="DIRECTORY",
        help="with --credentials: where rows stay that cannot be sent to the recorder",
    )


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that all processes have."""
    add_run_options(parser)
    parser.add_argument("--json", action="store_true", help="print the final report as JSON")


@contextmanager
def join_run(role: str, arguments: Sequence[str] | None = None) -> Iterator[RunProcess]:
    """Be a process of a run within the context: from its admission to the report of its end.

    The run is that of its credentials, or else of a session on this host. A process on another host
    keeps below ``--runs`` what it cannot send to the recorder.

    Args:
        role: role of the process.
        arguments: the options of :func:`add_options`; None: those of the command line.

    Raises:
        SystemExit: the process ends with another status than 0. A caller's or a peer's error, also
            one from within the context, has then become one line on standard error, without a
            traceback; with ``--json`` also a document on standard output.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    parser = Parser(
        prog=f"noack {role}",
        description=f"The {role} of a run: joins the run that `noack record SCENARIO` has opened.",
    )
    add_options(parser)
    signals = Signals()
    with _exit_status(role, signals, as_json="--json" in words):
        options = parser.parse_args(words)
        with signals.handled():
            require_limits()
            if options.credentials is None:
                descriptor = _find_descriptor(role, options.session, signals)
            else:
                descriptor = _wait_for_credentials(role, options.credentials, options.runs, signals)
            if descriptor.launched:
                setproctitle(f"noack {role}")  # in lists of processes
            process = _request_admission(role, descriptor, signals)
            with process.plane:
                try:
                    yield process
                except Exception as error:
                    process.fail(error)
                    raise
                finally:
                    process.plane.report_end(process.ended)
        if options.json:
            print(json.dumps(process.report, indent=2))
        if signals.received is None and not descriptor.launched:
            is_complete = process.ended == HORIZON
            end = "the run reached its horizon" if is_complete else f"the run ended early: {process.ended}"
            print(f"noack {role}: {end}", file=sys.stderr)
            if not is_complete:
                sys.exit(ExitStatus.FAILED)


@contextmanager
def _exit_status(role: str, signals: Signals, *, as_json: bool) -> Iterator[None]:
    """Turn errors and signals within the context into a line and an exit status."""
    source = f"noack {role}"
    try:
        yield
    except NoackError as error:
        if signals.received is None:
            sys.exit(report_failure(str(error), error.exit_status, source=source, as_json=as_json))
    except Exception as error:
        if (line := exhausted_limit(error)) is not None:
            sys.exit(report_failure(line, ExitStatus.FAILED, source=source, as_json=as_json))
        traceback.print_exc()
        print(f"{source}: internal error, see above", file=sys.stderr)
        sys.exit(ExitStatus.FAILED)
    if signals.received is not None:
        sys.exit(signals.status)


def _find_descriptor(role: str, session: str, signals: Signals) -> RunDescriptor:
    if os.environ.pop(DESCRIPTOR_ON_STDIN, None):
        return parse_descriptor(sys.stdin.buffer.readline().decode())
    descriptor = _wait_for(
        lambda: find_descriptor(session),
        signals,
        f"noack {role}: waiting for `noack record SCENARIO` on this host (session {session!r}); to join "
        "a run on another host, use --credentials; Ctrl-C ends the wait",
    )
    if descriptor is None:
        raise PeerError(f"no run to join in session {session!r}: start `noack record SCENARIO` first")
    print(f"noack {role}: joining the run of {descriptor.scenario.name!r}", file=sys.stderr)
    return descriptor


def _wait_for_credentials(role: str, folder: Path, runs: Path, signals: Signals) -> RunDescriptor:
    """Wait for the folder of credentials and return its run descriptor.

    Raise CallerError or PeerError without one.
    """
    waiting = f"noack {role}: waiting for {folder}; Ctrl-C ends the wait"
    if not _wait_for(folder.exists, signals, waiting):
        raise PeerError(f"{folder}: there is no such folder")
    descriptor = read_credentials(folder, role, runs)
    assert descriptor.remote is not None  # else read_credentials refuses it
    host_port = address_text(descriptor.remote)
    print(f"noack {role}: joining the run of {descriptor.scenario.name!r} at {host_port}", file=sys.stderr)
    return descriptor


def _wait_for(find: Callable[[], T], signals: Signals, waiting: str) -> T:
    """Return what is found once it is true; after a signal, or a day, what is found then."""
    until_s = time.monotonic() + _DESCRIPTOR_TIMEOUT_S
    if not find():
        print(waiting, file=sys.stderr)
    while not (result := find()) and signals.received is None and time.monotonic() < until_s:
        time.sleep(_POLL_S)
    return result


def _request_admission(role: str, descriptor: RunDescriptor, signals: Signals) -> RunProcess:
    """Connect to a run and request admission; raise PeerError without an admission.

    A launched process tries again while its launcher lives. On a busy machine a connection may
    fail, or zenoh may not learn of the coordinator's queryables: then no request is answered.
    """
    while True:
        try:
            with ExitStack() as stack:
                plane = stack.enter_context(ControlPlane(descriptor, role))
                process = RunProcess(role, descriptor, plane, signals)
                process.request_admission()
                stack.pop_all()
                return process
        except NoAnswerError:
            if not descriptor.launched or signals.received or launcher_has_ended():
                raise
