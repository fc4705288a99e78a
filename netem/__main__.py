"""Entry point of the network emulator.

In a run, it is one of the run's processes. On its own, it relays for any UDP program::

    python -m netem --listen 127.0.0.1:9000 --to 127.0.0.1:9001 loss 30% mansd 4
"""

import sys
from collections.abc import Mapping, Sequence

from noack.runtime.signals import stoppable_imports

with stoppable_imports():
    from netem.channel import channel_of
    from netem.engine.run_network import RunNetwork
    from netem.run_relay import CoreShell, RelayShell
    from noack.core.errors import ExitStatus, NoackError
    from noack.protocol.topology import ENDS
    from noack.runtime.address import Address
    from noack.runtime.command_line import Parser, failed
    from noack.runtime.peer_sockets import has_peer_sockets
    from noack.runtime.process_entry import add_options, join_run
    from noack.runtime.process_life import RunProcess


def main(arguments: Sequence[str] | None = None) -> ExitStatus:
    """Run the emulator (stand-alone or in a run), or a command for a running emulator."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given and given[0] in ("show", "set", "watch"):
        from netem.control import emulator_commands

        return emulator_commands.main(given)
    joining = Parser(prog="noack netem", add_help=False, allow_abbrev=False)
    add_options(joining)
    try:
        options, more = joining.parse_known_args(given)
        if not more:
            return join_run("netem", _in_a_run, options)
        from netem.cli.relay_run import alone

        return alone(given)
    except NoackError as error:
        as_json = "--json" in given
        return failed(str(error), error.exit_status, who="noack netem", as_json=as_json)


def _in_a_run(node: RunProcess) -> None:
    """Relay in the core, which reads this host's clock; with another's clock, from Python."""
    flows, loops = node.scenario.network.flows, node.loop_count

    def ways(addresses: Mapping[str, Address]) -> list[tuple[Address, Address]]:
        return [(addresses[ENDS[one].sender], addresses[ENDS[one].receiver]) for one in flows]

    if node.follows_reference or not has_peer_sockets():
        node.run(
            channel_of(node.scenario, node.start, loops=loops or 1),
            lambda endpoint, addresses: RelayShell(endpoint, ways(addresses), loops=loops),
        )
        return
    network = RunNetwork(node.scenario, node.start, loops)
    node.run(
        network,
        lambda endpoint, addresses: CoreShell(
            endpoint, ways(addresses), network=network, clock=node.clock,
            spin_us=node.scenario.realtime.spin_us, loops=loops,
        ),
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
