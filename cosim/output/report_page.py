"""The report of a run: its summary and its figures, as one HTML page.

A report has sections. Each is a function here that returns what the section shows, or None if there
is nothing to show, and a template of the same name in ``pages/report/``. The page of a run shows
the network, the loops and the worst loop in detail; where one loop has the network for itself, that
is the page of the loop.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote

import numpy as np

from cosim.analysis.summary.loops_over_time import LoopOverTime
from cosim.analysis.summary.run_summary import worst_loop
from cosim.analysis.summary.summary_model import LoopSummary, RunSummary
from cosim.output.figures.network_figures import network_figures
from cosim.output.figures.page_figure import PageFigure
from cosim.output.figures.run_figures import envelopes, run_figures
from cosim.output.page_kit import TERMS, templates, value_text, words
from cosim.output.result_tables import Tone
from cosim.output.run_tables import (
    LOOPS_CAPTION,
    badness,
    caps_text,
    key_numbers,
    loops_table,
    mode_words,
    network_rows,
    schedule_tables,
    shares_network,
    timing_table,
)
from cosim.output.run_verdict import remarks, verdict
from cosim.record.run_directory import (
    ENVIRONMENT_FILE,
    REPORT_FILE,
    SCENARIO_FILE,
    SUMMARY_FILE,
    file_of_loop,
    read_object,
)
from cosim.record.run_record import RecordedRun
from noack.core.errors import CallerError
from noack.core.file_access import write_whole
from noack.core.number_format import seconds
from noack.scenario.scenario import Scenario

PROCESS_FIGURES = ("lateness", "latency", "clocks")
"""These have a section of their own, after the signals."""

Content = Mapping[str, object]
"""What a template shows."""
SECTIONS: "dict[str, Callable[[Report], Content | None]]" = {}
"""The sections in their order, by the names of their templates."""


@dataclass(frozen=True)
class Report:
    """What a report shows."""

    summary: RunSummary
    """Of the run, or of one of its loops."""
    scenario: Scenario
    """The resolved scenario of the loop in detail."""
    number: int
    """Of this loop."""
    why: str = ""
    """Why this loop is shown in detail."""
    figures: Sequence[PageFigure] = ()
    """Of this loop."""
    network_figures: Sequence[PageFigure] = ()
    description: str = ""
    scenario_toml: str = ""
    """The scenario of the run, as stored in the run directory."""
    environment: Mapping[str, object] = field(default_factory=dict)
    """The content of ``environment.json``; empty if there is none."""
    links: Mapping[str, str] = field(default_factory=dict)
    """Addresses of the reports of loops, by name."""

    @property
    def detail(self) -> RunSummary:
        """The summary of the loop in detail."""
        name = next(loop.name for loop in self.summary.loops if loop.number == self.number)
        return self.summary.of_loop(name)

    @property
    def loop(self) -> LoopSummary:
        """The loop in detail."""
        return self.detail.loops[0]

    @property
    def shares_network(self) -> bool:
        """Whether the page is that of several loops on one network."""
        return shares_network(self.summary)

    @property
    def subtitle(self) -> str:
        """One line: kind of the run, mode, M − 1, start."""
        mode = f", {mode_words(self.loop.mode)}"
        if self.shares_network:
            mode = f" of {len(self.summary.loops)} loops on one network"
        started = self.environment.get("started")
        when = f", started {started}" if started else ""
        return f"{self.summary.kind} run{mode}, {caps_text(self.summary)}{when}"


@np.errstate(all="ignore")  # a run may diverge
def write_report(
    run: RecordedRun,
    summary: RunSummary,
    run_dir: Path,
    loop: str | None = None,
    over_time: Sequence[LoopOverTime] | None = None,
) -> Path:
    """Write the report of a run, or of one of its loops; replace an existing one.

    ``over_time`` is how each loop of the run went, if that is known.

    Returns:
        The report's path.

    Raises:
        CallerError: the summary is of another run.
        MachineError: the report cannot be written.
    """
    shown = summary if loop is None else summary.of_loop(loop)
    worst = worst_loop(shown.loops)
    if worst.number >= len(run.names):
        raise CallerError(
            f"{run_dir / SUMMARY_FILE}: has loop {worst.number}, and the run has {len(run.names)}; if it is "
            "of another run, remove it: `noack summary RUN` computes it again"
        )
    record = run.record(worst.number)
    described = run_figures(record, envelopes(record), timed=shown.kind == "live")
    report = Report(
        shown,
        record.scenario,
        worst.number,
        worst.why,
        figures=[describe() for describe in described.values()],
        network_figures=network_figures(run, shown, over_time) if shown.loops[1:] else (),
        description=(run if shown.loops[1:] else record).scenario.description,
        scenario_toml=(run_dir / SCENARIO_FILE).read_text(encoding="utf-8"),
        environment=read_object(run_dir / ENVIRONMENT_FILE),
        links={
            each.name: quote(file)
            for each in shown.loops
            if (run_dir / (file := file_of_loop(REPORT_FILE, each.name))).is_file()
        },
    )
    return write_whole(run_dir / file_of_loop(REPORT_FILE, loop), page(report))


def page(report: Report) -> str:
    """Return a report as HTML; everything but figures is escaped."""
    contents = [(name, content(report)) for name, content in SECTIONS.items()]
    sections = [(name, content) for name, content in contents if content is not None]
    return templates().get_template("report.html.jinja").render(report=report, sections=sections)


def section(content: "Callable[[Report], Content | None]") -> None:
    """Register a section; its template has the name of the function, without ``_``."""
    SECTIONS[content.__name__.removeprefix("_")] = content


@section
def _verdict(report: Report) -> Content:
    lines = verdict(report.summary)
    notes = [remark.text for remark in remarks(report.detail)]
    tones = {line.tone for line in lines} - {Tone.NEUTRAL}
    is_good = tones == {Tone.GOOD} and (report.shares_network or not notes)
    tone = Tone.GOOD if is_good else Tone.DOUBTFUL
    return {
        "lines": [line.text for line in lines],
        "tone": Tone.BAD if Tone.BAD in tones else tone,
        "remarks": [] if report.shares_network else notes,
    }


@section
def _network(report: Report) -> Content | None:
    if not report.shares_network:
        return None
    return {"rows": network_rows(report.summary), "figures": report.network_figures}


@section
def _loops(report: Report) -> Content | None:
    if not report.shares_network:
        return None
    loops = sorted(report.summary.loops, key=badness, reverse=True)
    return {
        "caption": LOOPS_CAPTION,
        "table": loops_table(loops, ""),
        "links": report.links,
    }


@section
def _worst_loop(report: Report) -> Content | None:
    if not report.shares_network:
        return None
    loop, why = report.loop, report.why
    return {
        "name": loop.name,
        "why": f"{why[:1].upper()}{why[1:]}. Its time starts {seconds(loop.phase_s)} after that of the run.",
        "remarks": [remark.text for remark in remarks(report.detail)],
    }


@section
def _signals(report: Report) -> Content:
    return {"figures": [figure for figure in report.figures if figure.name not in PROCESS_FIGURES]}


@section
def _numbers(report: Report) -> Content:
    loop = report.loop.model_copy(update={"replay": None})  # has its own section
    detail = report.detail.model_copy(update={"loops": [loop]})
    return {"numbers": key_numbers(detail), "parameters": [*_parameters(report.scenario)]}


@section
def _claims(report: Report) -> Content | None:
    loop = report.loop
    return {"claims": loop.claims, "tables": [*schedule_tables(loop)]} if loop.claims else None


@section
def _assumptions(report: Report) -> Content | None:
    return {"assumptions": report.loop.assumptions} if report.loop.assumptions else None


@section
def _timing(report: Report) -> Content | None:
    figures = [figure for figure in report.figures if figure.name in PROCESS_FIGURES]
    table = timing_table(report.loop)
    return {"table": table, "figures": figures} if table.rows or figures else None


@section
def _replay(report: Report) -> Content | None:
    return {"replay": report.loop.replay} if report.loop.replay else None


@section
def _scenario(report: Report) -> Content:
    return {
        "kind": "" if report.shares_network else "resolved ",
        "toml": report.scenario_toml,
        "environment": environment_rows(report.environment),
    }


@section
def _words(report: Report) -> Content:
    return {"terms": TERMS}


def _parameters(scenario: Scenario) -> Iterator[tuple[str, str]]:
    trigger, network = scenario.trigger, scenario.network
    steps = scenario.plant.measure_every
    loss = network.loss.model_dump(exclude={"model"}, exclude_defaults=True)
    model = network.loss.model.replace("_", "-")
    details = _settings(loss)
    yield "between updates", scenario.between_updates
    yield "trigger", trigger.description
    yield "norm of errors", "‖e‖₂" if trigger.weight is None else "‖W e‖₂, W from the scenario"
    yield "M − 1", f"{network.mansd}" + ("" if network.enforce_mansd else ", not enforced")
    if network.constraints:
        yield "constraints on losses", ", ".join(rule.text() for rule in network.constraints)
    yield "loss", f"{model} ({details})" if details else model
    if scenario.protocol.acknowledges:
        timeout_ms = 1e-6 * scenario.timing.acknowledgement_timeout_ns
        lost = _settings(network.reverse.loss.model_dump())
        yield "acknowledgements", f"loss: {lost}; timeout {timeout_ms:g} ms"
    if (actuation := network.actuation) is not None:
        longest = actuation.link.longest_burst
        limit = "no guarantee" if longest is None else f"at most {longest} consecutive losses"
        yield "actuations", f"loss: {_settings(actuation.loss.model_dump())}; {limit}"
    yield "initial synchronisation", network.initial_sync.replace("_", " ")
    yield "plant", f"{scenario.plant.rate_hz:g} steps/s"
    yield "measurements", "every step" if steps == 1 else f"every {steps} steps"
    controller = scenario.controller
    yield "controller", f"{controller.rate_hz:g} ticks/s, phase {controller.phase:g}"
    yield "horizon", f"{scenario.horizon_s:g} s at speed {scenario.speed:g}"
    x0 = np.array(scenario.plant.initial_state)
    yield "‖x(0)‖", f"{np.linalg.norm(x0):.4g}, {len(x0)} states"
    seeds = scenario.seeds
    yield "seeds", f"plant {seeds.plant}, initial state {seeds.initial_state}, loss {seeds.loss}"


def _settings(values: Mapping[str, object]) -> str:
    return ", ".join(f"{words(key)} {value_text(value)}" for key, value in values.items())


def environment_rows(environment: Mapping[str, object]) -> list[tuple[str, str]]:
    """Return the properties of the environment, and their values as text."""
    return [
        (words(key), " ".join(map(str, value)) if isinstance(value, list) else value_text(value))
        for key, value in environment.items()
    ]
