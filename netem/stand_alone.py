"""A stand-alone emulator: runs a relay, with what watches, changes and records it; prints totals.

:func:`run_stand_alone` reads the command line, :func:`run_relay` relays until Ctrl-C.
"""

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from rich.console import Console

from netem.capture import CaptureWriter
from netem.control.control_server import starting
from netem.control.emulator_statistics import Statistics, statistics, unintended_losses
from netem.control.statistics_view import picture_of
from netem.emulator_options import command_line_parser, parse_options, specs_of
from netem.explanation import explain
from netem.fates import FateRecorder, read_fates
from netem.relay.link_sockets import raise_file_limit
from netem.relay.relay import Relay
from netem.relay.relay_links import DeviceLink, LinkSpec
from netem.relay.relay_reports import DIRECTIONS, Direction, Tap, report_line
from netem.relay_watch import add_watching_options, check_watching_options, watch_relay
from noack.core.errors import CallerError, ExitStatus, MachineError, NoackError, why
from noack.impairments.link_settings import LinkSettings
from noack.runtime.address import address_text
from noack.runtime.command_line import Signals, log_event, log_format, report_failure
from noack.runtime.drivers.realtime_settings import realtime

_FIFO_PRIORITY = 50
"""As the controller of a run has it by default."""
_SPIN_NS = 50_000
"""Nearly all sleeping threads wake within this time; longer spinning would block the core."""


class RelayedProgram(Protocol):
    """A program that the relay serves: the relay runs until it ends."""

    devices: DeviceLink

    def running(self, signals: Signals) -> AbstractContextManager[Callable[[], bool]]:
        """Run within the context; yields whether it has ended."""


def add_recording_options(parser: argparse.ArgumentParser, *, shell: bool = False) -> None:
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
    group = parser.add_argument_group("recording")
    group.add_argument(
        "--capture",
        metavar="FILE.pcapng",
        help="capture all datagrams, with their fates as comments; - for standard output",
    )
    group.add_argument("--record-fates", metavar="FILE.parquet", type=Path, help="record packet fates")
    group.add_argument(
        "--replay-fates",
        metavar="FILE.parquet",
        type=Path,
        help="replay recorded packet fates, matched by flow and packet number; the recorded cap "
        "applies unless mansd sets another",
    )
    add_watching_options(parser)


def run_stand_alone(arguments: Sequence[str]) -> ExitStatus:
    """Run a stand-alone emulator until Ctrl-C, or explain its settings; print the totals.

    Returns:
        UNINTENDED_LOSSES if there were any; the guarantee is void then.

    Raises:
        CallerError: the command line has a mistake.
    """
    parser = command_line_parser()
    add_recording_options(parser)
    options = parse_options(parser, arguments)
    specs = specs_of(options)
    if options.explain:
        specs_as_written = specs_of(options, read=False)
        explain(specs, specs_as_written, as_json=options.json, as_file=options.links is None)
        return ExitStatus.OK
    with log_format(options.log_format):
        try:
            totals = run_relay(specs, options)
        except NoackError as error:  # reported in the format of the log
            return report_failure(str(error), error.exit_status, source="noack netem", as_json=options.json)
        report_totals(totals, options)
    return ExitStatus.UNINTENDED_LOSSES if unintended_losses(totals) else ExitStatus.OK


def report_totals(totals: Statistics, options: argparse.Namespace) -> None:
    """Print the totals of a relay that has ended."""
    if options.replay_fates is not None:  # the settings do not predict the loss of replayed fates
        for direction in (link[name] for link in totals["links"] for name in DIRECTIONS):
            direction["loss"]["predicted"] = None
    if options.json:
        print(json.dumps(totals, indent=2))
    logged = log_event("info", "noack netem", "ended", event="totals", totals=totals)
    if not (options.json or logged):
        console = Console(stderr=True, highlight=False)
        console.print(picture_of(totals, "totals", console.width))
        if lost := unintended_losses(totals):
            status = ExitStatus.UNINTENDED_LOSSES
            text = f"{lost:,} datagrams; the guarantee does not hold (exit status {status})"
            console.print(f"unintended losses: {text}", style="bold red", soft_wrap=True)


