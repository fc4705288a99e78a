"""Two runs side by side: which settings differ, and what follows, in words and numbers."""

import math
from typing import NamedTuple

import numpy as np

from cosim.interactive.draft import differences, leaf, value_text
from cosim.interactive.exploration import Exploration
from noack.core.number_format import number

_MOST_SETTINGS, _LONGEST = 4, 28
_NEARLY = 1.001
_END = "‖x‖ at the end"
_NOT_COMPARED = ("name", "ports", "recovery", "realtime")
"""Tables and keys that do not change what the loop does."""


class Reference(NamedTuple):
    """A run that others are compared with."""

    name: str
    """What it is, in words."""
    run: Exploration


class Comparison(NamedTuple):
    """What distinguishes a run from a reference."""

    title: str
    settings: str
    """The settings that differ, with both values."""
    rows: tuple[tuple[str, str, str, str], ...]
    """Quantity, its value in the reference and in the run, and the difference in words."""


def compare(reference: Reference, run: Exploration) -> Comparison:
    """Compare a run with a reference."""
    last_s = [float(one.t_s[-1]) for one in (reference.run, run)]
    until_s = min(last_s)
    until = f", until {number(until_s, 3)} s" if max(last_s) > until_s * _NEARLY else ""
    before, after = (_measured(one, until_s) for one in (reference.run, run))
    rows = (
        *(_counts(name, before[name], after[name]) for name in ("transmissions", "lost")),
        *(_sizes(name, before[name], after[name]) for name in (_END, "largest ‖e_c‖")),
    )
    return Comparison(f"compared with {reference.name}{until}", _settings(reference.run, run), rows)


def _measured(run: Exploration, until_s: float) -> dict[str, float]:
    """Return the numbers of a run up to a time."""
    sent, drawn = run.event_s <= until_s, run.t_s <= until_s
    errors = run.e_c_norm[drawn & run.controller_knows & np.isfinite(run.e_c_norm)]
    return {
        "transmissions": int(sent.sum()),
        "lost": int((sent & ~run.delivered).sum()),
        _END: float(np.interp(until_s, run.t_s, run.x_norm)),
        "largest ‖e_c‖": float(errors.max(initial=0.0)) if len(errors) else math.nan,
    }


def _settings(other: Exploration, run: Exploration) -> str:
    """Return which settings differ; matrices by their names only."""
    before, after = (
        one.scenario.model_dump(mode="json", exclude_none=True) for one in (other, run)
    )
    found = []
    for key, _ in differences(before, after):
        old, new = (leaf(content, key) for content in (before, after))
        if key.partition(".")[0] in _NOT_COMPARED:
            continue
        is_long = any(len(_text(value)) > _LONGEST for value in (old, new))
        found.append(key if is_long else f"{key} {_text(old)} → {_text(new)}")
    if not found:
        return "The settings are the same."
    more = f" and {len(found) - _MOST_SETTINGS} more" if len(found) > _MOST_SETTINGS else ""
    return f"Settings that differ: {', '.join(found[:_MOST_SETTINGS])}{more}."


def _text(value: object) -> str:
    return value_text(value) if isinstance(value, str | int | float | list | dict) else "–"


def _counts(name: str, before: float, after: float) -> tuple[str, str, str, str]:
    change = after - before
    words = f"{abs(change):g} {'more' if change > 0 else 'fewer'}" if change else "the same"
    return name, f"{before:g}", f"{after:g}", words


def _sizes(name: str, before: float, after: float) -> tuple[str, str, str, str]:
    texts = [number(value, 3) if math.isfinite(value) else "–" for value in (before, after)]
    words = "–"
    if texts[0] == texts[1]:
        words = "the same" if math.isfinite(before) else "–"
    elif math.isfinite(before) and math.isfinite(after) and before > 0:
        ratio = number(after / before, 3)
        words = "nearly the same" if ratio == "1" else f"{ratio} times as large"
    return name, texts[0], texts[1], words
