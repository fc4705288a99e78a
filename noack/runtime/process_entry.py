"""Entry of a process into a run and its exit: ticket, command line, exit status."""

import argparse
import json
import os
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

from setproctitle import setproctitle

from noack.core.errors import ExitStatus, NoackError, NoAnswerError, PeerError
from noack.core.process_limits import exhausted_limit, require_limits
from noack.runtime.address import text_of
from noack.runtime.command_line import TICKET_ON_STDIN, Parser, failed
from noack.runtime.control_plane import ControlPlane
from noack.runtime.invitation import STANDARD_INPUT, read_invitation
from noack.runtime.join_ticket import DEFAULT_SESSION, Ticket, loads, wait_for_ticket
from noack.runtime.life_cycle import HORIZON, Event
from noack.runtime.process_life import RunProcess, lifeline_cut
from noack.runtime.signals import Signals

_RUNS = Path("runs")
_POLL_S = 0.1
_TICKET_TIMEOUT_S = 24 * 3600.0  # a person may start the recorder late; Ctrl-C ends the wait


def run_process(
    role: str,
    body: Callable[[RunProcess], None],
    session: str = DEFAULT_SESSION,
    *,
    invitation: Path | None = None,
    runs: Path = _RUNS,
    as_json: bool = False,
) -> ExitStatus:
    """Join a run as ``role``, run ``body``, and return the exit status.

    The run is that of an invitation, or else of a session on this host. A process that was invited
    keeps below ``runs`` what it cannot send to the recorder. A caller's or a peer's error becomes
    one line on standard error, without a traceback; with ``as_json`` also a document on standard
    output.
    """
    with Signals().handled() as signals:
        try:
            require_limits()
            if invitation is None:
                ticket = _ticket(role, session, signals)
            else:
                ticket = _invited(role, invitation, runs, signals)
            if ticket.launched:
                setproctitle(f"noack {role}")  # in lists of processes
            process = _admitted(role, ticket, signals)
            with process.plane:
                try:
                    body(process)
                except Exception as error:
                    process.fail(error)
                    raise
                finally:
                    process.life.apply(Event.END)
                    process.plane.report_end(process.ended)
        except NoackError as error:
            if signals.received is None:
                return failed(str(error), error.exit_status, who=f"noack {role}", as_json=as_json)
        except Exception as error:
            if (line := exhausted_limit(error)) is not None:
                return failed(line, ExitStatus.FAILED, who=f"noack {role}", as_json=as_json)
            traceback.print_exc()
            print(f"noack {role}: internal error, see above", file=sys.stderr)
            return ExitStatus.FAILED
        if signals.received is None and not ticket.launched:
            print(f"noack {role}: ended: {process.ended}", file=sys.stderr)
            return ExitStatus.OK if process.ended == HORIZON else ExitStatus.FAILED
        return signals.status


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that all processes have."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--session", default=DEFAULT_SESSION, help="name of the recorder's session")
    where.add_argument(
        "--invitation", type=Path, metavar="FILE", help="from `noack record --listen`"
    )
    parser.add_argument(
        "--runs", type=Path, default=_RUNS, metavar="DIRECTORY",
        help="of an invited process: where rows stay that cannot be sent to the recorder",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print the final report as JSON")


def main(
    role: str, body: Callable[[RunProcess], None], arguments: Sequence[str] | None
) -> ExitStatus:
    """Command line of a process that only joins runs."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    parser = Parser(
        prog=f"noack {role}",
        description=f"The {role} of a run: joins the run that `noack record SCENARIO` has opened.",
    )
    add_options(parser)
    try:
        options = parser.parse_args(given)
    except NoackError as error:
        return failed(str(error), error.exit_status, who=f"noack {role}", as_json="--json" in given)
    return join_run(role, body, options)


def join_run(
    role: str, body: Callable[[RunProcess], None], options: argparse.Namespace
) -> ExitStatus:
    """Join a run with the options of :func:`add_options`."""

    def body_and_report(process: RunProcess) -> None:
        body(process)
        if options.json:
            print(json.dumps(process.report, indent=2))

    return run_process(
        role, body_and_report, options.session,
        invitation=options.invitation, runs=options.runs, as_json=options.json,
    )  # fmt: skip


def _ticket(role: str, session: str, signals: Signals) -> Ticket:
    if os.environ.pop(TICKET_ON_STDIN, None):
        return loads(sys.stdin.buffer.readline().decode())
    ticket = wait_for_ticket(
        session,
        _TICKET_TIMEOUT_S,
        lambda: signals.received is not None,
        lambda path: print(
            f"noack {role}: waiting for `noack record SCENARIO` on this host (session "
            f"{session!r}); of a run on another host, give its --invitation; Ctrl-C ends",
            file=sys.stderr,
        ),
    )
    print(f"noack {role}: joining run of {ticket.scenario.name!r}", file=sys.stderr)
    return ticket


def _invited(role: str, invitation: Path, runs: Path, signals: Signals) -> Ticket:
    """Wait for an invitation and return its ticket; raise CallerError or PeerError without one."""
    from_a_file = invitation != STANDARD_INPUT
    if from_a_file and not invitation.exists() and invitation.parent.is_dir():
        print(f"noack {role}: waiting for {invitation}; Ctrl-C ends", file=sys.stderr)
        deadline_s = time.monotonic() + _TICKET_TIMEOUT_S
        while not invitation.exists() and time.monotonic() < deadline_s:
            if signals.received is not None:
                raise PeerError("no invitation")
            time.sleep(_POLL_S)
    ticket = read_invitation(invitation, runs)
    assert ticket.remote is not None  # else it is no invitation
    where = text_of((ticket.remote.host, ticket.remote.port))
    print(f"noack {role}: joining run of {ticket.scenario.name!r} at {where}", file=sys.stderr)
    return ticket


def _admitted(role: str, ticket: Ticket, signals: Signals) -> RunProcess:
    """Connect to a run and request admission; raise PeerError without an admission.

    A launched process tries again while its launcher lives. On a busy machine a connection may
    fail, or zenoh may not learn of the coordinator's queryables: then no request is answered.
    """
    while True:
        try:
            with ExitStack() as stack:
                plane = stack.enter_context(ControlPlane(ticket, role))
                process = RunProcess(role, ticket, plane, signals)
                process.request_admission()
                stack.pop_all()
                return process
        except NoAnswerError:
            if not ticket.launched or signals.received or lifeline_cut():
                raise
