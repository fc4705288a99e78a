"""``noack demo``, ``run``, ``simulate``: make a run; ``set``: change a live one."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from cosim.cli import options as opt
from cosim.cli.options import RUNS, examples
from cosim.cli.printing import console, print_json
from cosim.record.run_directory import DEFAULT_RUNS
from netem.core.command_line import LogFormat, print_to_stderr

app = typer.Typer()


@app.command(
    rich_help_panel=RUNS,
    epilog=examples(
        ("noack demo", "20 s; the record is in runs/latest"),
        ("noack demo --zoh --live", "zero-order hold, with the live viewer"),
        ("noack demo --set speed=4 --set horizon_s=8", "takes 2 s of wall time"),
    ),
)
def demo(
    zoh: Annotated[
        bool, Option("--zoh", help="Hold the last update (ZOH) instead of using a model.")
    ] = False,
    settings: opt.SetOption = None,
    runs: opt.RunsOption = DEFAULT_RUNS,
    live: opt.LiveOption = False,
    log_format: opt.LogFormatOption = LogFormat.TEXT,
    require: opt.RequireOption = None,
    report: opt.ReportOption = True,
    verbose: opt.VerboseOption = False,
    json: opt.JsonOption = False,
) -> int:
    """Run the paper's lane-following example live.

    Takes 20 s and a few.
    """
    opt.require_linux()
    from cosim.cli.execute_run import run_processes

    loaded = opt.load_scenario("lane_following", [*(['mode="zoh"'] if zoh else []), *(settings or ())])
    return run_processes(
        loaded, runs, live=live, report=report, verbose=verbose, json=json,
        required=require or (),
    )  # fmt: skip


@app.command(
    rich_help_panel=RUNS,
    epilog=examples(
        ("noack run lane_following", "the paper's example, 20 s"),
        ("noack run unstable_pendulum --set horizon_s=5 --live", "5 s, with the live viewer"),
        ("noack run lane_following --set network.mansd=9 --json", "at most 9 lost in a row; print JSON"),
    ),
)
def run(
    scenario: opt.ScenarioArgument,
    settings: opt.SetOption = None,
    network: opt.NetworkOption = None,
    runs: opt.RunsOption = DEFAULT_RUNS,
    live: opt.LiveOption = False,
    log_format: opt.LogFormatOption = LogFormat.TEXT,
    require: opt.RequireOption = None,
    report: opt.ReportOption = True,
    verbose: opt.VerboseOption = False,
    json: opt.JsonOption = False,
) -> int:
    """Run a scenario live: start all processes and record everything.

    Takes as long as the scenario's horizon, and a few seconds.
    """
    opt.require_linux()
    from cosim.cli.execute_run import run_processes

    loaded = opt.load_scenario(scenario, settings, network)
    return run_processes(
        loaded, runs, live=live, report=report, verbose=verbose, json=json,
        required=require or (),
    )  # fmt: skip


@app.command(
    rich_help_panel=RUNS,
    epilog=examples(
        ("noack simulate lane_following", "the processes of a live run, without sockets"),
        (
            "noack simulate lane_following --trigger continuous",
            "the paper's loop, exactly, without delays",
        ),
        ("noack simulate reactor_petc --no-report --json", "print the summary as JSON"),
        ("noack simulate lane_following --require guarantee", "exit status 1 unless it was kept"),
    ),
)
def simulate(
    scenario: opt.ScenarioArgument,
    settings: opt.SetOption = None,
    network: opt.NetworkOption = None,
    trigger: opt.TriggerOption = opt.TriggerMode.SAMPLED,
    runs: opt.RunsOption = DEFAULT_RUNS,
    require: opt.RequireOption = None,
    report: opt.ReportOption = True,
    verbose: opt.VerboseOption = False,
    json: opt.JsonOption = False,
) -> int:
    """Run a scenario in virtual time: no sockets, no deadlines missed.

    The trigger, the losses and the controller are those of a live run.

    Takes about 4 s; with the report, 6 s.
    """
    from cosim.cli.execute_run import finalize_run, simulate_continuously, warn_of_violations
    from cosim.live.monitoring.progress import error_console, simulation_bar
    from cosim.simulation.virtual_time import simulate_run
    from netem.core.command_line import print_to_stderr
    from noack.scenario.arrival_ties import late_inputs, with_later_updates

    loaded = opt.load_scenario(scenario, settings, network)
    warn_of_violations(loaded, is_sampled=trigger is opt.TriggerMode.SAMPLED)
    if trigger is opt.TriggerMode.CONTINUOUS:
        return simulate_continuously(loaded, json=json, required=require or ())
    loaded, tie = with_later_updates(loaded)
    for line in filter(None, (tie, late_inputs(loaded))):
        print_to_stderr(f"noack: {line}")
    with simulation_bar(error_console()) as bar:
        ending = simulate_run(loaded, runs, bar)
    return finalize_run(ending, report=report, verbose=verbose, json=json, required=require or ())


@app.command(
    rich_help_panel=RUNS,
    name="set",
    context_settings={"ignore_unknown_options": True},  # -0.5 is a value
    epilog=examples(
        ("noack set", "list the runtime parameters and their values"),
        ("noack set loss.p 0.9", "lose nine in ten packets from now on"),
        ("noack set mansd 2 trigger.beta 0.3 --json", "at most 2 lost in a row, and another β, at once"),
    ),
)
def set_(
    settings: Annotated[
        list[str] | None,
        Argument(
            metavar="[KEY VALUE]...",
            autocompletion=opt.complete_runtime_parameters,
            help="Keys of the scenario, or their short forms, with new values: loss.p 0.9 mansd 2. "
            "Without keys, list the runtime parameters.",
        ),
    ] = None,
    session: Annotated[str | None, opt.SESSION] = None,
    run: Annotated[
        Path | None,
        Option(
            autocompletion=opt.complete_runs,
            help="Directory of the run; needed if several runs are active.",
        ),
    ] = None,
    json: opt.JsonOption = False,
) -> None:
    """Change a live run: losses, mansd, trigger, set point."""
    opt.require_linux()
    from cosim.cli.live_settings import parse_settings, print_parameters
    from noack.runtime.active_runs import find_run, request_change
    from noack.scenario.runtime_parameters import text_of

    changes = parse_settings(settings or ())
    answer = request_change(find_run(session, run), changes)
    for line in answer.warnings:
        print_to_stderr(f"noack: warning: {line}")
    if json:
        print_json(answer.fields())
    elif changes:
        loops, entries = answer.changed_loops, answer.loops
        suffix = "" if len(entries) == 1 else f"; changed: {', '.join(loops) or 'no loop'}"
        text = text_of(changes)
        if answer.from_s is None:
            print(f"{answer.name}: unchanged, already in force: {text}")
        else:
            print(f"{answer.name}: {text} from {answer.from_s:.3f} s on{suffix}")
            for name, (old, new) in answer.thresholds.items():
                where = "" if len(entries) == 1 else f"{name}: "
                print(f"{where}threshold at {answer.from_s:.3f} s: {old:.3g} → {new:.3g}")
    else:
        print_parameters(console(), answer)
