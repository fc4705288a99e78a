"""The page ``paper.md``: the text of a template with the numbers of the campaign ``paper``.

``figures/paper.json`` has these numbers: the campaign's summary, and the evidence.
"""

import json
import math
import re
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from cosim.output.curves import state_curves
from cosim.output.figures.figure_description import FigureDescription
from cosim.output.figures.figure_files import save_figure
from cosim.output.figures.run_figures import Transmissions, states_figure
from cosim.simulation.continuous import run_continuous
from cosim.simulation.exact_simulation import timeless
from cosim.studies.campaign.campaign_figures import figures
from cosim.studies.campaign.campaign_report import FinishedCampaign
from cosim.studies.campaign.campaign_summary import CONFIRMED_FROM, PARTLY_FROM, runs_at, share_text
from cosim.studies.campaign.metrics import METRICS, Metric, quartiles
from cosim.studies.paper.paper_evidence import MODES, evidence, resolved_draw
from netem.channel import UPDATE_LINK
from netem.link_state import LinkState
from noack.core.errors import MachineError, why
from noack.core.file_access import write_whole
from noack.protocol.record_tables import Fate, effective
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import dumps

BASE = "base: Bernoulli 0.8"
POLICIES = ("MB-ET", "ZOH-ET")
"""The paper's names of the loops."""
_OTHER_EXAMPLES = ("nothing lost", "box × 5", "box × 0: exact model")
"""Variations that change the paper's example. The others vary only unspecified settings."""
_EXAMPLE_METRICS: tuple[Metric, ...] = (
    "transmissions",
    "deliveries",
    "settling_s",
    "inter_event_min_s",
)
"""The metrics by which the representative draw is chosen."""
_DIGITS = 5
"""Number of significant digits in the file."""
_SMALL, _LARGE = 1e-3, 1e6
"""Numbers outside these limits are written with a power of ten."""
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_SHOWN_S, _STEP_S = 20.0, 0.01
"""A draw is shown up to this time; later values are too small to be visible."""
_COLUMNS, _GLUE = 100, "\N{NO-BREAK SPACE}"
_ITEM = re.compile(r"\* |\d+\. ")
"""The mark of a list item in Markdown."""

Document = dict[str, Any]


def make_folder(folder: Path) -> Path:
    """Make the folder of the page's figures before the simulations start; return it.

    Raises:
        MachineError: it cannot be made.
    """
    try:
        (folder / "figures").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise MachineError(f"{folder}: the page cannot be written: {why(error)}") from None
    return folder / "figures"


def write_page(campaign: FinishedCampaign, folder: Path) -> tuple[Document, list[Path]]:
    """Write page, figures and numbers; return the numbers and the written files.

    Raises:
        MachineError: they cannot be written.
    """
    document, inner = numbers(campaign), make_folder(folder)
    draw, scenario = document["representative"], _base(campaign)
    described = {figure.name: figure for figure in figures(campaign.summary, campaign.store)}
    described |= {
        policy.lower(): draw_figure(scenario, draw, mode)
        for policy, mode in zip(POLICIES, MODES, strict=True)
    }
    written = [
        write_whole(folder / "paper.md", render(document)),
        write_whole(inner / "paper.json", json.dumps(document, indent=1, ensure_ascii=False) + "\n"),
        write_whole(inner / "paper-draw.toml", dumps(resolved_draw(scenario, draw, "model"))),
    ]
    for name, figure in described.items():
        written.append(inner / f"paper-{name}.svg")
        save_figure(figure, written[-1])
    return document, written


def numbers(campaign: FinishedCampaign) -> Document:
    """Return the content of ``paper.json``: rounded, null for infinity."""
    draws, draw = campaign.summary.draws, _representative(campaign)
    document = {
        "representative": draw,
        "evidence": evidence(_base(campaign), draws, draw),
        "summary": campaign.summary.to_json(),
    }
    rounded: Document = rounded_numbers(document)
    return rounded


def _base(campaign: FinishedCampaign) -> Scenario:
    return campaign.store.points[0].scenario


def _representative(campaign: FinishedCampaign) -> int:
    """Return the draw nearest to the medians of the base, with both policies.

    Distance is the sum of squares of (value − median) / (upper − lower quartile).
    """
    distance = np.zeros(campaign.summary.draws)
    for point in (drawn for drawn in campaign.store.points if drawn.labels["variation"] == BASE):
        metrics, _ = runs_at(point, campaign.store)
        for name in _EXAMPLE_METRICS:
            low, middle, high = quartiles(metrics[name])
            if math.isfinite(high) and high > low:
                distance += ((metrics[name] - middle) / (high - low)) ** 2
    return int(np.argmin(distance))


