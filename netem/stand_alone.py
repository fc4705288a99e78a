"""A stand-alone emulator: runs a relay, with what watches and changes it; prints totals.

:func:`run_stand_alone` reads the command line, :func:`run_relay` relays until Ctrl-C.
"""

import argparse
import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from itertools import islice
from pathlib import Path
from typing import Protocol

from netem.control.emulator_statistics import Statistics, statistics, unintended_losses
from netem.control.running_emulators import starting
from netem.control.statistics_text import statistics_lines
from netem.core.address import address_text
from netem.core.command_line import Parser, Signals, log_event, log_format, netem_program, report_failure
from netem.core.errors import CallerError, ExitStatus, MachineError, NoackError, why
from netem.core.number_format import counted
from netem.core.realtime_settings import realtime
from netem.emulator_options import (
    command_line_parser,
    explained_packets,
    parse_options,
    presets_of,
    specs_of,
    timetable_of,
)
from netem.explanation import explain
from netem.presets.preset import shipped_presets
from netem.presets.preset_text import print_list
from netem.relay.link_sockets import raise_file_limit
from netem.relay.relay import Relay
from netem.relay.relay_links import DeviceLink, LinkSpec
from netem.relay.relay_reports import report_line
from netem.relay.timetable import Timetable
from netem.relay_watch import add_watching_options, check_watching_options, watch_relay
from netem.timetable_file import TimetableFile

_FIFO_PRIORITY = 50
"""As the controller of a run has it by default."""
_SPIN_NS = 50_000
"""Nearly all sleeping threads wake within this time; longer spinning would block the core."""


class RelayedProgram(Protocol):
    """A program that the relay serves: the relay runs until it ends."""

    devices: DeviceLink

    def running(self, signals: Signals) -> AbstractContextManager[Callable[[], bool]]:
        """Run within the context; yields whether it has ended."""


def add_relay_options(parser: argparse.ArgumentParser, *, shell: bool = False) -> None:
    """Add the options of an emulator on its own, or of a shell, that do not describe links."""
    group = parser.add_argument_group("relay")
    if shell:
        parser.set_defaults(segment=False)
    else:
        group.add_argument(
            "--segment",
            action="store_true",
            help="send consecutive datagrams of equal size in one system call (UDP_SEGMENT)",
        )
    group.add_argument(
        "--realtime",
        action="store_true",
        help="request SCHED_FIFO, locked memory and no deep idle states, each where permitted; "
        "poll during the last 50 µs before a delayed datagram is due",
    )
    add_watching_options(parser)


def run_stand_alone(arguments: Sequence[str], parser: Parser | None = None) -> ExitStatus:
    """Run a stand-alone emulator until Ctrl-C, or explain its settings; print the totals.

    Returns:
        UNINTENDED_LOSSES if there were any; the guarantee is void then.

    Raises:
        CallerError: the command line has a mistake.
    """
    parser = parser or command_line_parser()
    add_relay_options(parser)
    options = parse_options(parser, arguments)
    if options.presets:
        print_list(shipped_presets().values(), as_json=options.json)
        return ExitStatus.OK
    specs = specs_of(options)
    timetable = timetable_of(options, specs)
    packets = explained_packets(options)
    if options.explain:
        specs_as_written = specs_of(options, read=False)
        explain(
            specs,
            specs_as_written,
            presets_of(options),
            timetable,
            as_json=options.json,
            as_file=options.links is None,
            packets=packets,
        )
        return ExitStatus.OK
    with log_format(options.log_format):
        try:
            totals = run_relay(specs, options, timetable=timetable)
        except NoackError as error:  # reported in the format of the log
            return report_failure(str(error), error.exit_status, source=netem_program(), as_json=options.json)
        report_totals(totals, options)
    return ExitStatus.UNINTENDED_LOSSES if unintended_losses(totals) else ExitStatus.OK


def report_totals(totals: Statistics, options: argparse.Namespace) -> None:
    """Print the totals of a relay that has ended."""
    if options.json:
        print(json.dumps(totals))
    logged = log_event("info", netem_program(), "ended", event="totals", totals=totals)
    if not (options.json or logged):
        for line in statistics_lines(totals):
            print(line, file=sys.stderr)
        if lost := unintended_losses(totals):
            status = ExitStatus.UNINTENDED_LOSSES
            text = f"{counted(lost, 'datagram')}; the guarantee does not hold (exit status {status})"
            print(f"unintended losses: {text}", file=sys.stderr)


