"""Entry point of the network emulator.

In a run, it is one of the run's processes. On its own, it relays for any UDP program::

    python -m netem --listen 127.0.0.1:9000 --to 127.0.0.1:9001 loss 30% mansd 4
    python -m netem shell loss 30% mansd 4 -- COMMAND
"""

import sys
from collections.abc import Sequence

from noack.runtime.command_line import stoppable_imports

with stoppable_imports():
    from netem.run_network import NetworkSockets, RunNetwork
    from noack.core.errors import ExitStatus, NoackError
    from noack.core.system_processes import exhausted_limit
    from noack.protocol.roles import ENDS
    from noack.runtime.command_line import Parser, report_failure, why_not_written
    from noack.runtime.join_run import add_options, join_run
    from noack.runtime.run_process import RunProcess
    from noack.runtime.standard_streams import guard_streams


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the emulator (stand-alone or in a run), a shell, or a command for a running emulator."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words and words[0] in ("show", "set", "watch"):
        from netem.control import emulator_commands  # a run's emulator starts without it

        return emulator_commands.main(words)
    as_json = "--json" in words
    joining = Parser(prog="noack netem", add_help=False, allow_abbrev=False)
    add_options(joining)
    try:
        if words[:1] == ["shell"]:
            from netem.shell.shell import run_in_shell  # a run's emulator starts without it

            as_json = "--json" in words[: (*words, "--").index("--")]
            return run_in_shell(words[1:])
        _, further_words = joining.parse_known_args(words)
        if not further_words:
            with join_run("netem", words) as run:
                run_network(run)
            return ExitStatus.OK
        from netem.stand_alone import run_stand_alone  # a run's emulator starts without it

        status = run_stand_alone(words)
        if sys.stdout is not None:  # closed by the shell: >&-
            sys.stdout.flush()
        return status
    except NoackError as error:
        return report_failure(str(error), error.exit_status, source="noack netem", as_json=as_json)
    except OSError as error:
        reason = exhausted_limit(error) or why_not_written(error) or str(error)
        return report_failure(reason, ExitStatus.FAILED, source="noack netem", as_json=as_json)


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
