"""The end of a run in exact continuous time: verdict, key numbers, events."""

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from cosim.output.run_tables import loss_and_interval_rows, number_table
from cosim.output.run_verdict import verdict
from cosim.simulation.continuous.continuous_report import summary
from cosim.simulation.continuous.continuous_run import ContinuousRun
from noack.config.scenario import Scenario
from noack.core.number_format import number

_EVENTS_SHOWN = 40


@np.errstate(all="ignore")  # a run may diverge
def print_run(console: Console, run: ContinuousRun, resolved: Scenario) -> None:
    """Print how the run ended, its key numbers, and its first 40 events."""
    found = summary(run, resolved)
    for line in verdict(found)[:2]:  # without claims
        console.print(Text(line.text, line.style), soft_wrap=True)
    rows = (
        *loss_and_interval_rows(found),
        ("‖x‖ at the start", number(found["initial_state_norm"])),
        ("‖x‖ at the end", number(found["final_state_norm"])),
    )
    console.print(number_table(found, rows))
    console.print(_event_table(run))
    if len(run.before) > _EVENTS_SHOWN:
        console.print(f"and {len(run.before) - _EVENTS_SHOWN} more events: --json has them all")


def _event_table(run: ContinuousRun) -> Table:
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
    return table
