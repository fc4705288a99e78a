"""The guarantee over very many decisions: violations, realised losses, and cost per decision.

Each combination is decided by the core, a million datagrams per flow; a check that does
not know the rules counts violations at the receiver. Costs alternate with those of the
plain cap that allows as many consecutive losses; the plain cap's, with those of calls from Python.
"""

import argparse
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks._loss_check import Limits, outcomes_of, violations
from benchmarks._report import Benchmark, Goal, Rounds, Row, say
from netem.link_state import LinkState
from netem.words.words_to_settings import settings_of
from noack.impairments.kept_loss import expected_loss

DECISIONS = 100_000_000
_BATCH = 1_000_000
_REORDERING = "delay 5ms 5ms reorder 20% duplicate 5% corrupt 5%"
COMBINATIONS: Mapping[str, Limits] = {
    "mansd 4": Limits(((4, 5),)),
    "atmost 3 in 10": Limits(((3, 10),)),
    "atmost 20 in 100": Limits(((20, 100),)),
    "mansd 4 recover 3": Limits(((4, 5),), 3),
    "mansd 2 atmost 3 in 10 recover 2": Limits(((2, 3), (3, 10)), 2),
}
EXPECTED = ("loss 50% mansd 4", "loss 30% keep mansd 2", "loss 20% keep atmost 3 in 10 recover 2",
            "loss 20% 50% keep mansd 3 atmost 3 in 10 corrupt 5%")  # fmt: skip
_ROUNDS = 30


class Decider:
    """Decides for a flow after the other, with this time between two datagrams."""

    def __init__(self, words: str, spacing_ns: int = 10_000) -> None:
        self._link, self._flow = LinkState(settings_of(words), 7, "relay", "forward"), 0
        self._sizes, self._rows = np.full(_BATCH, 72), np.zeros(_BATCH, np.int64)
        self._arrivals_ns = np.arange(_BATCH) * spacing_ns

    def decide(self, count: int = _BATCH) -> NDArray[Any]:
        """Return the decisions for the first datagrams of the next flow."""
        self._link.start_flow(0, self._flow)
        self._link.core.in_flight = 0
        self._flow += 1
        columns = (self._rows, self._sizes, self._arrivals_ns)
        return self._link.decide_many(*(column[:count] for column in columns))


def check_rows(words: str, limits: Limits, count: int) -> list[Row]:
    """Return the violations in a number of decisions."""
    say(f"{count:,} decisions, {words}")
    decider, found, lost = Decider(f"{words} limit 1000000"), 0, 0
    for _ in range(count // _BATCH):
        outcomes = outcomes_of(decider.decide())
        found, lost = found + violations(outcomes, limits), lost + int(outcomes.sum())
    note = f"{count:,} decisions, {lost / count:.2%} lost"
    return [Row(f"{words}: violations", found, "", goal=Goal("==", 0), note=note)]


def expected_row(words: str, count: int) -> Row:
    """Return the realised loss rate beside the expected one, which may be asked for (keep)."""
    say(f"{count:,} decisions, {words}")
    decider, lost = Decider(words), 0
    for _ in range(count // _BATCH):
        lost += int(outcomes_of(decider.decide()).sum())
    expected = expected_loss(settings_of(words)).rate or 0.0
    error = 100 * abs(lost / count - expected)
    note = f"{count:,} decisions: {lost / count:.4%} lost, {expected:.4%} expected"
    return Row(f"{words}: error", error, "% of all", goal=Goal("<=", 0.1), note=note)


def speed_row(words: str = "loss 50% mansd 4") -> Row:
    """Return the decisions per second of the core, at once beside one by one from Python."""
    say(f"speed of decisions, {words}")
    decider, link, rounds = (
        Decider(words),
        LinkState(settings_of(words), 7, "relay", "forward"),
        Rounds(),
    )

    link.start_flow(0, 0)

    def decide_one_by_one() -> None:
        for _ in range(_BATCH // 20):
            link.decide(0, 72, 0)

    sides = (("core", decider.decide, _BATCH), ("from Python", decide_one_by_one, _BATCH // 20))
    for number in range(-1, 5):
        for side, decide, count in sides:
            begun_s = time.perf_counter()
            decide()
            if number >= 0:
                rounds.add(side, {"per_s": count / (time.perf_counter() - begun_s)})
    return rounds.row(f"{words}: decisions", "/s", "per_s", "core", "from Python", paired=True)


def plain_cap(words: str) -> str:
    """Return the words of the plain cap that allows as many consecutive losses."""
    return f"mansd {settings_of(words).longest_burst}"


def cost_rows() -> list[Row]:
    """Return the time per decision beside that of the plain cap."""
    rounds = Rounds()
    for before in ("loss 50%", f"loss 50% {_REORDERING}"):
        every = dict.fromkeys([*COMBINATIONS, *map(plain_cap, COMBINATIONS)])
        deciders = {words: Decider(f"{before} {words} limit 1000000") for words in every}
        for number in range(-1, _ROUNDS):
            for words, decider in deciders.items():
                begun_s = time.perf_counter()
                decider.decide(200_000)
                spent_ns = 1e9 * (time.perf_counter() - begun_s) / 200_000
                if number >= 0:
                    rounds.add(f"{before} {words}", {"decision_ns": spent_ns})
    return [
        rounds.row(
            f"{before} {words}: decision", "ns", "decision_ns", f"{before} {words}",
            f"{before} {plain_cap(words)}", Goal("<=", 1.3), paired=True,
        )
        for before in ("loss 50%", f"loss 50% {_REORDERING}")
        for words in COMBINATIONS if words != plain_cap(words)
    ]  # fmt: skip


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure speed and costs, then violations, then loss rates."""
    rows = [speed_row(), *cost_rows()]
    for words, limits in COMBINATIONS.items():
        rows += check_rows(f"loss 50% {words}", limits, DECISIONS)
        rows += check_rows(f"loss 30% {_REORDERING} {words}", limits, DECISIONS)
    return rows + [expected_row(words, DECISIONS // 5) for words in EXPECTED]


BENCHMARK = Benchmark("guarantee", "Emulator: the guarantee over many decisions", measure)
