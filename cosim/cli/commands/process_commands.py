"""``noack record``, ``plant``, ``sensor``, ``controller``, ``netem``: one terminal per process."""

import typer

from cosim.cli.command import (
    PROCESSES,
    JsonOption,
    LiveOption,
    ReportOption,
    RunsOption,
    ScenarioArgument,
    SessionOption,
    SetOption,
    VerboseOption,
    command,
    find_scenario,
)
from cosim.cli.execute_run import RunOutput, run_processes
from cosim.record.run_directory import DEFAULT_RUNS
from noack.config.scenario_file import load
from noack.protocol.topology import RECORDER


def _examples(role: str) -> list[tuple[str, str]]:
    return [
        (f"noack {role}", "join the run that `noack record` has opened"),
        (f"noack {role} --session two --json", "in another session; print its report as JSON"),
    ]


@command(PROCESSES, 10, [
    ("noack record lane_following", "then start the other four, in any order"),
    ("noack record lane_following --session two --live", "beside another run"),
])  # fmt: skip
def record(
    scenario: ScenarioArgument,
    *,
    settings: SetOption = None,
    session: SessionOption = "default",
    runs: RunsOption = DEFAULT_RUNS,
    live: LiveOption = False,
    report: ReportOption = True,
    verbose: VerboseOption = False,
    json: JsonOption = False,
) -> int:
    """Open a run and record it; the other four processes join from other terminals."""
    loaded = load(find_scenario(scenario), settings or ())
    output = RunOutput(report, verbose, json)
    return run_processes(loaded, runs, output, spawn=(RECORDER,), session=session, live=live)


@command(PROCESSES, 20, _examples("plant"))
def plant(*, session: SessionOption = "default", json: JsonOption = False) -> int:
    """Join the open run as the plant: integrates the state, sends measurements."""
    from plant_server.__main__ import main

    return main(_process_arguments(session, json=json))


@command(PROCESSES, 30, _examples("sensor"))
def sensor(*, session: SessionOption = "default", json: JsonOption = False) -> int:
    """Join the open run as the sensor: runs x_s and the trigger, sends updates."""
    from sensor_node.__main__ import main

    return main(_process_arguments(session, json=json))


@command(PROCESSES, 40, _examples("controller"))
def controller(*, session: SessionOption = "default", json: JsonOption = False) -> int:
    """Join the open run as the controller: runs x_c, sends u = K x_c."""
    from controller_node.__main__ import main

    return main(_process_arguments(session, json=json))


@command(
    PROCESSES, 50,
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    add_help_option=False,
)  # fmt: skip
def netem(context: typer.Context) -> int:
    """Join the open run as the network; or relay any UDP program: `noack netem --help`."""
    from netem.__main__ import main

    return main(context.args)


def _process_arguments(session: str, *, json: bool) -> list[str]:
    return ["--session", session, *(["--json"] if json else [])]
