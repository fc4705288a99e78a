"""``noack adversary``: the worst losses that the network may cause."""

from enum import StrEnum
from typing import Annotated

import typer

from cosim.cli import command as cli
from noack.core.errors import ExitStatus


class AdversaryAim(StrEnum):
    """What ``noack adversary`` may maximise."""

    ERROR = "error"
    STATE = "state"
    COST = "cost"
    INTER_EVENT = "inter-event"
    ALL = "all"


@cli.command(cli.THEORY, 20, [
    ("noack adversary lane_following", "all objectives"),
    ("noack adversary lane_following --objective error --json", "the controller's error only"),
    ("noack adversary unstable_pendulum --horizon 2 --beam 64", "a faster search"),
    ("noack adversary lane_following --trigger continuous", "the paper's loop, in exact time"),
])  # fmt: skip
def adversary(
    scenario: cli.ScenarioArgument,
    *,
    objective: Annotated[
        AdversaryAim,
        typer.Option(
            help="Maximise the controller's error ‖e_c‖, the state ‖x‖ or the cost ∫‖x‖² dt, or "
            "minimise the inter-event time."
        ),
    ] = AdversaryAim.ALL,
    horizon: Annotated[
        float | None, typer.Option(help="Seconds to search; the scenario's horizon by default.")
    ] = None,
    nodes: Annotated[
        int,
        typer.Option(
            help="Limit of the exhaustive search, in segments between events; at the limit, the "
            "result of the beam search may be better.",
            min=0,
        ),
    ] = 500_000,
    beam: Annotated[int, typer.Option(help="Width of the beam search, in runs.", min=0)] = 512,
    trigger: cli.TriggerOption = cli.TriggerMode.SAMPLED,
    settings: cli.SetOption = None,
    json: cli.JsonOption = False,
) -> int:
    """Search for the worst losses that the network may cause; compare them with the bounds.

    The loop is that of the processes; with --trigger continuous it is the paper's, without delays.
    Exit status 1: a certified bound was exceeded.
    """
    from cosim.analysis.adversary import Objective, conditions_of, find_worst
    from cosim.analysis.adversary.worst_run import document, print_worst
    from cosim.live.progress import search_status
    from noack.config.resolution import resolve
    from noack.theory.certificates.scenario_certificates import certify

    given = [] if horizon is None else [f"horizon_s={horizon}"]
    resolved = resolve(cli.load_scenario(scenario, [*(settings or ()), *given]))
    continuous = trigger is cli.TriggerMode.CONTINUOUS
    certificate = certify(resolved, conditions_of(resolved, continuous=continuous))
    aims = list(Objective) if objective is AdversaryAim.ALL else [Objective(objective.value)]
    with search_status() as report:
        found = [
            find_worst(
                resolved, aim, continuous=continuous, most_nodes=nodes, beam=beam,
                certificate=certificate, report=report(aim.value),
            )
            for aim in aims
        ]  # fmt: skip
    if json:
        cli.print_json(document(found, resolved, certificate, trigger.value))
    else:
        print_worst(cli.console(), found, resolved, certificate, trigger.value)
    return ExitStatus.FAILED if any(worst.breaches for worst in found) else ExitStatus.OK
