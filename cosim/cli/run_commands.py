"""Commands on runs: make one, live or simulated; view it, replay it, measure it."""

import sys
from collections.abc import Callable, Sequence
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from cosim.cli import completion
from cosim.cli.command import (
    RUNS,
    JsonOption,
    LiveOption,
    ReportOption,
    RunArgument,
    RunsOption,
    ScenarioArgument,
    SetOption,
    VerboseOption,
    command,
    find_scenario,
    print_json,
)
from cosim.record.run_directory import DEFAULT_RUNS, RECORDING_FILE, chosen_run
from noack.config.scenario import Scenario
from noack.config.scenario_file import load
from noack.core.errors import ExitStatus
from noack.protocol.topology import ROLES

if TYPE_CHECKING:
    from cosim.record.run_ending import RunEnding


@command(RUNS, [
    ("noack run lane_following", "the paper's example, 20 s"),
    ("noack run unstable_pendulum --set horizon_s=5 --live", "5 s, with the live viewer"),
    ("noack run lane_following --set network.mansd=9 --json", "its summary, as JSON"),
])  # fmt: skip
def run(
    scenario: ScenarioArgument,
    settings: SetOption = None,
    runs: RunsOption = DEFAULT_RUNS,
    live: LiveOption = False,
    report: ReportOption = True,
    verbose: VerboseOption = False,
    json: JsonOption = False,
) -> int:
    """Run a scenario: start all processes, watch them, record everything."""
    loaded = load(find_scenario(scenario), settings or ())
    end = partial(finalize_run, report=report, verbose=verbose, json=json)
    return run_processes(loaded, runs, ROLES, None, live=live, end=end)


@command(RUNS, [
    ("noack demo", "20 s; a verdict at the end, all kept in runs/latest"),
    ("noack demo --zoh --live", "a hold instead of a model, in the viewer"),
    ("noack demo --set speed=4 --set horizon_s=8", "2 s of wall time"),
])  # fmt: skip
def demo(
    zoh: Annotated[bool, typer.Option("--zoh", help="Hold the last update; no model.")] = False,
    settings: SetOption = None,
    runs: RunsOption = DEFAULT_RUNS,
    live: LiveOption = False,
    report: ReportOption = True,
    verbose: VerboseOption = False,
    json: JsonOption = False,
) -> int:
    """Run the paper's lane-following example in real time."""
    mode = ['mode="zoh"'] if zoh else []
    loaded = load(find_scenario("lane_following"), [*mode, *(settings or ())])
    end = partial(finalize_run, report=report, verbose=verbose, json=json)
    return run_processes(loaded, runs, ROLES, None, live=live, end=end)


class TriggerMode(StrEnum):
    """When a simulated sensor looks at the threshold."""

    SAMPLED = "sampled"
    CONTINUOUS = "continuous"


@command(RUNS, [
    ("noack simulate lane_following", "the machines of a live run"),
    ("noack simulate lane_following --trigger continuous", "the paper's loop"),
    ("noack simulate reactor_petc --no-report --json", "for a program"),
])  # fmt: skip
def simulate(
    scenario: ScenarioArgument,
    settings: SetOption = None,
    trigger: Annotated[
        TriggerMode,
        typer.Option(help="sampled: at each measurement, as a live run; continuous: at all times."),
    ] = TriggerMode.SAMPLED,
    runs: RunsOption = DEFAULT_RUNS,
    report: ReportOption = True,
    verbose: VerboseOption = False,
    json: JsonOption = False,
) -> int:
    """Run a scenario in virtual time: the same machines and losses, no sockets, never late."""
    loaded = load(find_scenario(scenario), settings or ())
    if trigger is TriggerMode.CONTINUOUS:
        return _simulate_continuously(loaded, json=json)
    from cosim.live.progress import PatientConsole, simulation_bar
    from cosim.live.simulated_run import simulate_run

    _warn_of_violations(loaded)
    with simulation_bar(PatientConsole(stderr=True), loaded.horizon_s) as progress:
        ending = simulate_run(loaded, runs, progress=progress)
    return finalize_run(ending, report=report, verbose=verbose, json=json)


@command(RUNS, [
    ("noack view", "the last run, in a window where there is a display"),
    ("noack view runs/latest --web", "in a browser on this machine"),
])  # fmt: skip
def view(
    recording: Annotated[
        Path | None,
        typer.Argument(
            help="A run directory or .rrd file; by default the last run.",
            autocompletion=completion.run_directories,
        ),
    ] = None,
    runs: RunsOption = DEFAULT_RUNS,
    web: Annotated[
        bool, typer.Option("--web", help="Serve it to a browser on this machine; no window.")
    ] = False,
    json: JsonOption = False,
) -> int:
    """Open a recording in the rerun viewer."""
    from cosim.output.viewer.live_viewer import view_recording

    path = chosen_run(recording, runs)
    path = path / RECORDING_FILE if path.is_dir() else path
    if json:
        print_json({"recording": str(path), "exists": path.is_file()})
        return ExitStatus.OK if path.is_file() else ExitStatus.CALLER
    view_recording(path, native=False if web else None)
    return ExitStatus.OK


