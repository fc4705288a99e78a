"""The report of a run: its summary and its figures, as a document with a page.

A report has sections. Each is a function here that yields the blocks that the section shows. The page
of a run shows the network, the loops and the worst loop in detail; where one loop has the network for
itself, that is the page of the loop.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from urllib.parse import quote

import numpy as np

from cosim.analysis.summary.loops_over_time import LoopOverTime
from cosim.analysis.summary.run_summary import worst_loop
from cosim.analysis.summary.summary_model import LoopSummary, RunSummary
from cosim.output.conformance_words import conformance_text
from cosim.output.figures.network_figures import network_figures
from cosim.output.figures.page_figure import PageFigure
from cosim.output.figures.run_figures import envelopes, run_figures
from cosim.output.page_kit import TERMS, document_page, value_text, words
from cosim.output.run_tables import (
    LOOPS_CAPTION,
    badness,
    caps_text,
    claims_in_full,
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
from netem.core.errors import CallerError
from netem.core.file_access import write_whole
from netem.core.number_format import seconds
from netem.output.document import Block, Document, Folded, Heading, Sentence
from netem.output.result_tables import KEY_VALUE, ResultTable
from noack.scenario.scenario import Scenario

PROCESS_FIGURES = ("lateness", "latency", "clocks")
"""These have a section of their own, after the signals."""


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
        """One line: kind of the run, mode, most losses in a row, start."""
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
    return write_whole(run_dir / file_of_loop(REPORT_FILE, loop), document_page(report_document(report)))


def report_document(report: Report) -> Document:
    """Return what a report shows, from the verdict to the meaning of its words."""
    shares = report.shares_network
    sections = [
        *([_network, _loops, _worst_loop] if shares else [_remarks]),
        _signals, _numbers, _claims, _timing, _replay, _scenario, _words,
    ]  # fmt: skip
    return Document(
        title=report.summary.scenario,
        kind="report",
        subtitle=report.subtitle,
        description=report.description,
        blocks=[*verdict(report.summary), *chain.from_iterable(section(report) for section in sections)],
    )


def _remarks(report: Report) -> Iterator[Block]:
    yield from remarks(report.detail)


def _network(report: Report) -> Iterator[Block]:
    first, *others = report.network_figures
    yield Heading("Network")
    yield _pairs("All loops together", network_rows(report.summary))
    yield first
    yield Heading("Errors and states of all loops")
    yield from others


def _loops(report: Report) -> Iterator[Block]:
    loops = sorted(report.summary.loops, key=badness, reverse=True)
    order = "Failed loops come first; the others by claims violated, ended or unchecked, burst and ‖e_c‖"
    yield Heading("Loops")
    yield Sentence(
        text="A name with a link has a report of its own. That of another loop is written by “noack report "
        "RUN --loop NAME”, and then linked here by “noack report RUN --again”; RUN is this folder."
    )
    yield loops_table(loops, f"{LOOPS_CAPTION}. {order}")._replace(links=report.links)


def _worst_loop(report: Report) -> Iterator[Block]:
    starts = f"Its time starts {seconds(report.loop.phase_s)} after that of the run"
    why = f"{report.why[:1].upper()}{report.why[1:]}"
    yield Heading(f"The worst loop: {report.loop.name}")
    yield Sentence(text=f"{why}. {starts}. The following sections are about it.")
    for remark in remarks(report.detail):
        yield Sentence(text=remark.text, lead=remark.lead)


def _signals(report: Report) -> Iterator[Block]:
    yield Heading("Signals")
    yield from (figure for figure in report.figures if figure.name not in PROCESS_FIGURES)


def _numbers(report: Report) -> Iterator[Block]:
    loop = report.loop.model_copy(update={"replay": None})  # has its own section
    yield Heading("Key numbers")
    yield _pairs("Results", key_numbers(report.detail.model_copy(update={"loops": [loop]})))
    yield _pairs("Scenario", [*_parameters(report.scenario)])


def _claims(report: Report) -> Iterator[Block]:
    if not report.loop.claims:
        return
    yield Heading("Claims")
    yield Sentence(
        text="The claims about this run, and what was observed. Share used is the largest share of the bound "
        "that the run reached; a bound that is computed from the run itself is reached by construction. "
        "Ended: the bound held until then, and nothing is claimed of the time after. Unchecked: nothing was "
        "compared. Not applicable: the run exceeded the bound, but does not meet its assumption, and so does "
        "not refute it."
    )
    yield from (Sentence(text=_sentence(conformance_text(part))) for part in report.loop.conformance)
    yield claims_in_full(report.loop)
    yield from map(_capitalized, schedule_tables(report.loop))


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


def _timing(report: Report) -> Iterator[Block]:
    table = timing_table(report.loop)
    figures = [figure for figure in report.figures if figure.name in PROCESS_FIGURES]
    if table.rows or figures:
        yield Heading("Timing")
        yield from [_capitalized(table)] if table.rows else []
        yield from figures


def _replay(report: Report) -> Iterator[Block]:
    if (replay := report.loop.replay) is None:
        return
    yield Heading("Replay")
    if replay.bit_exact is None:
        text = f"Nothing could be replayed: {replay.error or 'the record is empty'}."
    elif replay.bit_exact:
        text = (
            f"The {replay.inputs:,} recorded inputs were replayed: the outputs equal the record, bit for bit."
        )
    else:
        difference = replay.first_difference
        text = f"The recorded inputs were replayed: an output differs from the record: {difference}."
    yield Sentence(text=text)
    if not replay.complete:
        yield Sentence(text="The record has gaps, which could not be compared.")


def _scenario(report: Report) -> Iterator[Block]:
    kind = "" if report.shares_network else "resolved "
    yield Heading("Scenario and environment")
    yield Folded(f"The {kind}scenario (TOML)", report.scenario_toml)
    if report.environment:
        yield _pairs("Environment", environment_rows(report.environment))


def _words(report: Report) -> Iterator[Block]:
    yield Heading("What the words mean")
    yield ResultTable("", "", ("word", "meaning"), TERMS, left=range(2))


def _pairs(caption: str, rows: Sequence[tuple[str, str]]) -> ResultTable:
    return ResultTable("", caption, KEY_VALUE, rows, left=range(2))


def _capitalized(table: ResultTable) -> ResultTable:
    return table._replace(caption=f"{table.caption[:1].upper()}{table.caption[1:]}")


def _parameters(scenario: Scenario) -> Iterator[tuple[str, str]]:
    trigger, network = scenario.trigger, scenario.network
    steps = scenario.plant.measure_every
    loss = network.loss.model_dump(exclude={"model"}, exclude_defaults=True)
    model = network.loss.model.replace("_", "-")
    details = _settings(loss)
    yield "between updates", scenario.between_updates
    yield "trigger", trigger.description
    yield "norm of errors", "‖e‖₂" if trigger.weight is None else "‖W e‖₂, W from the scenario"
    yield "lost in a row, at most", f"{network.mansd}" + ("" if network.enforce_mansd else ", not enforced")
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