def run_relay(
    specs: Sequence[LinkSpec],
    options: argparse.Namespace,
    program: RelayedProgram | None = None,
    timetable: TimetableFile | None = None,
) -> Statistics:
    """Relay until Ctrl-C, or the program's end; return the totals.

    Args:
        specs: the links.
        options: those of :func:`add_relay_options`.
        program: what the relay serves, if it is a shell.
        timetable: the changes of settings.

    Raises:
        CallerError: an address is in use, or a file cannot be written.
        MachineError: the sockets cannot be opened.
    """
    check_options(options)
    # Signals stay handled until all files are complete.
    with ExitStack() as signal_stack, ExitStack() as stack:
        # Open the relay, and what watches it.
        with starting(options.control):
            changes = None if timetable is None else timetable.timetable
            devices = None if program is None else program.devices
            relay = _open_relay(specs, options, devices, changes)
            stack.callback(relay.close)
            signals = signal_stack.enter_context(Signals().handled())
            commands, control = stack.enter_context(watch_relay(relay, options))
            running = nullcontext(lambda: False) if program is None else program.running(signals)
            has_ended = stack.enter_context(running)
        # Relay.
        for setting, answer in stack.enter_context(realtime(options.realtime, _FIFO_PRIORITY)).items():
            if answer.startswith("not permitted"):
                report_line(f"{setting} {answer}")
        for line in () if control is None else control.lines():
            report_line(line)
        if timetable is not None:
            report_line(f"{timetable.path}: {timetable.summary}")
            for note in islice(timetable.notes(specs), 1):
                report_line(note)
        takes_output = options.stats is not None and options.stats_file is None
        if program is None:
            addresses = {} if control is None else {"control": control.document()}
            _report_ready(relay, addresses, print_it=not takes_output, as_json=options.json)
        relay.run(lambda: signals.received is not None or has_ended(), commands.run_pending)
        return statistics(commands.snapshot_here())


def _open_relay(
    specs: Sequence[LinkSpec],
    options: argparse.Namespace,
    devices: DeviceLink | None,
    timetable: Timetable | None,
) -> Relay:
    raise_file_limit()
    spin_ns = _SPIN_NS if options.realtime else 0
    try:
        return Relay(specs, segment=options.segment, spin_ns=spin_ns, devices=devices, timetable=timetable)
    except OSError as error:  # no IPv6, or too many open files
        raise MachineError(f"the sockets of the links cannot be opened: {why(error)}") from None


def check_options(options: argparse.Namespace) -> None:
    """Check the options of :func:`add_relay_options`, and that the statistics replace no input.

    Raises:
        CallerError: two options contradict each other.
    """
    check_watching_options(options)
    stats: Path | None = options.stats_file
    for name in ("links", "timetable"):
        read: Path | None = getattr(options, name, None)
        if read is not None and stats is not None and read.resolve() == stats.resolve():
            raise CallerError(f"--stats-file {stats}: --{name} has the same file; choose another")


def _report_ready(relay: Relay, control: Mapping[str, object], *, print_it: bool, as_json: bool) -> None:
    """Report on standard error that the relay runs, when Ctrl-C is handled already.

    ``print_it``: also print a line on standard output that other programs can wait for; as JSON with
    ``control``, if there is one.
    """
    listen = {name: address_text(address) for name, address in relay.addresses().items()}
    for spec in relay.specs:
        name = f" ({spec.name})" if len(relay.specs) > 1 else ""
        report_line(f"{listen[spec.name]} → {address_text(spec.to)}{name}, Ctrl-C ends")
    line = f"ready: listening on {', '.join(listen.values())}"
    if as_json:
        links = [
            {"name": spec.name, "listen": listen[spec.name], "to": address_text(spec.to)}
            for spec in relay.specs
        ]
        line = json.dumps({"ready": links, **control})
    if print_it and sys.stdout is not None:
        with suppress(OSError, ValueError):  # no reader: the relay continues
            os.write(sys.stdout.fileno(), f"{line}\n".encode())
