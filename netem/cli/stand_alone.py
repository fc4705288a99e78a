"""Runs a stand-alone emulator: reads the command line, relays, prints the totals."""

import json
from collections.abc import Sequence

from rich.console import Console

from netem.cli import emulator_options as command_line
from netem.cli import relay_run
from netem.cli.explain_links import explain
from netem.cli.relay_totals import print_totals
from netem.control.emulator_statistics import unintended
from noack.core.errors import ExitStatus


def alone(arguments: Sequence[str]) -> ExitStatus:
    """Run a stand-alone emulator until Ctrl-C, or explain its settings.

    Returns:
        UNINTENDED_LOSSES if there were any; the guarantee is void then.

    Raises:
        CallerError: the command line has a mistake.
    """
    parser = command_line.parser()
    relay_run.add_options(parser)
    options = command_line.parsed(parser, arguments)
    if options.compile:
        relay_run.compile_all()
        return ExitStatus.OK
    specs = command_line.specs_of(options)
    if options.explain:
        explain(specs, as_json=options.json, as_file=options.links is None)
        return ExitStatus.OK
    totals = relay_run.relay(specs, options)
    if options.json:
        print(json.dumps(totals, indent=2))
    else:
        console = Console(stderr=True, highlight=False)
        print_totals(totals, console, predicted=options.replay_fates is None)
    return ExitStatus.UNINTENDED_LOSSES if unintended(totals) else ExitStatus.OK
