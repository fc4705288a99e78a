"""``noack record``, ``plant``, ``sensor``, ``controller``, ``netem``: one terminal per process."""

import typer

from cosim.cli import command as cli
from cosim.cli.execute_run import RunOutput, run_processes


def _examples(role: str) -> list[tuple[str, str]]:
    return [
        (f"noack {role}", "join the run that `noack record` has opened"),
        (f"noack {role} --session two --json", "in another session; print its report as JSON"),
    ]


@cli.command(cli.PROCESSES, 10, [
    ("noack record lane_following", "then start the other four, in any order"),
    ("noack record lane_following --session two --live", "beside another run"),
])  # fmt: skip
def record(
    context: typer.Context,
    scenario: cli.ScenarioArgument,
    *,
    settings: cli.SetOption = None,
    session: cli.SessionOption = "default",
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    live: cli.LiveOption = False,
    report: cli.ReportOption = True,
    verbose: cli.VerboseOption = False,
    json: cli.JsonOption = False,
) -> int:
    """Open a run and record it; the other four processes join from other terminals."""
    from noack.protocol.topology import RECORDER

    output = RunOutput(report, verbose, json)
    return run_processes(
        lambda: cli.load_scenario(scenario, settings), runs, output,
        spawn=(RECORDER,), session=session, live=live, server=context.obj,
    )  # fmt: skip


@cli.command(cli.PROCESSES, 20, _examples("plant"))
def plant(*, session: cli.SessionOption = "default", json: cli.JsonOption = False) -> int:
    """Join the open run as the plant: integrates the state, sends measurements."""
    from plant_server.__main__ import main

    return main(_process_arguments(session, json=json))


@cli.command(cli.PROCESSES, 30, _examples("sensor"))
def sensor(*, session: cli.SessionOption = "default", json: cli.JsonOption = False) -> int:
    """Join the open run as the sensor: runs x_s and the trigger, sends updates."""
    from sensor_node.__main__ import main

    return main(_process_arguments(session, json=json))


@cli.command(cli.PROCESSES, 40, _examples("controller"))
def controller(*, session: cli.SessionOption = "default", json: cli.JsonOption = False) -> int:
    """Join the open run as the controller: runs x_c, sends u = K x_c."""
    from controller_node.__main__ import main

    return main(_process_arguments(session, json=json))


@cli.command(
    cli.PROCESSES, 50,
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    add_help_option=False,
)  # fmt: skip
def netem(context: typer.Context) -> int:
    """Join the open run as the network; or relay any UDP program: `noack netem --help`."""
    from netem.__main__ import main

    return main(context.args)


def _process_arguments(session: str, *, json: bool) -> list[str]:
    return ["--session", session, *(["--json"] if json else [])]
