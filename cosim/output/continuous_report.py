"""The result of ``noack simulate --trigger continuous`` as a document."""

import numpy as np

from cosim.output.run_tables import burst_row, interval_rows, lost_row, title_of
from cosim.output.run_verdict import verdict_of_exact_run
from cosim.simulation import continuous
from cosim.simulation.continuous import ContinuousRun
from netem.core.number_format import number
from netem.output.document import Document, Sentence, SentenceRole
from netem.output.result_tables import KEY_VALUE, ResultTable, Tone
from noack.scenario.scenario import Scenario

_EVENTS_SHOWN = 40


def continuous_document(run: ContinuousRun, scenario: Scenario) -> Document:
    """Return how the run of a resolved scenario ended, its key numbers, and its first 40 events."""
    summary, constraints = continuous.summary(run, scenario), [r.text() for r in scenario.network.constraints]
    rows = (
        lost_row(summary.drops, summary.deliveries),
        burst_row(summary.mansd, constraints, summary.longest_loss_burst),
        *interval_rows(
            summary.inter_event_min_s, summary.inter_event_median_s, summary.inter_delivery_median_s
        ),
        ("‖x‖ at the start", number(summary.initial_state_norm)),
        ("‖x‖ at the end", number(summary.final_state_norm)),
    )
    cap = f"at most {summary.mansd} lost in a row"
    title = title_of(summary.scenario, summary.mode, cap, constraints, "continuous")
    return Document(
        title=title,
        data=continuous.document(run, scenario),
        blocks=[
            *(
                Sentence(text=line.text, tone=line.tone, role=SentenceRole.VERDICT)
                for line in verdict_of_exact_run(summary)
            ),
            ResultTable("numbers", title, KEY_VALUE, rows),
            _event_table(run),
        ],
    )


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
    more = len(run.before) - _EVENTS_SHOWN
    return ResultTable(
        "events", "events", headings, events, left=(), tones={"lost": Tone.BAD},
        more=f"and {more} more events: --json has them all" if more > 0 else "",
    )  # fmt: skip
