"""Words about an explored run: its verdict, and what distinguishes it from another run."""

import math
from typing import NamedTuple

import numpy as np

from cosim.analysis.summary.summary_model import ExitPart
from cosim.interactive.exploration import Exploration
from cosim.interactive.scenario_draft import differences, leaf, value_text
from cosim.interactive.scenario_guarantee import CERTIFIED, VOID, Guarantee
from cosim.output.run_verdict import Tone, VerdictLine, ending_line, state_text, transmission_line
from noack.core.errors import ExitStatus
from noack.core.number_format import number, percent
from noack.guarantee.loss_guarantee import LossHistory
from noack.runtime.life_cycle import HORIZON

_MOST_SETTINGS, _LONGEST_VALUE = 4, 28
"""Largest number of settings that are named, and of characters of a value that is shown."""
_EQUAL_LENGTH_RATIO = 1.001
"""Runs whose ends differ by a smaller factor are compared as equally long."""
_END = "‖x‖ at the end"
_NOT_COMPARED = ("name", "ports", "realtime")
"""Tables and keys that do not change what the loop does."""


class Reference(NamedTuple):
    """A run that others are compared with."""

    name: str
    """What it is, in words."""
    run: Exploration


class ComparedNumber(NamedTuple):
    """A quantity of two runs, as text."""

    quantity: str
    in_reference: str
    in_run: str
    difference: str
    """In words."""


class Comparison(NamedTuple):
    """What distinguishes a run from a reference."""

    title: str
    settings: str
    """The settings that differ, with both values."""
    rows: tuple[ComparedNumber, ...]


def compare(reference: Reference, run: Exploration) -> Comparison:
    """Compare a run with a reference."""
    last_s = [float(part.t_s[-1]) for part in (reference.run, run)]
    until_s = min(last_s)
    until = f", until {number(until_s, 3)} s" if max(last_s) > until_s * _EQUAL_LENGTH_RATIO else ""
    old, new = (_measure(part, until_s) for part in (reference.run, run))
    rows = (
        *(_compare_counts(name, old[name], new[name]) for name in ("transmissions", "lost")),
        *(_compare_sizes(name, old[name], new[name]) for name in (_END, "largest ‖e_c‖")),
    )
    return Comparison(f"compared with {reference.name}{until}", _compare_settings(reference.run, run), rows)


def _measure(run: Exploration, until_s: float) -> dict[str, float]:
    """Return the numbers of a run up to a time."""
    sent, drawn = run.event_s <= until_s, run.t_s <= until_s
    errors = run.e_c_norm[drawn & run.controller_has_state & np.isfinite(run.e_c_norm)]
    return {
        "transmissions": int(sent.sum()),
        "lost": int((sent & ~run.delivered).sum()),
        _END: float(np.interp(until_s, run.t_s, run.x_norm)),
        "largest ‖e_c‖": float(errors.max(initial=0.0)) if len(errors) else math.nan,
    }


def _compare_settings(reference: Exploration, run: Exploration) -> str:
    """Return which settings differ; matrices by their names only."""
    before, after = (part.scenario.model_dump(mode="json", exclude_none=True) for part in (reference, run))
    texts = []
    for key, _ in differences(before, after):
        old, new = (leaf(content, key) for content in (before, after))
        if key.partition(".")[0] in _NOT_COMPARED:
            continue
        is_long = any(len(_text(value)) > _LONGEST_VALUE for value in (old, new))
        texts.append(key if is_long else f"{key} {_text(old)} → {_text(new)}")
    if not texts:
        return "The settings are the same."
    more = f" and {len(texts) - _MOST_SETTINGS} more" if len(texts) > _MOST_SETTINGS else ""
    return f"Settings that differ: {', '.join(texts[:_MOST_SETTINGS])}{more}."


def _text(value: object) -> str:
    return value_text(value) if isinstance(value, str | int | float | list | dict) else "–"


def _compare_counts(name: str, old: float, new: float) -> ComparedNumber:
    change = new - old
    words = f"{abs(change):g} {'more' if change > 0 else 'fewer'}" if change else "the same"
    return ComparedNumber(name, f"{old:g}", f"{new:g}", words)


def _compare_sizes(name: str, old: float, new: float) -> ComparedNumber:
    texts = [number(value, 3) if math.isfinite(value) else "–" for value in (old, new)]
    words = "–"
    if texts[0] == texts[1]:
        words = "the same" if math.isfinite(old) else "–"
    elif math.isfinite(old) and math.isfinite(new) and old > 0:
        ratio = number(new / old, 3)
        words = "nearly the same" if ratio == "1" else f"{ratio} times as large"
    return ComparedNumber(name, texts[0], texts[1], words)


def verdict_of(run: Exploration, guarantee: Guarantee | None) -> tuple[VerdictLine, ...]:
    """Return the verdict of an explored run, in the three lines that a live run ends with.

    Without ``guarantee`` the certificate is still being computed.
    """
    horizon_s, reached_s = run.scenario.horizon_s, float(run.t_s[-1])
    status, reason = ExitStatus.OK, HORIZON
    if run.diverged_at_s is not None:
        status, reason = ExitStatus.FAILED, f"diverged at {number(run.diverged_at_s, 4)} s"
    elif run.cut_reason:
        status, reason = ExitStatus.INTERRUPTED, run.cut_reason
    name, norm = run.labelled_norm
    first, largest, last = float(norm[0]), float(np.nanmax(norm)), float(norm[-1])
    state = state_text(first, largest, last, None, name) if run.diverged_at_s is None else ""
    events = len(run.event_s)
    return (
        ending_line(ExitPart(status=status, reason=reason), reached_s, horizon_s, state),
        _guarantee_line(run, guarantee),
        transmission_line(events, events - run.lost),
    )


def _guarantee_line(run: Exploration, guarantee: Guarantee | None) -> VerdictLine:
    if guarantee is None:
        return VerdictLine("guarantee: being computed", Tone.NEUTRAL)
    if guarantee.verdict != CERTIFIED:
        reason = guarantee.reason if guarantee.verdict != VOID else f"{VOID}: {guarantee.reason}"
        return VerdictLine(f"guarantee not checkable: {reason}", Tone.DOUBTFUL)
    if not run.scenario.network.enforce_mansd and (violation := _loss_too_many(run)):
        return VerdictLine(f"guarantee broken since {violation}", Tone.BAD)
    with np.errstate(all="ignore"):
        shares = [
            values / np.exp(np.interp(run.t_s, guarantee.t_s, np.log(bound)))
            for values, bound in (
                (np.where(run.controller_has_state, run.e_c_norm, 0.0), guarantee.e_c),
                (run.x_norm, guarantee.x),
            )
        ]
    above = np.nanmax(np.stack([*shares, np.zeros_like(run.t_s)]), axis=0) > 1
    if above.any():
        return VerdictLine(f"guarantee broken since {run.t_s[above][0]:.3f} s", Tone.BAD)
    share = percent(float(np.nanmax(np.append(shares[0], 0.0))))
    return VerdictLine(f"guarantee kept: ‖e_c‖ was at most {share} of its bound", Tone.GOOD)


def _loss_too_many(run: Exploration) -> str:
    """Return when and how the losses first exceed what the bounds assume; empty if they never do."""
    history = LossHistory(run.scenario.network.guarantee.rules)
    for at_s, delivered in zip(run.event_s, run.delivered, strict=True):
        for rule, value in history.add(not delivered):
            return f"{at_s:.3f} s: {rule.violation(value)}"
    return ""
