"""The result of ``noack simulate --trigger continuous`` on the terminal."""

import numpy as np
from rich.console import Console

from cosim.analysis.summary.summary_model import ExitPart
from cosim.output.result_tables import ResultTable, terminal_table
from cosim.output.run_tables import burst_row, interval_rows, lost_row, title_of
from cosim.output.run_verdict import ending_line, state_text, transmission_line
from cosim.output.terminal_output import print_line, print_numbers
from cosim.simulation.continuous import ContinuousRun, ContinuousSummary
from noack.core.number_format import number

_EVENTS_SHOWN = 40


def print_continuous_run(
    console: Console,
    run: ContinuousRun,
    summary: ContinuousSummary,
    constraints: list[str],
) -> None:
    """Print how the run ended, its key numbers, and its first 40 events."""
    ended = ExitPart(status=int(summary.exit_status), reason=summary.reason)
    state = (
        ""
        if summary.diverged_at_s
        else state_text(summary.initial_state_norm, summary.sup_state_norm, summary.final_state_norm, None)
    )
    ending = ending_line(ended, summary.reached_s, summary.horizon_s, state)
    for line in (ending, transmission_line(summary.events, summary.deliveries)):
        print_line(console, line)
    rows = (
        lost_row(summary.drops, summary.deliveries),
        burst_row(summary.mansd, constraints, summary.longest_loss_burst),
        *interval_rows(
            summary.inter_event_min_s, summary.inter_event_median_s, summary.inter_delivery_median_s
        ),
        ("‖x‖ at the start", number(summary.initial_state_norm)),
        ("‖x‖ at the end", number(summary.final_state_norm)),
    )
    cap = f"M − 1 = {summary.mansd}"
    title = title_of(summary.scenario, summary.mode, cap, constraints, "continuous")
    print_numbers(console, title, rows)
    table = _event_table(run)
    console.print(terminal_table(table, left=(), styles={"lost": "red"}))
    if len(run.before) > _EVENTS_SHOWN:
        console.print(f"and {len(run.before) - _EVENTS_SHOWN} more events: --json has them all")


def _event_table(run: ContinuousRun) -> ResultTable:
    """Return the table of a run's first 40 events."""
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
    return ResultTable("events", "events", headings, events)
