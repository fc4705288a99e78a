"""Measuring our side and the alternative in turn."""

import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Goal, MeasurementError, Peer, Row, announce

Figures = Mapping[str, float]
"""The figures of one side in one round, by quantity."""


def quantiles_us(values_ns: Sequence[float] | NDArray[Any]) -> Figures:
    """Return ``p50`` and ``p99`` of values in ns, in µs."""
    p50_us, p99_us = (np.quantile(values_ns, (0.5, 0.99)) / 1e3).tolist()
    return {"p50": p50_us, "p99": p99_us}


class Rounds:
    """Figures of several sides that are measured in turn, each once per round."""

    def __init__(self) -> None:
        self.missing: dict[str, str] = {}
        """For each side without valid figures, the reason."""
        self._figures = defaultdict[str, list[Figures]](list)

    def add(self, side: str, figures: Figures) -> None:
        """Add a side's figures of a round."""
        self._figures[side].append(figures)

    def measure_in_turn(self, count: int, sides: Mapping[str, Callable[[], Figures]], head: str = "") -> None:
        """Measure the sides in turn, in some rounds; one that fails is missing from then on."""
        for number in range(count):
            announce(f"{head}round {number + 1} of {count}")
            for side in [side for side in sides if side not in self.missing]:
                try:
                    self.add(side, sides[side]())
                except MeasurementError as error:
                    self.missing[side] = str(error)

    def values(self, side: str, quantity: str) -> list[float]:
        """Return the values of a quantity, one of each round; empty if the side failed in one."""
        return [] if side in self.missing else [figures[quantity] for figures in self._figures[side]]

    def row(
        self, name: str, unit: str, quantity: str, ours: str, peer: str | None = None,
        goal: Goal | None = None, *, note: str | None = None, paired: bool = False,
    ) -> Row:  # fmt: skip
        """Return the row of a quantity: the medians of our side and of the alternative's.

        With ``paired``, the ratio is the median of the rounds' ratios, since a disturbance affects
        both sides of a round; else it is the ratio of the medians.
        """
        reasons = [f"{side}: {self.missing[side]}" for side in (ours, peer or "") if side in self.missing]
        value, alternative = self.values(ours, quantity), self.values(peer or "", quantity)
        ratio = None
        if paired and not reasons:
            ratio = median(own / other for own, other in zip(value, alternative, strict=True))
        return Row(
            name,
            median(value) if value else None,
            unit,
            None if peer is None else Peer(peer, median(alternative) if alternative else None),
            goal,
            "; ".join(filter(None, (*reasons, note))) or None,
            ratio,
        )


Side = Callable[[], float]
"""Measures one figure of a side."""


def compare(
    name: str, unit: str, ours: Side, peer: tuple[str, Side] | Peer | None = None,
    goal: Goal | None = None, *, note: str | None = None, rounds: int = 5,
) -> Row:  # fmt: skip
    """Measure our side and the alternative in turn; the ratio is the median of the rounds' ratios.

    The alternative may also be a known figure.
    """
    announce(name)
    if peer is None or isinstance(peer, Peer):
        return Row(name, median(ours() for _ in range(rounds)), unit, peer, goal, note)
    pairs = [(ours(), peer[1]()) for _ in range(rounds)]
    value, other = (median(side) for side in zip(*pairs, strict=True))
    ratio = median(a / b for a, b in pairs)
    return Row(name, value, unit, Peer(peer[0], other), goal, note, ratio)


def cpu_ms(call: Callable[[], object]) -> Side:
    """Return a side: milliseconds of CPU time of a call, which other load changes little."""
    return lambda: 1e3 * _cpu_s(call)


def per_cpu_s(count: float, call: Callable[[], object]) -> Side:
    """Return a side: ``count`` items per second of CPU time of a call."""
    return lambda: count / _cpu_s(call)


def _cpu_s(call: Callable[[], object]) -> float:
    began_s = time.process_time()
    call()
    return max(time.process_time() - began_s, 1e-9)