def rounded_numbers(value: Any) -> Any:
    """Return values as in the JSON file: rounded, integers without a point, null for infinity."""
    if isinstance(value, Mapping):
        return {key: rounded_numbers(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [rounded_numbers(entry) for entry in value]
    if isinstance(value, str | bool | int) or value is None:
        return value
    if not math.isfinite(value):
        return None
    short = float(f"{value:.{_DIGITS}g}")
    return int(short) if short == round(short) and abs(short) < 10**_DIGITS else short


def draw_figure(scenario: Scenario, draw: int, mode: str) -> FigureDescription:
    """Describe states, broadcasting and receiving intervals of one loop of a draw."""
    resolved = resolved_draw(scenario, draw, "model" if mode == "model" else "zoh")
    run = run_continuous(resolved)
    event_s = run.event_s[run.event_s <= _SHOWN_S]
    samples = run.at(np.linspace(0.0, _SHOWN_S, round(_SHOWN_S / _STEP_S) + 1))
    link = LinkState(timeless(resolved.network.link), resolved.seeds.loss, UPDATE_LINK)
    link.start_flow(0, 0)
    fates = np.array([link.decide(0, 1, 0).fate for _ in event_s], dtype=np.int64)
    arrived = effective(fates)
    sent = Transmissions(event_s, ~arrived, event_s[arrived], fates[arrived] == Fate.FORCED)
    names = run.system.loop.state_names
    states = state_curves(names, samples.t_s, samples.x, samples.x_s, samples.x_c)
    return states_figure(resolved.mode, f"draw {draw}", samples.t_s, states, sent)


def render(document: Document) -> str:
    """Return the page in Markdown, from the content of ``paper.json``."""
    summary = document["summary"]
    point = {tuple(point["axes"].values()): point["metrics"] for point in summary["points"]}
    gaps = {difference["axes"]["variation"]: difference["metrics"] for difference in summary["differences"]}
    templates = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    templates.filters |= {"n": number, "percent": share_text}
    return _wrapped(
        templates.get_template("paper.md.jinja").render(
            draws=summary["draws"],
            representative=document["representative"],
            confirmed_from=CONFIRMED_FROM,
            partly_from=PARTLY_FROM,
            claims=summary["claims"],
            model=point[BASE, POLICIES[0]],
            zoh=point[BASE, POLICIES[1]],
            apart=gaps[BASE],
            compared=list(_metric_rows(point, gaps[BASE])),
            varied=list(_varied(point, gaps)),
            **document["evidence"],
        )
    )


def _metric_rows(point: Mapping[Any, Any], differences: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """Yield the rows of the main table: a metric of both loops."""
    for name, difference in differences.items():
        spreads = (_spread(point[BASE, policy][name]) for policy in POLICIES)
        larger = share_text(difference["larger"])
        yield METRICS[name].label, *spreads, _spread(difference), larger  # type: ignore[index]


def _varied(point: Mapping[Any, Any], gaps: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """Yield the rows of the table of variations: medians of both loops."""
    for name, differences in gaps.items():
        medians = (
            " / ".join(number(point[name, policy][metric]["median"]) for policy in POLICIES)
            for metric in ("transmissions", "lost_share", "inter_event_min_s", "settling_s")
        )
        larger = (share_text(differences[key]["larger"]) for key in ("transmissions", "settling_s"))
        yield name + (" *" if name in _OTHER_EXAMPLES else ""), *medians, *larger


def _spread(estimate: Mapping[str, float | None]) -> str:
    """Return median and quartiles: 517 (493 … 547)."""
    low, middle, high = (number(estimate[name]) for name in ("q25", "median", "q75"))
    return f"{middle} ({low} … {high})"


def number(value: float | None, digits: int = 3) -> str:
    """Return a number as text: 0.0123, 517, 2.8 · 10³³; ∞ for None."""
    if value is None or not math.isfinite(value):
        return "∞"
    if value == round(value) and abs(value) < _LARGE:
        text = f"{value:,.0f}"
    elif _SMALL <= abs(value) < _LARGE:
        short = float(f"{value:.{digits}g}")
        text = f"{short:,.0f}" if abs(short) >= 10**digits else f"{short:g}"
    else:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        power = f"10{str(int(exponent)).translate(_SUPERSCRIPTS)}"
        text = power if float(mantissa) == 1 else f"{float(mantissa):g} · {power}"
    return text.replace("-", "−")


def _wrapped(text: str) -> str:
    """Wrap the paragraphs of a Markdown page at 100 columns; tables and code stay as they are."""
    lines: list[str] = []
    paragraph, code = "", False
    for line in text.splitlines():
        start = line.lstrip()
        fence = start.startswith("```")
        is_verbatim = code or fence or not start or start[0] in "|#!<"
        code ^= fence
        if paragraph and (is_verbatim or _ITEM.match(start)):
            lines += _wrapped_lines(paragraph)
            paragraph = ""
        if is_verbatim:
            lines.append(line)
        else:
            paragraph = f"{paragraph} {start}" if paragraph else line
    return "\n".join([*lines, *_wrapped_lines(paragraph), ""])


def _wrapped_lines(paragraph: str) -> list[str]:
    start = paragraph.lstrip()
    item = _ITEM.match(start)
    begin = len(paragraph) - len(start) + (item.end() if item else 0)
    # No line may begin with an operator that Markdown reads as a list mark.
    glued = paragraph[:begin] + re.sub(r" (?=[-+>=*] )", _GLUE, paragraph[begin:])
    lines = textwrap.wrap(
        glued,
        _COLUMNS,
        subsequent_indent=" " * begin,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [line.replace(_GLUE, " ") for line in lines]
