"""The page ``paper.md``: the text of a template with the numbers of the results."""

import re
import textwrap
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from cosim.studies.campaign.metrics import paired, quartiles
from cosim.studies.paper.paper_campaign import BASE, MODES, OTHER_EXAMPLES, STEP_S, settings_of
from cosim.studies.paper.paper_claims import CONFIRMED_FROM, PARTLY_FROM, claims
from cosim.studies.paper.paper_results import HORIZON_S, Results, number, percent, spread
from noack.core.linear_systems import Vector

_COLUMNS, _GLUE = 100, "\N{NO-BREAK SPACE}"
_ITEM = re.compile(r"\* |\d+\. ")
"""The mark of a list item in Markdown."""
_LOST = "lost"
_MEASURES = (
    ("transmissions", "events"),
    ("deliveries", "deliveries"),
    ("share lost", _LOST),
    ("median time between transmissions, s", "gap_median_s"),
    ("median time between deliveries, s", "reception_median_s"),
    ("shortest inter-event time, s", "gap_min_s"),
    ("settling time to 5 %, s", "settled_5_s"),
    ("settling time to 1 %, s", "settled_1_s"),
    ("sup ‖e_c‖e^(αt)/β", "controller_error"),
    ("sup ‖x‖/‖x(0)‖", "peak"),
    (f"‖x‖ at {HORIZON_S:g} s", "final_norm"),
)


def render(results: Results) -> str:
    """Return the page in Markdown."""
    templates = Environment(
        loader=FileSystemLoader(Path(__file__).parent), undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip
    templates.filters |= {"n": number, "percent": percent, "spread": spread}
    text = templates.get_template("paper.md.jinja").render(
        draws=results.count(),
        representative=results.representative,
        settings=settings_of(results.representative),
        horizon_s=HORIZON_S,
        step_s=STEP_S,
        confirmed_from=CONFIRMED_FROM,
        partly_from=PARTLY_FROM,
        claims=list(claims(results)),
        compared=list(_compared(results)),
        varied=list(_varied(results)),
        column=results.column,
        certified=partial(results.column, table="certified"),
        printed=partial(results.column, table="printed"),
        **_shares(results),
        **results.evidence,
    )
    return _wrapped(text)


def _wrapped(text: str) -> str:
    """Wrap the paragraphs of a Markdown page at 100 columns; tables and code stay as they are."""
    lines: list[str] = []
    paragraph, code = "", False
    for line in text.splitlines():
        start = line.lstrip()
        fence = start.startswith("```")
        kept = code or fence or not start or start[0] in "|#!<"
        code ^= fence
        if paragraph and (kept or _ITEM.match(start)):
            lines += _filled(paragraph)
            paragraph = ""
        if kept:
            lines.append(line)
        else:
            paragraph = f"{paragraph} {start}" if paragraph else line
    return "\n".join([*lines, *_filled(paragraph), ""])


def _filled(paragraph: str) -> list[str]:
    start = paragraph.lstrip()
    item = _ITEM.match(start)
    begin = len(paragraph) - len(start) + (item.end() if item else 0)
    # No line may begin with an operator that Markdown reads as a list mark.
    glued = paragraph[:begin] + re.sub(r" (?=[-+>=*] )", _GLUE, paragraph[begin:])
    lines = textwrap.wrap(
        glued, _COLUMNS, subsequent_indent=" " * begin,
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip
    return [line.replace(_GLUE, " ") for line in lines]


def _shares(results: Results) -> dict[str, Any]:
    column = results.column
    events, settled = _both(results, "events"), _both(results, "settled_5_s")
    margin_per_s = results.evidence["example"]["alpha_per_s"]
    return {
        "fewer": (events[0] < events[1]).mean(),
        "times": quartiles(events[1] / events[0]).median,
        "later": (settled[1] > settled[0]).mean(),
        "settle": np.isfinite(_both(results, "settled_1_s")).all(axis=0).mean(),
        "unstabilised": int((column("slowest_closed") > -margin_per_s).sum()),
        "not_unstable": (column("fastest_open") <= 0).mean(),
        "stretches": {m: float((column(f"{m}.deliveries") - 1).sum()) for m in MODES},
        "growing": {m: float(column(f"{m}.growing").sum()) for m in MODES},
    }


def _compared(results: Results) -> Iterator[dict[str, str]]:
    """Return the rows of the main table: a measure of both loops."""
    for what, name in _MEASURES:
        model, zoh = _both(results, name)
        yield {
            "what": what,
            "model": spread(model),
            "zoh": spread(zoh),
            "difference": spread(paired(zoh, model)),
            "larger": percent((zoh > model).mean()),
        }


def _varied(results: Results) -> Iterator[dict[str, str]]:
    """Return the rows of the table of variations."""
    for name in results.variations:
        events, settled, gap_min, lost = (
            _both(results, measure, name)
            for measure in ("events", "settled_5_s", "gap_min_s", _LOST)
        )
        yield {
            "what": name + (" *" if name in OTHER_EXAMPLES else ""),
            "draws": number(results.count(name)),
            "events": _medians(events),
            "lost": _medians(lost, percent),
            "gap_min": _medians(gap_min),
            "settled": _medians(settled),
            "more": percent((events[1] > events[0]).mean()),
            "later": percent((settled[1] > settled[0]).mean()),
        }


def _both(results: Results, name: str, variation: str = BASE) -> list[Vector]:
    """Return a measure of MB-ET and of ZOH-ET."""
    if name == _LOST:
        return [results.lost(mode, variation) for mode in MODES]
    return [results.column(f"{mode}.{name}", variation) for mode in MODES]


def _medians(both: list[Vector], written: Callable[[float], str] = number) -> str:
    return " / ".join(written(quartiles(values).median) for values in both)
