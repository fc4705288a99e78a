"""The network's process of a run; ``noack netem``, which is also the emulator on its own."""

import sys
from collections.abc import Sequence

from netem.core.command_line import stoppable_imports

with stoppable_imports():
    from netem.__main__ import COMMANDS
    from netem.__main__ import main as run_emulator
    from netem.core.command_line import Parser, report_failure
    from netem.core.errors import CallerError, ExitStatus, NoackError
    from netem.core.standard_streams import guard_streams
    from noack.network_process.run_network import NetworkSockets, RunNetwork
    from noack.protocol.roles import ENDS
    from noack.runtime.join_run import RUN_OPTIONS, add_options, add_run_options, join_run
    from noack.runtime.run_process import RunProcess


def main(arguments: Sequence[str] | None = None) -> int:
    """Join a run as its network; with other options than those of a run, be an emulator on its own."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words and words[0] in COMMANDS:
        return run_emulator(words)
    joining = Parser(prog="noack netem", add_help=False, allow_abbrev=False)
    add_options(joining)
    try:
        _, further_words = joining.parse_known_args(words)
        if not further_words:
            with join_run("netem", words) as run:
                run_network(run)
            return ExitStatus.OK
        given = [name for name in RUN_OPTIONS if any(word.partition("=")[0] == name for word in words)]
        if given and "--help" not in words:
            raise CallerError(
                f"{given[0]} joins a run and allows only --json beside it; words and all other options "
                "belong to an emulator on its own, which needs --listen and --to, or --links"
            )
    except NoackError as error:
        return report_failure(str(error), error.exit_status, source="noack netem", as_json="--json" in words)
    return run_emulator(words, _emulator_parser())


def _emulator_parser() -> Parser:
    """Return the parser of an emulator on its own, whose help has the options of a run, too."""
    from netem.emulator_options import command_line_parser  # a run starts without it

    parser = command_line_parser()
    parser.usage = f"{parser.usage}\n       %(prog)s [--session NAME]"
    parser.description = (
        f"{parser.description} Without --listen, it joins the run that `noack record SCENARIO` has opened."
    )
    add_run_options(parser)
    return parser


def run_network(run: RunProcess) -> None:
    """Relay the datagrams of a run by the core."""
    loops = len(run.resolved.names)
    network = RunNetwork(run.scenario, loops)
    with run.open_socket() as endpoint:
        addresses = run.join(endpoint.getsockname()[:2])
        routes = [
            (addresses[ENDS[flow].sender], addresses[ENDS[flow].receiver])
            for flow in run.scenario.network.flows
        ]
        sockets = NetworkSockets(
            endpoint,
            routes,
            network=network,
            clock=run.clock,
            spin_ns=run.spin_ns,
            loops=loops,
        )
        run.run(network, sockets, network)


if __name__ == "__main__":
    guard_streams(ignore_broken_pipes=False)  # the emulator ends when its output is closed
    sys.exit(main())
