"""``noack margin``: the losses that a loop tolerates, whatever its sensor measures."""

from typing import Annotated

import typer

from cosim.cli import command as cli
from noack.core.errors import CallerError, ExitStatus


@cli.command(cli.THEORY, 30, [
    ("noack margin lane_periodic", "the largest M and the longest period"),
    ("noack margin lane_periodic --play", "play the destabilising pattern live"),
    ("noack margin lane_periodic --set mode=zoh --no-period --json", "hold the input; as JSON"),
])  # fmt: skip
def margin(
    context: typer.Context,
    scenario: cli.ScenarioArgument,
    *,
    settings: cli.SetOption = None,
    most: Annotated[int, typer.Option(help="Largest M to examine.", min=1, max=1000)] = 16,
    accuracy: Annotated[
        float,
        typer.Option(help="Wanted ratio of the bounds, minus 1; finer where they include 1."),
    ] = 2e-4,
    period: Annotated[
        bool, typer.Option(help="Search for the longest period with the scenario's own M, too.")
    ] = True,
    play: Annotated[
        bool, typer.Option("--play", help="Play the destabilising pattern in a live run.")
    ] = False,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    tables: cli.TablesOption = None,
    json: cli.JsonOption = False,
) -> int:
    """Find the largest M for which a loop is stable under every loss pattern.

    The trigger policy must have a longest time between two events, as periodic and deadline have.
    The verdict holds for all times of events that the policy
    allows. Exit status 1: the loop is not proven stable for
    any M.
    """
    from cosim.analysis.margin_search import find_margin
    from cosim.live.progress import PatientConsole
    from cosim.output.certificate_report import margin_tables, print_margin
    from noack.config.resolution import resolve

    if play and json:
        raise CallerError("--play: has an output of its own; leave out --json")
    resolved = resolve(cli.load_scenario(scenario, settings))
    with PatientConsole(stderr=True).status("examining") as status:
        found = find_margin(
            resolved, most_m=most, accuracy=accuracy, with_period=period,
            progress=lambda text: status.update(f"examining {text}"),
        )  # fmt: skip
    if json:
        cli.print_json(found.to_json())
    else:
        print_margin(cli.console(), found)
    cli.write_tables(margin_tables(found), tables, json=json)
    if not play:
        return ExitStatus.OK if found.stable_m else ExitStatus.FAILED
    if found.destabilised is None:
        raise CallerError(f"--play: no destabilising pattern was found for M up to {most}")

    from cosim.cli.execute_run import RunOutput, run_processes

    played = [*(settings or ()), *found.destabilised.settings]
    output = RunOutput(report=True, verbose=False, json=False)
    return run_processes(
        lambda: cli.load_scenario(scenario, played), runs, output, server=context.obj
    )