def run_relay(
    specs: Sequence[LinkSpec], options: argparse.Namespace, program: RelayedProgram | None = None
) -> Statistics:
    """Relay until Ctrl-C, or the program's end; return the totals.

    ``options`` are those of :func:`add_recording_options`.

    Raises:
        CallerError: an address is in use, or a file cannot be written.
        MachineError: the sockets cannot be opened.
    """
    check_options(options)
    if options.replay_fates is not None:
        specs = _replaying(specs, options.replay_fates)
    # Signals stay handled until all files are complete.
    with ExitStack() as signal_stack, ExitStack() as stack:
        # Open what records the relay, the relay, and what watches it.
        with starting(options.control):
            taps: list[Tap] = []
            if options.capture is not None:
                taps.append(stack.enter_context(_capture(options.capture, specs)))
            if options.record_fates is not None:
                taps.append(stack.enter_context(FateRecorder(options.record_fates, specs)))
            relay = _open_relay(specs, options, taps, None if program is None else program.devices)
            stack.callback(relay.close)
            signals = signal_stack.enter_context(Signals().handled())
            watch = stack.enter_context(watch_relay(relay, options))
            running = nullcontext(lambda: False) if program is None else program.running(signals)
            has_ended = stack.enter_context(running)
        # Relay.
        for setting, answer in stack.enter_context(realtime(options.realtime, _FIFO_PRIORITY)).items():
            if answer.startswith("not permitted"):
                report_line(f"{setting} {answer}")
        takes_output = options.view or (options.stats is not None and options.stats_file is None)
        if program is None:
            is_free = options.capture != "-" and not takes_output
            _report_ready(relay, print_it=is_free, as_json=options.json)
        relay.run(
            lambda: watch.quit_requested or signals.received is not None or has_ended(),
            watch.commands.run_pending,
        )
        return statistics(watch.commands.snapshot_here())


def _open_relay(
    specs: Sequence[LinkSpec],
    options: argparse.Namespace,
    taps: Sequence[Tap],
    devices: DeviceLink | None,
) -> Relay:
    raise_file_limit()
    spin_ns = _SPIN_NS if options.realtime else 0
    try:
        return Relay(specs, segment=options.segment, taps=taps, spin_ns=spin_ns, devices=devices)
    except OSError as error:  # no IPv6, or too many open files
        raise MachineError(f"the sockets of the links cannot be opened: {why(error)}") from None


def _replaying(specs: Sequence[LinkSpec], path: Path) -> Sequence[LinkSpec]:
    """Return links that replay a trace; a link without a guarantee gets that of the trace."""
    fates = read_fates(path, [spec.name for spec in specs])

    def settings(spec: LinkSpec, direction: Direction) -> LinkSettings:
        own_settings: LinkSettings = getattr(spec, direction)
        if own_settings.longest_burst is not None:
            return own_settings
        return own_settings.model_copy(update=fates.guarantees[spec.name, direction])

    return [
        replace(
            spec,
            forward=settings(spec, "forward"),
            reverse=settings(spec, "reverse"),
            decisions={side: fates.decisions[spec.name, side] for side in DIRECTIONS},
        )
        for spec in specs
    ]


def check_options(options: argparse.Namespace) -> None:
    """Check the options of :func:`add_recording_options`, and that no file is given for two.

    Raises:
        CallerError: two options contradict each other.
    """
    check_watching_options(options)
    if options.capture == "-" and (options.json or options.stats is not None):
        raise CallerError("--capture -: --json and --stats use standard output, too")
    files = {
        f"--{name.replace('_', '-')}": Path(file).resolve()
        for name in ("links", "replay_fates", "record_fates", "capture", "stats_file")
        if (file := getattr(options, name, None)) is not None and str(file) != "-"
    }
    for name, path in files.items():
        for other_name, other_path in files.items():
            if name > other_name and path == other_path and not path.is_char_device():
                raise CallerError(f"{name} {path}: {other_name} has the same file; choose another")


@contextmanager
def _capture(path: str, specs: Sequence[LinkSpec]) -> Iterator[Tap]:
    writer = CaptureWriter(path, specs)
    try:
        yield writer
    finally:
        writer.close()
        if writer.error is not None:
            report_line(writer.error)
        elif writer.missing_events:
            report_line(f"the capture lacks {writer.missing_events} events")


def _report_ready(relay: Relay, *, print_it: bool, as_json: bool) -> None:
    """Report on standard error that the relay runs, when Ctrl-C is handled already.

    ``print_it``: also print a line on standard output that other programs can wait for.
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
        line = json.dumps({"ready": links})
    if print_it and sys.stdout is not None:
        with suppress(OSError, ValueError):  # no reader: the relay continues
            os.write(sys.stdout.fileno(), f"{line}\n".encode())
