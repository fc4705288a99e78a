"""``noack lab``, ``run``, ``demo``, ``bridge``, ``simulate``: make a run; ``set``: change a live one."""

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from cosim.cli import command as cli
from cosim.cli import options as opt
from cosim.cli.execute_run import (
    LiveOptions,
    OutputOptions,
    finalize_run,
    run_processes,
    warn_of_left_out,
    warn_of_violations,
)
from cosim.lazy_modules import lazy_modules
from cosim.record.run_directory import DEFAULT_RUNS
from noack.core.errors import CallerError
from noack.core.number_format import number
from noack.runtime.command_line import print_to_stderr

with lazy_modules():
    from cosim.analysis.summary import summary_model
    from cosim.interactive import scenario_draft
    from cosim.lab import lab_server
    from cosim.live.monitoring import progress, ros2_bridge
    from cosim.output import result_tables, run_tables, run_verdict, terminal_output
    from cosim.simulation import continuous, virtual_time
    from noack.runtime import active_runs, control_messages
    from noack.scenario import resolution, runtime_parameters, scenario, scenario_file

if TYPE_CHECKING:
    from rich.console import Console

_EVENTS_SHOWN = 40


@cli.command(cli.RUNS, 5, on_linux=True)
def lab(
    source: opt.ExampleOptions,
    *,
    runs: opt.RunsOption = DEFAULT_RUNS,
    port: Annotated[int, Option(min=0, max=65535)] = 0,
    browser: bool = True,
    json: opt.JsonOption = False,
) -> None:
    """Open a page in the browser: drag settings, watch the loop, run it live.

    The page is on 127.0.0.1, at an address with a secret. Ctrl-C ends it.

    Options:
        port: Port on 127.0.0.1; 0: a free one.
        browser: Open the page in a browser.

    Examples:
        noack lab   open the paper's example
        noack lab mine.toml --set trigger.beta=0.3   open a file with other settings
        noack lab --no-browser --port 8080   print the address, for a browser elsewhere
    """
    if find_spec("nicegui") is None:
        raise CallerError(
            "the page needs the extra `lab`: pip install 'noack[lab]', or `make lab` in the repository"
        )
    edited = scenario_draft.open_draft(source.scenario)
    for key, value in map(scenario_file.setting_of, source.settings or ()):
        edited = edited.with_value(key, value)
    edited.require_valid()  # report mistakes here
    query = edited.query() if source.settings else ""
    options = lab_server.LabOptions(source.scenario, query, Path.cwd(), runs, port, browser)

    def announce(address: str) -> None:
        cli.print_lines(json, {"address": address}, f"noack lab: {address}  (Ctrl-C ends)")
        sys.stdout.flush()  # somebody waits for it

    lab_server.serve(options, announce)


@cli.command(cli.RUNS, 20, takes="as long as the scenario's horizon, and a few seconds", on_linux=True)
def run(
    context: typer.Context,
    source: opt.ScenarioOptions,
    *,
    options: LiveOptions,
) -> int:
    """Run a scenario live: start all processes and record everything.

    Examples:
        noack run lane_following   the paper's example, 20 s
        noack run unstable_pendulum --set horizon_s=5 --live   5 s, with the live viewer
        noack run lane_following --set network.mansd=9 --json   M − 1 = 9; print JSON
    """
    return run_processes(source.load(), options, server=context.obj)


@cli.command(cli.RUNS, 10, takes="20 s and a few", on_linux=True)
def demo(
    context: typer.Context,
    *,
    zoh: Annotated[bool, Option("--zoh")] = False,
    settings: opt.SetOption = None,
    options: LiveOptions,
) -> int:
    """Run the paper's lane-following example live.

    Options:
        zoh: Hold the last update (ZOH) instead of using a model.

    Examples:
        noack demo   20 s; the record is in runs/latest
        noack demo --zoh --live   zero-order hold, with the live viewer
        noack demo --set speed=4 --set horizon_s=8   takes 2 s of wall time
    """
    all_settings = [*(['mode="zoh"'] if zoh else []), *(settings or ())]
    return run_processes(opt.load_scenario("lane_following", all_settings), options, server=context.obj)


