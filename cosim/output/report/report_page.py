"""The report of a run: its summary and its figures, as one HTML page."""

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from cosim.analysis.claims.claims_by_part import claims_of
from cosim.analysis.fidelity import is_against
from cosim.analysis.over_time import WorstLoop, worst_loop
from cosim.analysis.summary_model import RunSummary
from cosim.output.network_table import CAPTION, HEADINGS, badness, loop_row, network_rows
from cosim.output.remarks import remarks
from cosim.output.report.figure_files import inline
from cosim.output.report.network_figures import network_pictures
from cosim.output.report.run_figures import Envelope, RunFigure, pictures
from cosim.output.run_tables import TIMING_HEADINGS, interval_of, key_numbers, timing_rows
from cosim.output.run_verdict import BAD, GOOD, NEUTRAL, verdict
from cosim.record.run_directory import (
    ENVIRONMENT_FILE,
    REPORT_FILE,
    SCENARIO_FILE,
    file_of_loop,
    read_object,
)
from cosim.record.run_record import RecordedRun, RunRecord
from noack.config.scenario import Scenario
from noack.core.file_access import write_whole
from noack.core.number_format import number, percent, seconds

_NONE = "–"
TIMING_FIGURES = ("lateness", "latency", "clocks")
"""These have a section of their own, after the signals."""
_TONES = {
    "held": "good", "holds": "good", GOOD: "good",
    "violated": "bad", BAD: "bad",
    "void": "doubt",
}  # fmt: skip


@np.errstate(all="ignore")  # a run may diverge
def write_report(
    run: RecordedRun, summary: RunSummary, run_dir: Path, loop: str | None = None
) -> Path:
    """Write the report of a run, or of one of its loops; replace an existing one.

    Returns:
        The report's path.

    Raises:
        MachineError: the report cannot be written.
    """
    shown = summary if loop is None else summary.of_loop(loop)
    worst = worst_loop(shown.loops)
    record = run.loops[worst.number]
    drawings = pictures(record, envelopes_of(record), timed=shown.kind == "live")
    html = page(
        record.scenario,
        shown,
        [draw() for draw in drawings.values()],
        (run_dir / SCENARIO_FILE).read_text(encoding="utf-8"),
        read_object(run_dir / ENVIRONMENT_FILE),
        None if len(shown.loops) == 1 else _network_part(run, shown, run_dir, worst),
    )
    return write_whole(run_dir / file_of_loop(REPORT_FILE, loop), html)


def envelopes_of(record: RunRecord) -> Sequence[Envelope]:
    """Return the certified bounds of a loop, to be drawn with the quantities that they bound."""
    try:
        return claims_of(record).envelopes()
    except Exception:  # the figures are useful without them
        return []


class _NetworkPart(NamedTuple):
    """What the report of several loops has besides that of the worst one."""

    description: str
    rows: Sequence[tuple[str, str]]
    figures: Sequence[RunFigure]
    worst: str
    worst_why: str
    caption: str
    headings: Sequence[str]
    loops: Sequence[tuple[str | None, Sequence[str]]]
    """Of each loop, the worst first: the address of its report, and its row."""


def _network_part(
    run: RecordedRun, summary: RunSummary, run_dir: Path, worst: WorstLoop
) -> _NetworkPart:
    loops = sorted(summary.loops, key=badness, reverse=True)
    loop = summary.loops[worst.number]
    begin = f"Its time starts {seconds(loop.phase_s)} after that of the run."
    return _NetworkPart(
        description=run.scenario.description,
        rows=network_rows(summary),
        figures=list(network_pictures(run, summary).values()),
        worst=f"{loop.name} (number {loop.number})",
        worst_why=f"{worst.why[:1].upper()}{worst.why[1:]}. {begin}",
        caption=CAPTION,
        headings=HEADINGS,
        loops=[(_link(run_dir, one.name), loop_row(one)) for one in loops],
    )


def _link(run_dir: Path, name: str) -> str | None:
    """Return the address of a loop's report; None if it is not written."""
    file = file_of_loop(REPORT_FILE, name)
    return quote(file) if (run_dir / file).is_file() else None


