"""The command line ``noack``."""

import io
import os
import sys
from collections.abc import Callable, Sequence
from enum import StrEnum
from functools import wraps
from importlib.metadata import version
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from cosim.run_dir import RECORDING_FILE, latest_run
from noack.errors import CallerError, ExitStatus, NoackError
from noack.scenario import Scenario
from noack.scenario_file import dumps as scenario_toml
from noack.scenario_file import json_schema, load
from noack.topology import RECORDER, ROLES

if TYPE_CHECKING:
    from cosim.launch import Ending

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    help="A laboratory for event-triggered control over lossy networks, without acknowledgements: "
    "real processes, real UDP sockets, at most M − 1 packets lost in a row.",
)

_RUNS = "Runs"
_THEORY = "Theory"
_PROCESSES = "One process each, for a person with five terminals"
_FILES = "Scenario files"

ScenarioArgument = Annotated[
    str, typer.Argument(help="Scenario file (TOML), or the name of a shipped scenario.")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="Replace a value of the scenario, e.g. trigger.beta=0.3."
    ),
]
RunsOption = Annotated[Path, typer.Option("--runs", help="Where run directories are made.")]
LiveOption = Annotated[bool, typer.Option("--live", help="Show the run in the rerun viewer.")]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print one JSON document, and nothing else, on stdout.")
]
SessionOption = Annotated[
    str, typer.Option("--session", help="Name of the session that the processes meet in.")
]

DEFAULT_RUNS = Path("runs")


def _version(asked: bool) -> None:
    if asked:
        print(f"noack {version('noack')}")
        raise typer.Exit


