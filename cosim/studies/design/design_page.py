"""The result of a design as a document.

A design is of a trigger (:class:`~cosim.studies.design.design_search.DesignResult`) or of a loop
for a network (:class:`~cosim.studies.design.design_outcome.DesignOutcome`).
"""

from typing import TYPE_CHECKING

import numpy as np

from cosim.output.curves import DASHED
from cosim.output.figures import palette
from cosim.output.figures.axes_parts import MARKERS, draw_line, draw_points, label_text, rgb, series_colour
from cosim.output.figures.page_figure import PageFigure, one_panel
from cosim.studies.design.design_outcome import HEIGHT_IN, DesignOutcome
from cosim.studies.design.design_search import WORDS, DesignResult, certified
from netem.core.number_format import plus_minus
from netem.output.document import Block, Document, Folded, Heading, Sentence, SentenceRole
from netem.output.result_tables import ResultTable, Tone
from noack.scenario.scenario_file import dumps

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_CAPTION = (
    "Mean number of transmissions and quantile of the settling times of each candidate, all on the "
    "same draws. Candidates that settle too rarely to have a quantile are left out. The star is "
    "the chosen candidate on new draws."
)
_MOST_ROWS = 20
HEADINGS = ("transmissions", "settling time", "α [1/s]", "β", "weight", "gain")
_LOOP_HEADINGS = ("", "given", "designed")


def trigger_document(result: DesignResult) -> Document:
    """Return the trade-off curve, the chosen candidate, and what is certified for it."""
    limits, bounds = result.limits, result.bounds or {}
    tone = Tone.DOUBTFUL if result.feasible else Tone.BAD
    all_rows = rows(result)
    step = max(-(-len(all_rows) // _MOST_ROWS), 1)
    shown = {i for i in range(len(all_rows)) if i % step == 0 or result.front[i] is result.best}
    blocks: list[Block] = [Heading("Trade-off"), trade_off(result)]
    if all_rows:
        title = f"{result.name}: trade-off, intervals with 95 % confidence, not corrected for the selection"
        more = f"{len(shown)} of {len(all_rows)} rows; the page has all" if len(shown) < len(all_rows) else ""
        last = len(HEADINGS)
        blocks.append(
            ResultTable("design", title, HEADINGS, all_rows, 0, (last - 2, last - 1), shown=shown, more=more)
        )
    blocks += [
        Sentence(
            text=f"required: {100 * limits.quantile:g} % of draws settle to {limits.settle:g} ‖x(0)‖ "
            f"within {limits.settling_s:g} s",
            role=SentenceRole.REMARK,
        ),
        *(
            Sentence(text=f"required: {WORDS[name]} ≤ {limit:g}, certified", role=SentenceRole.REMARK)
            for name, limit in limits.bounds.items()
        ),
        # The command writes on standard error that no candidate is feasible.
        Sentence(
            text=result.verdict(),
            role=SentenceRole.VERDICT,
            tone=Tone.GOOD if result.confirmed else tone,
            on_terminal=result.feasible,
        ),
    ]
    if result.feasible:
        blocks.append(
            Sentence(
                text=f"chosen among {len(result.trials):,} candidates on {result.best.measured.draws:,} "
                f"draws; the numbers are from {result.fresh.draws:,} other draws",
                role=SentenceRole.REMARK,
            )
        )
    if bounds:
        texts = ", ".join(certified(name, value) for name, value in bounds.items())
        blocks.append(Sentence(text=f"certified {result.conditions}: {texts}", role=SentenceRole.REMARK))
    return Document(
        title=result.name,
        kind="design",
        subtitle=f"{len(result.trials):,} candidates, {result.fresh.draws:,} draws, seed {result.seed}",
        data=result.to_json(),
        blocks=[*blocks, *_scenario(dumps(result.scenario))],
    )


def _scenario(toml: str) -> list[Block]:
    return [Heading("The scenario"), Folded("TOML", toml)]


def trade_off(result: DesignResult) -> PageFigure:
    """Return all tried candidates, the trade-off curve, the limit and the chosen candidate."""
    return one_panel("trade-off", HEIGHT_IN, lambda axes: _draw_trade_off(axes, result), caption=_CAPTION)


def _draw_trade_off(axes: "Axes", result: DesignResult) -> None:
    if any(np.isfinite(trial.measured.settling_s) for trial in result.trials):
        axes.set_xscale("log")
    for i, family in enumerate(result.space.families):
        measured = [t.measured for t in result.trials if t.candidate.family == i]
        measured = [m for m in measured if np.isfinite(m.settling_s)]
        axes.plot(
            [m.transmissions for m in measured], [m.settling_s for m in measured],
            MARKERS[i % len(MARKERS)], color=rgb(series_colour(i)), markersize=3.5, alpha=0.5,
            label=label_text(f"W {family.name}", 24),
        )  # fmt: skip
    front, best = [trial.measured for trial in result.front], result.fresh
    draw_line(
        axes, np.array([m.transmissions for m in front]), np.array([m.settling_s for m in front]),
        palette.NETWORK, label="trade-off", drawstyle="steps-post", linewidth=1.4,
    )  # fmt: skip
    axes.axhline(
        result.limits.settling_s, color=rgb(palette.CERTIFIED), label="limit", dashes=DASHED, linewidth=1.6
    )
    high_s = best.settling_high_s if np.isfinite(best.settling_high_s) else best.settling_s
    draw_points(
        axes, np.array([best.transmissions]), np.array([best.settling_s]), np.array([best.halfwidth]),
        np.array([[best.settling_s - best.settling_low_s], [high_s - best.settling_s]]), palette.LOST,
        marker="*", markersize=12, label="the choice" if result.feasible else "the closest",
    )  # fmt: skip
    axes.set(
        xlabel="transmissions (mean)",
        ylabel=f"settling time, {100 * result.limits.quantile:g} % quantile [s]",
    )


def rows(result: DesignResult) -> list[tuple[str, ...]]:
    """Return the rows of the trade-off curve."""
    return [
        (
            plus_minus(trial.measured.transmissions, trial.measured.halfwidth),
            trial.measured.settling,
            f"{trial.candidate.alpha_per_s:.4g}",
            f"{trial.candidate.beta:.4g}",
            result.space.families[trial.candidate.family].weight,
            result.space.families[trial.candidate.family].gain
            + (" ← chosen" if result.feasible and trial is result.best else ""),
        )
        for trial in result.front
    ]


def loop_document(outcome: DesignOutcome) -> Document:
    """Return the comparison of both loops, and the lines for the scenario."""
    title = f"{outcome.name}: loops under the worst losses"
    lines = f"for the scenario:\n{outcome.lines.rstrip()}"
    return Document(
        title=outcome.name,
        kind="design for a network",
        data=outcome.to_json(),
        blocks=[
            Heading("Worst losses"),
            outcome.figure,
            ResultTable("design", title, _LOOP_HEADINGS, outcome.rows, left=range(3)),
            Sentence(
                text=outcome.verdict,
                role=SentenceRole.VERDICT,
                tone=Tone.GOOD if outcome.is_better else Tone.DOUBTFUL,
            ),
            *(Sentence(text=note, role=SentenceRole.REMARK) for note in outcome.notes),
            *([Sentence(text=lines, on_page=False)] if outcome.is_certified else []),
            *_scenario(outcome.scenario_toml()),
        ],
    )
