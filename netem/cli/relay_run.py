"""Runs a relay, optionally with live control, statistics, captures and fate traces."""

import argparse
import json
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from netem.capture.capture_writer import CaptureWriter
from netem.cli import emulator_options
from netem.cli.explain_links import explain
from netem.cli.relay_totals import print_totals
from netem.control import relay_attachments
from netem.control.emulator_session import starting
from netem.control.emulator_statistics import Statistics, statistics, unintended
from netem.engine.relay import Relay
from netem.engine.relay_interface import DIRECTIONS, Direction, LinkSpec, Tap
from netem.fates.fate_recorder import FateRecorder
from netem.fates.fate_replay import read_fates
from netem.standard_error import say
from noack.core.errors import CallerError, ExitStatus, NoackError
from noack.impairments.link_settings import LinkSettings
from noack.runtime.address import text_of
from noack.runtime.command_line import Signals, failed, log_event, log_format
from noack.runtime.real_time_loop import realtime

_FIFO_PRIORITY = 50
_SPIN_NS = 50_000
"""Nearly all sleeping threads wake within this time; longer spinning would block the core."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for running and recording a relay."""
    group = parser.add_argument_group("relay")
    group.add_argument(
        "--segment", action="store_true",
        help="send consecutive datagrams of equal size in one system call (UDP_SEGMENT)",
    )  # fmt: skip
    group.add_argument(
        "--realtime", action="store_true",
        help="request SCHED_FIFO, locked memory and no deep idle states, each where permitted; "
        "poll during the last 50 µs before a delayed datagram is due",
    )  # fmt: skip
    group = parser.add_argument_group("recording")
    group.add_argument(
        "--capture", metavar="FILE.pcapng",
        help="capture all datagrams, with their fates as comments; - for standard output",
    )  # fmt: skip
    group.add_argument(
        "--record-fates", metavar="FILE.parquet", type=Path, help="record packet fates"
    )
    group.add_argument(
        "--replay-fates", metavar="FILE.parquet", type=Path,
        help="replay recorded packet fates, matched by flow and packet number; the recorded cap "
        "applies unless mansd sets another",
    )  # fmt: skip
    relay_attachments.add_options(parser)


def alone(arguments: Sequence[str]) -> ExitStatus:
    """Run a stand-alone emulator until Ctrl-C, or explain its settings; print the totals.

    Returns:
        UNINTENDED_LOSSES if there were any; the guarantee is void then.

    Raises:
        CallerError: the command line has a mistake.
    """
    parser = emulator_options.parser()
    add_options(parser)
    options = emulator_options.parsed(parser, arguments)
    specs = emulator_options.specs_of(options)
    if options.explain:
        written = emulator_options.specs_of(options, read=False)
        explain(specs, written, as_json=options.json, as_file=options.links is None)
        return ExitStatus.OK
    with log_format(options.log_format):
        try:
            totals = relay(specs, options)
        except NoackError as error:  # reported in the format of the log
            return failed(str(error), error.exit_status, who="noack netem", as_json=options.json)
        _report_totals(totals, options)
    return ExitStatus.UNINTENDED_LOSSES if unintended(totals) else ExitStatus.OK


def _report_totals(totals: Statistics, options: argparse.Namespace) -> None:
    if options.json:
        print(json.dumps(totals, indent=2))
    logged = log_event("info", "noack netem", "ended", event="totals", totals=totals)
    if not (options.json or logged):
        console = Console(stderr=True, highlight=False)
        print_totals(totals, console, predicted=options.replay_fates is None)