@app.callback()
def options(
    _: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Take the options before the command."""


def command(panel: str, **settings: Any) -> Callable[[Callable[..., int]], Callable[..., None]]:
    """Register a command; its result is the exit status, and a mistake becomes one line."""

    def register(function: Callable[..., int]) -> Callable[..., None]:
        @wraps(function)
        def reported(*arguments: Any, **options: Any) -> None:
            try:
                status = function(*arguments, **options)
                sys.stdout.flush()
            except NoackError as error:
                status = _failed(str(error), error.exit_status)
            except OSError as error:  # standard output is a full disk or a closed pipe
                status = _failed(f"cannot write: {error}", ExitStatus.FAILED)
            raise typer.Exit(int(status))

        registered: Callable[..., None] = app.command(rich_help_panel=panel, **settings)(reported)
        return registered

    return register


def find_scenario(name: str) -> Path:
    """Return the path of a scenario given by path, or by the name of a shipped one."""
    path = Path(name)
    if path.exists() or path.suffix == ".toml":
        return path
    here = Path(__file__).parent
    for folder in (here.parent / "scenarios", here / "scenarios"):
        if (shipped := folder / f"{name}.toml").is_file():
            inside = shipped.is_relative_to(Path.cwd())
            return shipped.relative_to(Path.cwd()) if inside else shipped
        if folder.is_dir() and not path.parent.name:
            names = ", ".join(sorted(file.stem for file in folder.glob("*.toml")))
            raise CallerError(f"{name}: no such file, nor a shipped scenario; there are {names}")
    return path


@command(_RUNS)
def run(
    scenario: ScenarioArgument,
    settings: SetOption = None,
    runs: RunsOption = DEFAULT_RUNS,
    live: LiveOption = False,
    json: JsonOption = False,
) -> int:
    """Run a scenario: start all processes, watch them, record everything."""
    loaded = load(find_scenario(scenario), settings or ())
    return _run(loaded, runs, ROLES, None, live=live, json=json)


@command(_RUNS)
def demo(
    zoh: Annotated[bool, typer.Option("--zoh", help="Hold the last update; no model.")] = False,
    settings: SetOption = None,
    runs: RunsOption = DEFAULT_RUNS,
    live: LiveOption = False,
    json: JsonOption = False,
) -> int:
    """Run the paper's lane-following example in real time."""
    mode = ['mode="zoh"'] if zoh else []
    loaded = load(find_scenario("lane_following"), [*mode, *(settings or ())])
    return _run(loaded, runs, ROLES, None, live=live, json=json)


class Trigger(StrEnum):
    """When a simulated sensor looks at the threshold."""

    SAMPLED = "sampled"
    CONTINUOUS = "continuous"


@command(_RUNS)
def simulate(
    scenario: ScenarioArgument,
    settings: SetOption = None,
    trigger: Annotated[
        Trigger,
        typer.Option(help="sampled: at each measurement, as a live run; continuous: at all times."),
    ] = Trigger.SAMPLED,
    runs: RunsOption = DEFAULT_RUNS,
    json: JsonOption = False,
) -> int:
    """Run a scenario in virtual time: the same machines and losses, no sockets, never late."""
    loaded = load(find_scenario(scenario), settings or ())
    if trigger is Trigger.CONTINUOUS:
        return _simulate_continuously(loaded, json=json)
    from cosim.progress import PatientConsole, simulation_bar
    from cosim.simulated_run import simulate_run

    _warn_of_violations(loaded)
    with simulation_bar(PatientConsole(stderr=True), loaded.horizon_s) as progress:
        ending = simulate_run(loaded, runs, progress=progress)
    return _conclude(ending, json=json)


@command(_RUNS)
def view(
    recording: Annotated[
        Path | None, typer.Argument(help="A run directory or .rrd file; by default the last run.")
    ] = None,
    runs: RunsOption = DEFAULT_RUNS,
    json: JsonOption = False,
) -> int:
    """Open a recording in the rerun viewer."""
    from cosim.viewer.live import view_recording

    path = recording or latest_run(runs)
    path = path / RECORDING_FILE if path.is_dir() else path
    if json:
        _print_json({"recording": str(path), "exists": path.is_file()})
        return ExitStatus.OK if path.is_file() else ExitStatus.CALLER
    view_recording(path)
    return ExitStatus.OK


@command(_RUNS)
def summary(
    run_dir: Annotated[
        Path | None, typer.Argument(help="A run directory; by default the last run.")
    ] = None,
    runs: RunsOption = DEFAULT_RUNS,
    json: JsonOption = False,
) -> int:
    """Show what became of a run; finishes the record of one that was cut short."""
    from cosim.conclude import reopen
    from cosim.tables import print_outcome

    outcome = reopen(run_dir or latest_run(runs))
    if json:
        _print_json(outcome.summary)
    else:
        print_outcome(Console(), outcome)
    return ExitStatus.OK


@command(_RUNS)
def replay(
    run_dir: Annotated[
        Path | None, typer.Argument(help="A run directory; by default the last run.")
    ] = None,
    runs: RunsOption = DEFAULT_RUNS,
    json: JsonOption = False,
) -> int:
    """Feed every machine of a run its recorded inputs again; compare the outputs bit for bit."""
    from cosim.environment import changed_since
    from cosim.progress import PatientConsole
    from cosim.record import load_record
    from cosim.replay import replay as replay_record
    from cosim.replay.table import print_replay

    path = run_dir or latest_run(runs)
    with PatientConsole(stderr=True).status("replaying"):
        found = replay_record(load_record(path))
    changed = changed_since(path)
    if json:
        _print_json(found.document() | {"changed_since": changed})
    else:
        print_replay(Console(), found, changed)
    return ExitStatus.OK if found.bit_exact else ExitStatus.FAILED


@command(_RUNS)
def compare(
    run_dir: Annotated[
        Path | None, typer.Argument(help="A run directory; by default the last run.")
    ] = None,
    runs: RunsOption = DEFAULT_RUNS,
    json: JsonOption = False,
) -> int:
    """Compare a run with the paper's loop in continuous time, effect by effect."""
    from cosim.fidelity import compare as compare_record
    from cosim.fidelity_table import print_fidelity
    from cosim.progress import PatientConsole
    from cosim.record import load_record

    path = run_dir or latest_run(runs)
    with PatientConsole(stderr=True).status("comparing"):
        fidelity = compare_record(load_record(path))
    if json:
        _print_json(fidelity.as_json())
    else:
        print_fidelity(Console(), fidelity)
    return ExitStatus.OK if fidelity.explained else ExitStatus.FAILED


@command(_RUNS)
def report(
    run_dir: Annotated[
        Path | None, typer.Argument(help="A run directory; by default the last run.")
    ] = None,
    runs: RunsOption = DEFAULT_RUNS,
    json: JsonOption = False,
) -> int:
    """Write a run's report anew, one page with all figures, and print where it is."""
    from cosim.conclude import report_anew

    path = report_anew(run_dir or latest_run(runs))
    if json:
        _print_json({"report": str(path)})
    else:
        print(path)
    return ExitStatus.OK


@command(_THEORY)
def certify(
    scenario: ScenarioArgument,
    settings: SetOption = None,
    weight: Annotated[
        str,
        typer.Option(
            help="The trigger's norm: `given` by the scenario, `identity`, or `chosen` here."
        ),
    ] = "given",
    late: Annotated[
        int | None,
        typer.Option(help="Steps of the plant by which the schedule may be late.", min=0, max=1000),
    ] = None,
    json: JsonOption = False,
) -> int:
    """Say what is guaranteed of a scenario, with which constants, under which conditions."""
    from cosim.certify import print_study, study, with_weight
    from cosim.progress import work_bar
    from noack.resolve import resolve

    resolved = resolve(load(find_scenario(scenario), settings or ()))
    allowed = resolved.certificate.late_periods if late is None else late
    with work_bar("choosing the weight") as progress:
        weighted, chosen = with_weight(resolved, weight, progress)
    found = study(weighted, allowed, chosen)
    if json:
        _print_json(found.to_json())
    else:
        print_study(Console(), found)
    certified = any(certificate.constants for _, certificate in found.certificates)
    return ExitStatus.OK if certified else ExitStatus.FAILED


@command(_RUNS)
def paper(
    draws: Annotated[int, typer.Option(help="Draws of plant, losses and initial state.")] = 1000,
    out: Annotated[
        Path, typer.Option("--out", help="Folder for paper.md, and for figures/ in it.")
    ] = DEFAULT_RUNS / "paper",
    json: JsonOption = False,
) -> int:
    """Reproduce the paper's Section V over many draws: a page with figures, tables and verdicts."""
    from cosim.paper.table import print_claims
    from cosim.paper.write import document, make_folder, reproduce, write_page
    from cosim.progress import PatientConsole, draws_bar

    path = find_scenario("lane_following")
    make_folder(out)
    with draws_bar(PatientConsole(stderr=True)) as progress:
        results = reproduce(path, draws, _cores(), progress)
    found = document(results, write_page(path, results, out))
    if json:
        _print_json(found)
    else:
        print_claims(Console(), found)
    return ExitStatus.OK


class AdversaryAim(StrEnum):
    """What ``noack adversary`` may look for."""

    ERROR = "error"
    STATE = "state"
    COST = "cost"
    INTER_EVENT = "inter-event"
    ALL = "all"


@command(_THEORY)
def adversary(
    scenario: ScenarioArgument,
    objective: Annotated[
        AdversaryAim,
        typer.Option(
            help="What is to be as bad as possible: the controller's error, the state, "
            "the integral of its square, or the time between two events."
        ),
    ] = AdversaryAim.ALL,
    horizon: Annotated[
        float | None, typer.Option(help="Seconds to look ahead; the scenario's unless given.")
    ] = None,
    nodes: Annotated[
        int, typer.Option(help="Try all patterns, up to so many segments between events.", min=0)
    ] = 500_000,
    beam: Annotated[
        int, typer.Option(help="Runs that the beam search carries along.", min=0)
    ] = 512,
    settings: SetOption = None,
    json: JsonOption = False,
) -> int:
    """Search the losses that the network may make for the worst, and how near bounds come to it."""
    from cosim.adversary import Objective, find_worst
    from cosim.adversary.report import document, print_worst
    from cosim.progress import search_status
    from noack.resolve import resolve
    from noack.theory.certify import certify, ideal_conditions

    given = [] if horizon is None else [f"horizon_s={horizon}"]
    resolved = resolve(load(find_scenario(scenario), [*(settings or ()), *given]))
    certificate = certify(resolved, ideal_conditions(resolved))
    aims = list(Objective) if objective is AdversaryAim.ALL else [Objective(objective.value)]
    with search_status() as report:
        found = [
            find_worst(
                resolved, aim, most_nodes=nodes, beam=beam, certificate=certificate,
                report=report(aim.value),
            )
            for aim in aims
        ]  # fmt: skip
    if json:
        _print_json(document(found, resolved, certificate))
    else:
        print_worst(Console(), found, resolved, certificate)
    refuted = any(worst.breaches for worst in found)
    return ExitStatus.FAILED if refuted else ExitStatus.OK


@command(_PROCESSES)
def record(
    scenario: ScenarioArgument,
    settings: SetOption = None,
    session: SessionOption = "default",
    runs: RunsOption = DEFAULT_RUNS,
    live: LiveOption = False,
    json: JsonOption = False,
) -> int:
    """Open a run and record it; the other four processes join from other terminals."""
    loaded = load(find_scenario(scenario), settings or ())
    return _run(loaded, runs, (RECORDER,), session, live=live, json=json)


@command(_PROCESSES)
def plant(session: SessionOption = "default", json: JsonOption = False) -> int:
    """Join the open run as the plant: owns the true state, sends measurements."""
    from plant_server.__main__ import main

    return main(_process_arguments(session, json=json))


@command(_PROCESSES)
def sensor(session: SessionOption = "default", json: JsonOption = False) -> int:
    """Join the open run as the sensor: runs x_s and the trigger, sends updates."""
    from sensor_node.__main__ import main

    return main(_process_arguments(session, json=json))


@command(_PROCESSES)
def controller(session: SessionOption = "default", json: JsonOption = False) -> int:
    """Join the open run as the controller: runs x_c, sends u = K x_c."""
    from controller_node.__main__ import main

    return main(_process_arguments(session, json=json))


@command(
    _PROCESSES,
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    add_help_option=False,
)
def netem(context: typer.Context) -> int:
    """Join the open run as the lossy network; or serve any UDP program (`noack netem --help`)."""
    from netem.__main__ import main

    return main(context.args)


@command(_FILES)
def check(scenario: ScenarioArgument, settings: SetOption = None, json: JsonOption = False) -> int:
    """Check a scenario and print it resolved: defaults, named models and draws made explicit."""
    from cosim.tables import print_assumptions
    from noack.resolve import resolve
    from noack.theory.assumptions import assumptions

    resolved = resolve(load(find_scenario(scenario), settings or ()))
    verdicts = [assumption._asdict() for assumption in assumptions(resolved)]
    print_assumptions(Console(stderr=True), verdicts)
    if json:
        _print_json(resolved.model_dump(mode="json"))
    else:
        print(scenario_toml(resolved), end="")
    return ExitStatus.OK


@command(_FILES)
def schema(json: JsonOption = False) -> int:
    """Print the JSON Schema of scenario files, for editors."""
    _print_json(json_schema())
    return ExitStatus.OK


def _run(
    scenario: Scenario,
    runs: Path,
    spawn: Sequence[str],
    session: str | None,
    *,
    live: bool,
    json: bool,
) -> int:
    # Each process of a run waits for the slowest: what is not needed yet is imported later.
    from cosim.launch import launch
    from cosim.progress import PatientConsole, progress_line

    _warn_of_violations(scenario)
    ending = None
    try:
        with progress_line(PatientConsole(stderr=True), scenario) as watcher:
            ending = launch(
                scenario, runs, spawn=spawn, session=session, live=live, watcher=watcher
            )
    except OSError:  # a closed terminal is no reason to lose a run
        if ending is None:
            raise
    return _conclude(ending, json=json)


def _simulate_continuously(scenario: Scenario, *, json: bool) -> int:
    from cosim.exact.report import document, print_run, run_continuous
    from cosim.progress import PatientConsole
    from noack.resolve import resolve

    _warn_of_violations(scenario)
    resolved = resolve(scenario)
    with PatientConsole(stderr=True).status("simulating"):
        run = run_continuous(resolved)
    if json:
        _print_json(document(run, resolved))
    else:
        print_run(Console(), run, resolved)
    return ExitStatus.OK if run.diverged_at_s is None else ExitStatus.FAILED


def _warn_of_violations(scenario: Scenario) -> None:
    from noack.resolve import resolve
    from noack.theory.assumptions import Verdict, assumptions

    for assumption in assumptions(resolve(scenario)):
        if assumption.verdict == Verdict.VIOLATED and assumption.source == "Theorem 2":
            print(f"noack: warning: violated: {assumption.what}: {assumption.why}", file=sys.stderr)


def _conclude(ending: "Ending", *, json: bool) -> int:
    from cosim.conclude import conclude
    from cosim.tables import print_outcome

    outcome = conclude(ending)
    if json:
        _print_json(outcome.summary)
    else:
        print_outcome(Console(), outcome)
    return outcome.status


def _process_arguments(session: str, *, json: bool) -> list[str]:
    return ["--session", session, *(["--json"] if json else [])]


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def _print_json(document: object) -> None:
    print(dumps(document, indent=2, allow_nan=False))


def _failed(message: str, status: ExitStatus) -> ExitStatus:
    if "--json" in sys.argv:
        _print_json({"error": message, "exit": {"status": int(status), "reason": message}})
    for line in message.splitlines():
        print(f"noack: {line}", file=sys.stderr)
    return status


def main() -> None:
    """Entry point."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal that cannot show ‖x‖ gets ?x?
            stream.reconfigure(errors="replace")
    try:
        app()
    except KeyboardInterrupt:
        sys.exit(ExitStatus.INTERRUPTED)


if __name__ == "__main__":
    main()
