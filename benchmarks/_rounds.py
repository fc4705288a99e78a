"""Rows of figures that were measured in turn with their alternatives, one of each per round."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from benchmarks._report import Goal, Peer, Row, median


class Comparison(NamedTuple):
    """Whose figure is compared with whose."""

    ours: str
    peer: str
    goal: Goal | None = None


def paired(
    figure: str,
    unit: str,
    comparison: Comparison,
    rounds: Mapping[str, Sequence[float]],
    missing: Mapping[str, str],
    note: str | None = None,
) -> Row:
    """Return the row of a comparison.

    What disturbs a round disturbs both sides, so the ratio is the median of the rounds' ratios.

    Args:
        figure: what was measured.
        unit: its unit.
        comparison: whose figures.
        rounds: by name, the figures of all rounds.
        missing: by name of who was not measured, why.
        note: for the reader.
    """
    ours, theirs = rounds.get(comparison.ours, ()), rounds.get(comparison.peer, ())
    reasons = [
        f"{name}: {missing[name]}"
        for name in (comparison.ours, comparison.peer)
        if name in missing
    ]  # fmt: skip
    ratios = [our / their for our, their in zip(ours, theirs, strict=True)] if not reasons else []
    return Row(
        f"{comparison.ours}: {figure}",
        median(ours) if ours else None,
        unit,
        Peer(comparison.peer, median(theirs) if theirs else None),
        comparison.goal,
        note,
        "; ".join(reasons) or None,
        median(ratios) if ratios else None,
    )
