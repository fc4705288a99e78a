"""``noack simulate``: a run in virtual time."""

from typing import TYPE_CHECKING, Any

from cosim.cli import command as cli
from cosim.cli.execute_run import RunOutput, finalize_run, warn_of_violations
from noack.core.errors import ExitStatus
from noack.core.number_format import number

if TYPE_CHECKING:
    from rich.console import Console

    from cosim.simulation.continuous.continuous_run import ContinuousRun
    from noack.config.scenario import Scenario

_EVENTS_SHOWN = 40


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
    loaded = cli.load_scenario(scenario, settings)
    warn_of_violations(loaded)
    if trigger is cli.TriggerMode.CONTINUOUS:
        return _simulate_continuously(loaded, json=json)
    from cosim.live.progress import PatientConsole, simulation_bar
    from cosim.live.simulated_run import simulate_run

    with simulation_bar(PatientConsole(stderr=True), loaded.horizon_s) as progress:
        ending = simulate_run(loaded, runs, progress)
    return finalize_run(ending, RunOutput(report, verbose, json))


def _simulate_continuously(scenario: "Scenario", *, json: bool) -> int:
    import numpy as np

    from cosim.live.progress import PatientConsole
    from cosim.simulation.continuous.continuous_report import document, run_continuous, summary
    from noack.config.resolution import resolve

    resolved = resolve(scenario)
    with PatientConsole(stderr=True).status("simulating"):
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
    from rich.table import Table
    from rich.text import Text

    from cosim.analysis.summary_model import ExitPart
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
    table = Table(title="events")
    for heading in ("event", "t, s", "inter-event time, s", "fate", "‖x‖", "‖e_c‖ before"):
        table.add_column(heading, justify="right")
    since_s = np.diff(run.event_s, prepend=0.0)
    for i, state in enumerate(run.before[:_EVENTS_SHOWN]):
        table.add_row(
            str(i),
            f"{state.t_s:.9f}",
            f"{since_s[i]:.9f}" if i else "",
            "delivered" if run.delivered[i] else "[red]lost[/]",
            number(float(np.linalg.norm(state.x)), 4),
            number(float(run.system.norms(state.e_c[None])[0]), 4),
        )
    console.print(table)
    if len(run.before) > _EVENTS_SHOWN:
        console.print(f"and {len(run.before) - _EVENTS_SHOWN} more events: --json has them all")