@cli.command(cli.RUNS, 22, takes="as long as the scenario's horizon, and a few seconds", on_linux=True)
def bridge(
    context: typer.Context,
    source: opt.ScenarioOptions,
    *,
    router: Annotated[str, Option(metavar="ENDPOINT")] = "tcp/127.0.0.1:7447",
    listen: Annotated[bool, Option("--listen")] = False,
    domain: Annotated[int, Option(min=0, max=232)] = 0,
    options: LiveOptions,
) -> int:
    """Run a scenario live, and publish it as topics of ROS 2 (rmw_zenoh).

    Options:
        router: Where the router of ROS 2 listens, as zenoh writes it.
        listen: Be the router at this address, to which nodes connect.
        domain: ROS_DOMAIN_ID.

    Examples:
        noack bridge lane_following --listen   without an installation of ROS
        noack bridge lane_following --router tcp/127.0.0.1:7447 --json   with rmw_zenohd
    """
    loaded = source.load()
    with ros2_bridge.bridge_process(router, domain, listen=listen) as watcher:
        return run_processes(loaded, options, server=context.obj, watcher=watcher)


@cli.command(cli.RUNS, 30, takes="about 4 s; with the report, 6 s")
def simulate(
    source: opt.ScenarioOptions,
    *,
    trigger: opt.TriggerOption = opt.TriggerMode.SAMPLED,
    runs: opt.RunsOption = DEFAULT_RUNS,
    options: OutputOptions,
) -> int:
    """Run a scenario in virtual time: no sockets, no deadlines missed.

    The trigger, the losses and the controller are those of a live run.

    Examples:
        noack simulate lane_following   the processes of a live run, without sockets
        noack simulate lane_following --trigger continuous   the paper's loop, exactly, without delays
        noack simulate reactor_petc --no-report --json   print the summary as JSON
    """
    loaded = source.load()
    warn_of_violations(loaded)
    if trigger is opt.TriggerMode.CONTINUOUS:
        return _simulate_continuously(loaded, json=options.json)
    with progress.simulation_bar(progress.error_console(), loaded.horizon_s) as bar:
        ending = virtual_time.simulate_run(loaded, runs, bar)
    return finalize_run(ending, options)


def _simulate_continuously(loaded: "scenario.Scenario", *, json: bool) -> int:
    resolved = resolution.resolve(loaded)
    warn_of_left_out(resolved)
    with cli.status("simulating"):
        run = continuous.run_continuous(resolved)
    summary = continuous.summary(run, resolved)
    constraints = [rule.text() for rule in resolved.network.constraints]
    cli.show(json, lambda: continuous.document(run, resolved), _print_run, run, summary, constraints)
    return summary.exit_status


def _print_run(
    console: "Console",
    run: "continuous.ContinuousRun",
    summary: "continuous.ContinuousSummary",
    constraints: list[str],
) -> None:
    """Print how the run ended, its key numbers, and its first 40 events."""
    ended = summary_model.ExitPart(status=int(summary.exit_status), reason=summary.reason)
    state = (
        ""
        if summary.diverged_at_s
        else run_verdict.state_text(
            summary.initial_state_norm, summary.sup_state_norm, summary.final_state_norm, None
        )
    )
    ending = run_verdict.ending_line(ended, summary.reached_s, summary.horizon_s, state)
    for line in (ending, run_verdict.transmission_line(summary.events, summary.deliveries)):
        terminal_output.print_line(console, line)
    rows = (
        run_tables.lost_row(summary.drops, summary.deliveries),
        run_tables.longest_burst(summary.mansd, constraints, summary.longest_loss_burst),
        *run_tables.interval_rows(
            summary.inter_event_min_s, summary.inter_event_median_s, summary.inter_delivery_median_s
        ),
        ("‖x‖ at the start", number(summary.initial_state_norm)),
        ("‖x‖ at the end", number(summary.final_state_norm)),
        *([("left out of the network", summary.left_out)] if summary.left_out else ()),
    )
    cap = f"M − 1 = {summary.mansd}"
    title = run_tables.title_of(summary.scenario, summary.mode, cap, constraints, "continuous")
    terminal_output.print_numbers(console, title, rows)
    table = _event_table(run)
    console.print(result_tables.terminal_table(table, left=(), styles={"lost": "red"}))
    if len(run.before) > _EVENTS_SHOWN:
        console.print(f"and {len(run.before) - _EVENTS_SHOWN} more events: --json has them all")


