"""Commands for a person with five terminals: one process each."""

from functools import partial

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
from cosim.cli.run_commands import finalize_run, run_processes
from cosim.record.run_directory import DEFAULT_RUNS
from noack.config.scenario_file import load
from noack.protocol.topology import RECORDER


@command(PROCESSES, [
    ("noack record lane_following", "then start the other four, in any order"),
    ("noack record lane_following --session two --live", "beside another run"),
])  # fmt: skip
def record(
    scenario: ScenarioArgument,
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
    end = partial(finalize_run, report=report, verbose=verbose, json=json)
    return run_processes(loaded, runs, (RECORDER,), session, live=live, end=end)


@command(PROCESSES, [
    ("noack plant", "joins what `noack record SCENARIO` has opened"),
    ("noack plant --session two --json", "in another session; its report as JSON"),
])  # fmt: skip
def plant(session: SessionOption = "default", json: JsonOption = False) -> int:
    """Join the open run as the plant: owns the true state, sends measurements."""
    from plant_server.__main__ import main

    return main(_process_arguments(session, json=json))


@command(PROCESSES, [
    ("noack sensor", "joins what `noack record SCENARIO` has opened"),
    ("noack sensor --session two --json", "in another session; its report as JSON"),
])  # fmt: skip
def sensor(session: SessionOption = "default", json: JsonOption = False) -> int:
    """Join the open run as the sensor: runs x_s and the trigger, sends updates."""
    from sensor_node.__main__ import main

    return main(_process_arguments(session, json=json))


@command(PROCESSES, [
    ("noack controller", "joins what `noack record SCENARIO` has opened"),
    ("noack controller --session two --json", "in another session; its report as JSON"),
])  # fmt: skip
def controller(session: SessionOption = "default", json: JsonOption = False) -> int:
    """Join the open run as the controller: runs x_c, sends u = K x_c."""
    from controller_node.__main__ import main

    return main(_process_arguments(session, json=json))


@command(
    PROCESSES,
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    add_help_option=False,
)
def netem(context: typer.Context) -> int:
    """Join the open run as the lossy network; or serve any UDP program (`noack netem --help`)."""
    from netem.__main__ import main

    return main(context.args)


def _process_arguments(session: str, *, json: bool) -> list[str]:
    return ["--session", session, *(["--json"] if json else [])]