def page(
    scenario: Scenario,
    summary: RunSummary,
    figures: Sequence[RunFigure],
    scenario_toml: str,
    environment: Mapping[str, Any],
    network: _NetworkPart | None = None,
) -> str:
    """Return the report of a run as HTML; everything but figures is escaped.

    Args:
        scenario: the resolved scenario of the only loop, or of the worst one.
        summary: the summary of the run.
        figures: the figures of this loop, in order.
        scenario_toml: the scenario of the run, as stored in the run directory.
        environment: the content of ``environment.json``; empty if there is none.
        network: what is shown of all loops, if there are several.
    """
    one = summary.of_loop(summary.loops[0].name if network is None else scenario.name)
    (loop,) = one.loops
    lines, remarks_shown = verdict(summary), [remark.text for remark in remarks(one)]
    styles = {line.style for line in lines} - {NEUTRAL}
    is_good = styles == {GOOD} and (network is not None or not remarks_shown)
    # These have their own sections.
    rest = one.model_copy(
        update={"loops": [loop.model_copy(update={"fidelity": None, "replay": None})]}
    )
    return templates().get_template("report.html.jinja").render(
        scenario=scenario,
        summary=summary,
        one=loop,
        network=network,
        verdict_lines=[line.text for line in lines],
        verdict_tone="bad" if BAD in styles else "good" if is_good else "doubt",
        remarks=remarks_shown,
        key_numbers=key_numbers(rest),
        parameters=list(_parameters(scenario)),
        figures=figures,
        timing_figures=TIMING_FIGURES,
        timing=list(timing_rows(loop)),
        timing_headings=TIMING_HEADINGS,
        scenario_toml=scenario_toml,
        environment=environment,
        environment_rows=environment_rows(environment),
    )  # fmt: skip


@cache
def templates(folder: Path = Path(__file__).parent) -> Environment:
    """Return the templates of the report and of a folder; all text is escaped."""
    found = Environment(
        loader=FileSystemLoader([folder, Path(__file__).parent]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    filters: dict[str, Any] = {
        "tone": lambda word: _TONES.get(word, ""),
        "inline": lambda one: Markup(inline(one.figure, one.name, one.description)),
        "interval": interval_of, "number": number, "percent": percent, "shown": _shown,
        "words": _words,
    }  # fmt: skip
    found.filters |= filters
    found.tests["is_against"] = is_against
    return found


def _parameters(scenario: Scenario) -> Iterator[tuple[str, str]]:
    trigger, network = scenario.trigger, scenario.network
    every = scenario.plant.measure_every
    loss = network.loss.model_dump(exclude={"model"}, exclude_defaults=True)
    model = network.loss.model.replace("_", "-")
    details = ", ".join(f"{_words(key)} {_shown(value)}" for key, value in loss.items())
    yield "between updates", "model Â + B̂K" if scenario.mode == "model" else "zero-order hold"
    yield "trigger", trigger.description
    yield "norm of errors", "‖e‖₂" if trigger.weight is None else "‖W e‖₂, W from the scenario"
    yield "M − 1", f"{network.mansd}" + ("" if network.enforce_mansd else ", not enforced")
    if network.constraints:
        yield "constraints on losses", ", ".join(one.text() for one in network.constraints)
    yield "loss", f"{model} ({details})" if details else model
    if scenario.protocol.acknowledges:
        timeout_ms = 1e-6 * scenario.timing.acknowledgement_timeout_ns
        reverse = network.reverse.loss.model_dump()
        lost = ", ".join(f"{_words(key)} {_shown(value)}" for key, value in reverse.items())
        yield "acknowledgements", f"loss: {lost}; timeout {timeout_ms:g} ms"
    if (actuation := network.actuation) is not None:
        lost = ", ".join(
            f"{_words(key)} {_shown(value)}" for key, value in actuation.loss.model_dump().items()
        )
        most = actuation.link.longest_burst
        yield (
            "actuations",
            f"loss: {lost}; "
            + ("no guarantee" if most is None else f"at most {most} consecutive losses"),
        )
    yield "initial synchronisation", network.initial_sync.replace("_", " ")
    yield "plant", f"{scenario.plant.rate_hz:g} steps/s"
    yield "measurements", "every step" if every == 1 else f"every {every} steps"
    yield (
        "controller",
        f"{scenario.controller.rate_hz:g} ticks/s, phase {scenario.controller.phase:g}",
    )
    yield "horizon", f"{scenario.horizon_s:g} s at speed {scenario.speed:g}"
    x0 = np.array(scenario.plant.initial_state)
    yield "‖x(0)‖", f"{np.linalg.norm(x0):.4g}, {len(x0)} states"
    seeds = scenario.seeds
    yield "seeds", f"plant {seeds.plant}, initial state {seeds.initial_state}, loss {seeds.loss}"


def environment_rows(environment: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the properties of the environment, and their values as text."""
    return [(_words(key), _line(value)) for key, value in environment.items()]


def _words(key: str) -> str:
    return str(key).replace("_", " ")


def _line(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else _shown(value)


def _shown(value: Any) -> str:
    """Write a value of a JSON document as text."""
    if value is None:
        return _NONE
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, dict):
        return ", ".join(f"{_words(key)} {_shown(entry)}" for key, entry in value.items())
    return str(value)
