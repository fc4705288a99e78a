"""``noack run``, ``demo``, ``simulate``, ``set``: make a run, or change one that goes on."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from cosim.cli import command as cli
from cosim.cli import completion
from cosim.cli.execute_run import RunOutput, finalize_run, run_processes, warn_of_violations
from noack.core.errors import CallerError, ExitStatus
from noack.core.number_format import number

if TYPE_CHECKING:
    from rich.console import Console

    from cosim.simulation.continuous import ContinuousRun
    from noack.config.scenario import Scenario
    from noack.runtime.control_messages import ChangeReply

_EVENTS_SHOWN = 40


@cli.command(cli.RUNS, 20, [
    ("noack run lane_following", "the paper's example, 20 s"),
    ("noack run unstable_pendulum --set horizon_s=5 --live", "5 s, with the live viewer"),
    ("noack run lane_following --set network.mansd=9 --json", "M − 1 = 9; print JSON"),
    ("noack run lane_following --hosts hosts.toml", "some processes on other hosts, over ssh"),
])  # fmt: skip
def run(
    context: typer.Context,
    scenario: cli.ScenarioArgument,
    *,
    settings: cli.SetOption = None,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    live: cli.LiveOption = False,
    metrics: cli.MetricsOption = None,
    _log_format: cli.LogFormatOption = cli.LogFormat.TEXT,
    hosts: Annotated[Path | None, Option(metavar="FILE")] = None,
    report: cli.ReportOption = True,
    verbose: cli.VerboseOption = False,
    json: cli.JsonOption = False,
) -> int:
    """Run a scenario live: start all processes and record everything.

    Options:
        hosts: TOML file that places processes on other hosts.
    """
    output, listening = RunOutput(report, verbose, json), None
    if hosts is not None:
        from cosim.live.remote_access import listening_for

        listening = listening_for(hosts)
    return run_processes(
        lambda: cli.load_scenario(scenario, settings), runs, output,
        live=live, server=context.obj, metrics=metrics, listening=listening,
    )  # fmt: skip


@cli.command(cli.RUNS, 10, [
    ("noack demo", "20 s; the record is in runs/latest"),
    ("noack demo --zoh --live", "zero-order hold, with the live viewer"),
    ("noack demo --set speed=4 --set horizon_s=8", "takes 2 s of wall time"),
])  # fmt: skip
def demo(
    context: typer.Context,
    *,
    zoh: Annotated[bool, Option("--zoh")] = False,
    settings: cli.SetOption = None,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    live: cli.LiveOption = False,
    metrics: cli.MetricsOption = None,
    _log_format: cli.LogFormatOption = cli.LogFormat.TEXT,
    report: cli.ReportOption = True,
    verbose: cli.VerboseOption = False,
    json: cli.JsonOption = False,
) -> int:
    """Run the paper's lane-following example live.

    Options:
        zoh: Hold the last update (ZOH) instead of using a model.
    """
    wanted = [*(['mode="zoh"'] if zoh else []), *(settings or ())]
    output = RunOutput(report, verbose, json)
    return run_processes(
        lambda: cli.load_scenario("lane_following", wanted), runs, output,
        live=live, server=context.obj, metrics=metrics,
    )  # fmt: skip


@cli.command(cli.RUNS, 30, [
    ("noack simulate lane_following", "the processes of a live run, without sockets"),
    ("noack simulate lane_following --trigger continuous", "the paper's loop, exactly"),
    ("noack simulate reactor_petc --no-report --json", "print the summary as JSON"),
])  # fmt: skip
def simulate(
    scenario: cli.ScenarioArgument,
    *,
    settings: cli.SetOption = None,
    trigger: cli.TriggerOption = cli.TriggerMode.SAMPLED,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    report: cli.ReportOption = True,
    verbose: cli.VerboseOption = False,
    json: cli.JsonOption = False,
) -> int:
    """Run a scenario in virtual time: no sockets, no deadlines missed.

    The trigger, the losses and the controller are those of a live run.
    """
    from noack.config.link_load import require_capacity

    loaded = cli.load_scenario(scenario, settings)
    require_capacity(loaded)
    warn_of_violations(loaded)
    if trigger is cli.TriggerMode.CONTINUOUS:
        return _simulate_continuously(loaded, json=json)
    from cosim.live.progress import error_console, simulation_bar
    from cosim.live.simulated_run import simulate_run

    with simulation_bar(error_console(), loaded.horizon_s) as progress:
        ending = simulate_run(loaded, runs, progress)
    return finalize_run(ending, RunOutput(report, verbose, json))


def _simulate_continuously(scenario: "Scenario", *, json: bool) -> int:
    import numpy as np

    from cosim.simulation.continuous import document, run_continuous, summary
    from noack.config.resolution import resolve

    resolved = resolve(scenario)
    with cli.status("simulating"):
        run = run_continuous(resolved)
    found = summary(run, resolved)
    if json:
        cli.print_json(document(run, resolved))
    else:
        with np.errstate(all="ignore"):  # a run may diverge
            _print_run(cli.console(), run, found)
    return ExitStatus(found["exit"]["status"])


def _print_run(console: "Console", run: "ContinuousRun", found: dict[str, Any]) -> None:
    """Print how the run ended, its key numbers, and its first 40 events."""
    import numpy as np
    from rich.text import Text

    from cosim.analysis.summary_model import ExitPart
    from cosim.output.result_tables import ResultTable, terminal_table
    from cosim.output.run_tables import (
        interval_rows,
        longest_burst,
        lost_row,
        title_of,
    )
    from cosim.output.run_verdict import ending_line, print_numbers, transmission_line

    ending = ending_line(ExitPart(**found["exit"]), found["reached_s"], found["horizon_s"])
    for line in (ending, transmission_line(found["events"], found["deliveries"])):
        console.print(Text(line.text, line.style), soft_wrap=True)
    mansd = found["mansd"]
    rows = (
        lost_row(found["drops"], found["deliveries"]),
        longest_burst(mansd, (), found["longest_loss_burst"]),
        *interval_rows(
            found["inter_event_min_s"],
            found["inter_event_median_s"],
            found["inter_delivery_median_s"],
        ),
        ("‖x‖ at the start", number(found["initial_state_norm"])),
        ("‖x‖ at the end", number(found["final_state_norm"])),
    )
    title = title_of(found["scenario"], found["mode"], mansd, (), found["kind"])
    print_numbers(console, title, rows)
    since_s = np.diff(run.event_s, prepend=0.0)
    events = [
        (
            str(i),
            f"{state.t_s:.9f}",
            f"{since_s[i]:.9f}" if i else "",
            number(float(np.linalg.norm(state.x)), 4),
            number(float(run.system.norms(state.e_c[None])[0]), 4),
            "delivered" if run.delivered[i] else "lost",
        )
        for i, state in enumerate(run.before[:_EVENTS_SHOWN])
    ]
    headings = ("event", "t, s", "inter-event time, s", "‖x‖", "‖e_c‖ before", "fate")
    table = ResultTable("events", "events", headings, events)
    console.print(terminal_table(table, left=(), styles={"lost": "red"}))
    if len(run.before) > _EVENTS_SHOWN:
        console.print(f"and {len(run.before) - _EVENTS_SHOWN} more events: --json has them all")


@cli.command(
    cli.RUNS, 45,
    [
        ("noack set", "list the runtime parameters and their values"),
        ("noack set loss.p 0.9", "lose nine in ten packets from now on"),
        ("noack set mansd 2 trigger.beta 0.3 --json", "change M − 1 and β at once"),
    ],
    name="set",
    context_settings={"ignore_unknown_options": True},  # -0.5 is a value
)  # fmt: skip
def set_(
    settings: Annotated[
        list[str] | None,
        Argument(metavar="[KEY VALUE]...", autocompletion=completion.runtime_parameters),
    ] = None,
    *,
    session: Annotated[str | None, cli.SESSION] = None,
    run: Annotated[Path | None, Option(autocompletion=completion.run_directories)] = None,
    json: cli.JsonOption = False,
) -> int:
    """Change a live run: losses, M, trigger, set point.

    Options:
        settings: Keys of the scenario, or their short forms, with new values: loss.p 0.9 mansd 2.
            Without keys, list the runtime parameters.
        run: Directory of the run; needed if several runs are active.
    """
    from noack.config.runtime_parameters import text_of
    from noack.runtime.run_registry import find, request_change

    wanted = parsed(settings or ())
    answer = request_change(find(session, run), wanted)
    if json:
        cli.print_json(answer.fields())
    elif wanted:
        loops, entries = answer.changed_loops, answer.loops
        which = "" if len(entries) == 1 else f"; changed: {', '.join(loops) or 'no loop'}"
        print(f"{answer.name}: {text_of(wanted)} from {answer.from_s or 0.0:.3f} s on{which}")
    else:
        _print_parameters(cli.console(), answer)
    return ExitStatus.OK


def parsed(words: list[str] | tuple[str, ...]) -> dict[str, Any]:
    """Return the settings that words give as KEY VALUE or KEY=VALUE.

    Raise CallerError if a value is missing, or a key is given twice.
    """
    found: dict[str, Any] = {}
    from noack.config.runtime_parameters import full_key
    from noack.config.scenario_file import value_of

    left = list(words)
    while left:
        word = left.pop(0)
        name, equals, text = word.partition("=")
        if not equals:
            if not left:
                raise CallerError(f"{word}: needs a value, e.g. `noack set loss.p 0.9`")
            text = left.pop(0)
        key = full_key(name.strip())
        if key in found:
            raise CallerError(f"{key}: is given twice")
        found[key] = value_of(text, name)
    return found


def _print_parameters(console: "Console", answer: "ChangeReply") -> None:
    from cosim.output.result_tables import ResultTable, terminal_table
    from noack.config.runtime_parameters import SHORT, text_of

    short = {key: name for name, key in SHORT.items()}
    entries, rows = answer.loops, []
    for key in dict.fromkeys(key for values in entries.values() for key in values):
        names: dict[str, list[str]] = {}
        for name, values in entries.items():
            if key in values:
                names.setdefault(text_of({"": values[key]}).removeprefix(" = "), []).append(name)
        for value, loops in names.items():
            which = "all" if len(loops) == len(entries) else ", ".join(loops)
            rows.append((key, short.get(key, ""), which, value))
    title = f"{answer.name}, at {answer.t_s:.1f} s"
    table = ResultTable("", title, ("key", "short", "loops", "value"), rows)
    console.print(terminal_table(table, left=range(4)))
    console.print(answer.run_dir, style="dim", markup=False, soft_wrap=True)
