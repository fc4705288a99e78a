"""``noack helics``: the network of a federation of HELICS."""

import signal
from typing import Annotated

from typer import Option

from cosim.cli import command as cli
from cosim.lazy_modules import lazy_modules

with lazy_modules():
    from netem import helics_federate


@cli.command(cli.PROCESSES, 60)
def helics(
    given: cli.ScenarioOptions,
    *,
    endpoint: Annotated[list[str], Option("--endpoint", metavar="NAME")],
    broker: Annotated[str, Option(metavar="ADDRESS")] = "",
    core: Annotated[str, Option(metavar="TYPE")] = "zmq",
    name: Annotated[str, Option(metavar="NAME")] = "noack",
    json: cli.JsonOption = False,
) -> None:
    """Join a federation of HELICS as its network, with the network of a scenario.

    A message that is sent to the endpoint noack/NAME reaches the endpoint NAME later, or not.

    Options:
        endpoint: An endpoint that messages shall reach over the network; repeatable.
        broker: Address of the broker, e.g. tcp://127.0.0.1:23404; by default on this host.
        core: The kind of HELICS' core, as that of the broker: zmq, tcp and so on.
        name: Name of the federate.

    Examples:
        noack helics double_integrator --endpoint controller/update   beside a helics_broker
        noack helics lane_following --endpoint a --endpoint b --set network.mansd=2 --json
    """
    for number in (signal.SIGINT, signal.SIGTERM):  # HELICS waits in C, and so would Ctrl-C
        signal.signal(number, signal.SIG_DFL)
    options = helics_federate.FederateOptions(name, core, broker)
    routes = helics_federate.run(given.load(), endpoint, options)
    cli.print_lines(json, {"endpoints": [route.to_json() for route in routes]}, *routes)