def _event_table(run: "continuous.ContinuousRun") -> "result_tables.ResultTable":
    """Return the table of a run's first 40 events."""
    import numpy as np  # help and completion need none

    since_s = np.diff(run.event_s, prepend=0.0)
    with np.errstate(all="ignore"):  # a run may diverge
        norms = [
            (float(np.linalg.norm(state.x)), float(run.system.norms(state.e_c[None])[0]))
            for state in run.before[:_EVENTS_SHOWN]
        ]
    events = [
        (
            str(i),
            f"{state.t_s:.9f}",
            f"{since_s[i]:.9f}" if i else "",
            number(x, 4),
            number(e_c, 4),
            "delivered" if run.delivered[i] else "lost",
        )
        for i, (state, (x, e_c)) in enumerate(zip(run.before, norms, strict=False))
    ]
    headings = ("event", "t, s", "inter-event time, s", "‖x‖", "‖e_c‖ before", "fate")
    return result_tables.ResultTable("events", "events", headings, events)


@cli.command(
    cli.RUNS,
    45,
    on_linux=True,
    name="set",
    context_settings={"ignore_unknown_options": True},  # -0.5 is a value
)
def set_(
    settings: Annotated[
        list[str] | None,
        Argument(metavar="[KEY VALUE]...", autocompletion=opt.complete_runtime_parameters),
    ] = None,
    *,
    session: Annotated[str | None, opt.SESSION] = None,
    run: Annotated[Path | None, Option(autocompletion=opt.complete_runs)] = None,
    json: opt.JsonOption = False,
) -> None:
    """Change a live run: losses, M, trigger, set point.

    Options:
        settings: Keys of the scenario, or their short forms, with new values: loss.p 0.9 mansd 2.
            Without keys, list the runtime parameters.
        run: Directory of the run; needed if several runs are active.

    Examples:
        noack set   list the runtime parameters and their values
        noack set loss.p 0.9   lose nine in ten packets from now on
        noack set mansd 2 trigger.beta 0.3 --json   change M − 1 and β at once
    """
    changes = parse_settings(settings or ())
    answer = active_runs.request_change(active_runs.find_run(session, run), changes)
    for line in answer.warnings:
        print_to_stderr(f"noack: warning: {line}")
    if json:
        cli.print_json(answer.fields())
    elif changes:
        loops, entries = answer.changed_loops, answer.loops
        suffix = "" if len(entries) == 1 else f"; changed: {', '.join(loops) or 'no loop'}"
        text = runtime_parameters.text_of(changes)
        if answer.from_s is None:
            print(f"{answer.name}: in force already: {text}")
        else:
            print(f"{answer.name}: {text} from {answer.from_s:.3f} s on{suffix}")
    else:
        _print_parameters(cli.console(), answer)


def parse_settings(words: list[str] | tuple[str, ...]) -> dict[str, object]:
    """Return the settings that words give as KEY VALUE or KEY=VALUE.

    Raise CallerError if a value is missing, or a key is given twice.
    """
    settings: dict[str, object] = {}
    remaining = list(words)
    while remaining:
        word = remaining.pop(0)
        name, equals, text = word.partition("=")
        if not equals:
            if Path(word).is_dir():
                raise CallerError(f"{word}: a folder, not a key; a run is given by --run {word}")
            if not remaining:
                raise CallerError(f"{word}: needs a value, e.g. `noack set loss.p 0.9`")
            text = remaining.pop(0)
        key = runtime_parameters.full_key(name.strip())
        if key in settings:
            raise CallerError(f"{key}: is given twice")
        settings[key] = scenario_file.value_of(text, name)
    return settings


def _print_parameters(console: "Console", answer: "control_messages.ChangeReply") -> None:
    short = {key: name for name, key in runtime_parameters.SHORT.items()}
    entries, rows = answer.loops, []
    for key in dict.fromkeys(key for values in entries.values() for key in values):
        names: dict[str, list[str]] = {}
        for name, values in entries.items():
            if key in values:
                text = runtime_parameters.text_of({"": values[key]}).removeprefix(" = ")
                names.setdefault(text, []).append(name)
        for value, loops in names.items():
            loop_text = "all" if len(loops) == len(entries) else ", ".join(loops)
            rows.append((key, short.get(key, ""), loop_text, value))
    title = f"{answer.name}, at {answer.t_s:.1f} s"
    table = result_tables.ResultTable("", title, ("key", "short", "loops", "value"), rows)
    console.print(result_tables.terminal_table(table, left=range(4)))
    console.print(answer.run_dir, style="dim", markup=False, soft_wrap=True)