def relay(specs: Sequence[LinkSpec], options: argparse.Namespace) -> Statistics:
    """Relay until Ctrl-C, with the options of :func:`add_options`; return the totals.

    Raises:
        CallerError: an address is in use, or a file cannot be written.
    """
    attachments = relay_attachments.options_of(options)
    if options.capture == "-" and (options.json or options.stats is not None):
        raise CallerError("--capture -: --json and --stats use standard output, too")
    _check_files(options)
    if options.replay_fates is not None:
        specs = _replaying(specs, options.replay_fates)
    with ExitStack() as last, ExitStack() as stack:
        with starting(attachments.name):
            taps: list[Tap] = []
            if options.capture is not None:
                taps.append(stack.enter_context(_capture(options.capture, specs)))
            if options.record_fates is not None:
                taps.append(stack.enter_context(FateRecorder(options.record_fates, specs)))
            opened = Relay(specs, options.segment, taps, _SPIN_NS if options.realtime else 0)
            stack.callback(opened.close)
            # Signals stay handled until all files are complete.
            signals = last.enter_context(Signals().handled())
            side = stack.enter_context(relay_attachments.attached(opened, attachments))
        for setting, answer in stack.enter_context(
            realtime(options.realtime, _FIFO_PRIORITY)
        ).items():
            if answer.startswith("refused"):
                say(f"{setting} {answer}")
        takes_output = options.capture == "-" or attachments.takes_output
        _report_ready(opened, print_it=not takes_output, as_json=options.json)
        opened.run(
            lambda: side.quit_requested or signals.received is not None, side.commands.run_pending
        )
        return statistics(side.commands.look())


def _replaying(specs: Sequence[LinkSpec], path: Path) -> Sequence[LinkSpec]:
    """Return links that replay a trace; a link without a guarantee gets that of the trace."""
    fates = read_fates(path, [spec.name for spec in specs])

    def settings(spec: LinkSpec, direction: Direction) -> LinkSettings:
        given: LinkSettings = getattr(spec, direction)
        if given.longest_burst is not None:
            return given
        return given.model_copy(update=fates.guarantees[spec.name, direction])

    return [
        replace(
            spec, forward=settings(spec, "forward"), reverse=settings(spec, "reverse"),
            decisions={side: fates.decisions[spec.name, side] for side in DIRECTIONS},
        )
        for spec in specs
    ]  # fmt: skip


def _check_files(options: argparse.Namespace) -> None:
    """Check that no file is given for two options."""
    files = {
        f"--{name.replace('_', '-')}": Path(given).resolve()
        for name in ("links", "replay_fates", "record_fates", "capture", "stats_file")
        if (given := getattr(options, name, None)) is not None and str(given) != "-"
    }
    for name, path in files.items():
        for other, same in files.items():
            if name > other and path == same and not path.is_char_device():
                raise CallerError(f"{name} {path}: {other} has the same file; choose another")


@contextmanager
def _capture(path: str, specs: Sequence[LinkSpec]) -> Iterator[Tap]:
    writer = CaptureWriter(path, specs)
    try:
        yield writer
    finally:
        writer.close()
        if writer.error is not None:
            say(writer.error)
        elif writer.missing_events:
            say(f"the capture lacks {writer.missing_events} events")


def _report_ready(opened: Relay, *, print_it: bool, as_json: bool) -> None:
    """Report on standard error that the relay runs, when Ctrl-C is handled already.

    ``print_it``: also print a line on standard output that other programs can wait for.
    """
    listen = {name: text_of(address) for name, address in opened.addresses().items()}
    for spec in opened.specs:
        name = f" ({spec.name})" if len(opened.specs) > 1 else ""
        say(f"{listen[spec.name]} → {text_of(spec.to)}{name}, Ctrl-C ends")
    line = f"ready: listening on {', '.join(listen.values())}"
    if as_json:
        links = [
            {"name": spec.name, "listen": listen[spec.name], "to": text_of(spec.to)}
            for spec in opened.specs
        ]
        line = json.dumps({"ready": links})
    if print_it and sys.stdout is not None:
        with suppress(OSError, ValueError):  # no reader: the relay continues
            os.write(sys.stdout.fileno(), f"{line}\n".encode())