@command(RUNS, [
    ("noack summary", "of the last run"),
    ("noack summary --verbose", "all tables: timing, assumptions, each claim"),
    ("noack summary runs/latest --json", "all numbers"),
])  # fmt: skip
def summary(
    run_dir: RunArgument = None,
    runs: RunsOption = DEFAULT_RUNS,
    verbose: VerboseOption = False,
    json: JsonOption = False,
) -> int:
    """Show a run's summary; finalise an interrupted run first."""
    from cosim.live.finalize import reopen
    from cosim.output.run_verdict import print_outcome

    outcome = reopen(chosen_run(run_dir, runs))
    if json:
        print_json(outcome.summary)
    else:
        print_outcome(Console(), outcome, verbose=verbose)
    return ExitStatus.OK


@command(RUNS, [
    ("noack replay", "the last run; exit status 1 if a bit differs"),
    ("noack replay runs/latest --json", ""),
])  # fmt: skip
def replay(
    run_dir: RunArgument = None,
    runs: RunsOption = DEFAULT_RUNS,
    json: JsonOption = False,
) -> int:
    """Feed every machine of a run its recorded inputs again; compare the outputs bit for bit."""
    from cosim.analysis.replay import replay as replay_record
    from cosim.analysis.replay.replay_table import print_replay
    from cosim.live.progress import PatientConsole
    from cosim.record.environment import changed_since
    from cosim.record.run_record import load_record

    path = chosen_run(run_dir, runs)
    with PatientConsole(stderr=True).status("replaying"):
        found = replay_record(load_record(path))
    changed = changed_since(path)
    if json:
        print_json(found.document() | {"changed_since": changed})
    else:
        print_replay(Console(), found, changed)
    return ExitStatus.OK if found.bit_exact else ExitStatus.FAILED


@command(RUNS, [
    ("noack fidelity", "sampling, delay and hold of the last run, in numbers"),
    ("noack fidelity runs/latest --json", ""),
])  # fmt: skip
def fidelity(
    run_dir: RunArgument = None,
    runs: RunsOption = DEFAULT_RUNS,
    json: JsonOption = False,
) -> int:
    """Compare a run with the ideal loop in continuous time, effect by effect."""
    from cosim.analysis.fidelity import compute_fidelity
    from cosim.live.progress import PatientConsole
    from cosim.output.fidelity_table import print_fidelity
    from cosim.record.run_record import load_record

    path = chosen_run(run_dir, runs)
    with PatientConsole(stderr=True).status("comparing"):
        found = compute_fidelity(load_record(path))
    if json:
        print_json(found.as_json())
    else:
        print_fidelity(Console(), found)
    return ExitStatus.OK if found.explained else ExitStatus.FAILED


@command(RUNS, [
    ("noack report", "of the last run; prints the page's path"),
    ("noack report runs/latest --json", ""),
])  # fmt: skip
def report(
    run_dir: RunArgument = None,
    runs: RunsOption = DEFAULT_RUNS,
    json: JsonOption = False,
) -> int:
    """Write a run's report anew, one page with all figures, and print where it is."""
    from cosim.live.finalize import rewrite_report

    path = rewrite_report(chosen_run(run_dir, runs))
    if json:
        print_json({"report": str(path)})
    else:
        print(path)
    return ExitStatus.OK


def run_processes(
    scenario: Scenario,
    runs: Path,
    spawn: Sequence[str],
    session: str | None,
    *,
    live: bool,
    end: Callable[["RunEnding"], int],
) -> int:
    """Run a scenario with the processes ``spawn``; the others join by ``session``.

    ``end`` concludes the run, and gives the exit status.
    """
    # Each process of a run waits for the slowest: what is not needed yet is imported later.
    from cosim.live.launcher import launch
    from cosim.live.progress import PatientConsole, progress_line

    _warn_of_violations(scenario)
    ending = None
    try:
        with progress_line(PatientConsole(stderr=True), scenario, session) as watcher:
            ending = launch(
                scenario, runs, spawn=spawn, session=session, live=live, watcher=watcher
            )
    except OSError:  # a closed terminal is no reason to lose a run
        if ending is None:
            raise
    return end(ending)


def _simulate_continuously(scenario: Scenario, *, json: bool) -> int:
    from cosim.live.progress import PatientConsole
    from cosim.simulation.continuous.continuous_report import (
        document,
        print_run,
        run_continuous,
        summary,
    )
    from noack.config.resolution import resolve

    _warn_of_violations(scenario)
    resolved = resolve(scenario)
    with PatientConsole(stderr=True).status("simulating"):
        run = run_continuous(resolved)
    if json:
        print_json(document(run, resolved))
    else:
        print_run(Console(), run, resolved)
    return ExitStatus(summary(run, resolved)["exit"]["status"])


def _warn_of_violations(scenario: Scenario) -> None:
    from noack.config.resolution import resolve
    from noack.theory.assumptions import AssumptionStatus, assumptions

    for assumption in assumptions(resolve(scenario)):
        if assumption.verdict == AssumptionStatus.VIOLATED and assumption.source == "Theorem 2":
            print(f"noack: warning: violated: {assumption.what}: {assumption.why}", file=sys.stderr)


def finalize_run(ending: "RunEnding", *, report: bool, verbose: bool, json: bool) -> int:
    """Finish a run's record, print its verdict, and return its exit status."""
    from cosim.live.finalize import finalize
    from cosim.live.progress import PatientConsole
    from cosim.output.run_verdict import print_outcome

    # Of a run of an hour this takes minutes.
    with PatientConsole(stderr=True).status("replaying the run and judging its claims"):
        outcome = finalize(ending, report=report)
    if json:
        print_json(outcome.summary)
    else:
        print_outcome(Console(), outcome, verbose=verbose)
    return outcome.status
