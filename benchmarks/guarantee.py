"""The guarantee over very many decisions: violations, realised losses, and cost per decision.

Each combination is decided by the core, a million datagrams per flow. A check that uses nothing of
netem counts violations at the receiver: outcomes come from the times at which intact datagrams
leave. Costs alternate with those of the plain cap that allows as many consecutive losses.

A reordering network is compared without a cap, with a cap on drops only, and with the guarantee. A
cap on drops only forces a datagram after m drops, and leaves the delays as they are, as the loss
models of quic-network-simulator and Rattan do. Losses and delays are the same random numbers in all
three. A datagram counts as lost if it is dropped, or if a later one arrives before it.
"""

import argparse
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks._report import Benchmark, Goal, Rounds, Row, say
from netem.link_state import LinkState
from netem.words.words_to_settings import settings_of
from noack.impairments.loss_prediction import expected_loss

Outcomes = NDArray[np.bool_]


class Limits(NamedTuple):
    """A guarantee in numbers."""

    windows: tuple[tuple[int, int], ...]
    """(m, K): at most m losses among K; a cap M − 1 is (M − 1, M)."""
    recovery: int = 0


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
CAP = 3
_LOSS, _DELAY = "loss 30%", "delay 10ms 10ms distribution normal reorder 10% limit 1000000"
_SPACING_NS = 2_000_000


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


def outcomes_of(decisions: NDArray[Any]) -> Outcomes:
    """Return (k,) whether each datagram of a flow is lost, from its decisions in order."""
    numbers = np.arange(len(decisions))
    times, leaving = [], []
    for departure, bit in (("release_ns", "bit"), ("copy_ns", "copy_bit")):
        intact = (decisions[departure] >= 0) & (decisions[bit] < 0)
        times.append(decisions[departure][intact])
        leaving.append(numbers[intact])
    # Datagrams with equal release times leave in the order of arrival.
    in_order = np.concatenate(leaving)[np.lexsort((np.concatenate(leaving), np.concatenate(times)))]
    newest = np.maximum.accumulate(np.concatenate([[-1], in_order]))
    lost = np.ones(len(decisions), bool)
    lost[in_order[in_order > newest[:-1]]] = False
    return lost


def violations(lost: Outcomes, limits: Limits) -> int:
    """Count the windows with too many losses, and the gaps between bursts that are too short."""
    count = np.concatenate([[0], np.cumsum(lost)])
    found = 0
    for losses, window in limits.windows:
        begin = np.maximum(np.arange(1, len(count)) - window, 0)
        found += int(np.count_nonzero(count[1:] - count[begin] > losses))
    gaps = np.diff(np.flatnonzero(lost)) - 1
    return found + int(np.count_nonzero((gaps > 0) & (gaps < limits.recovery)))


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


def networks() -> dict[str, NDArray[Any]]:
    """Return the decisions of the three networks."""
    free = Decider(f"{_LOSS} {_DELAY}", _SPACING_NS).decide().copy()
    drops = Decider(f"{_LOSS} mansd {CAP}", _SPACING_NS).decide()["release_ns"] < 0
    unlost = Decider(_DELAY, _SPACING_NS).decide().copy()
    unlost["release_ns"][drops] = -1
    kept = Decider(f"{_LOSS} {_DELAY} mansd {CAP}", _SPACING_NS).decide().copy()
    return {
        "no cap": free,
        f"cap {CAP} on drops only": unlost,
        f"mansd {CAP}": kept,
    }


def network_rows() -> list[Row]:
    """Return the losses at the receiver of each network."""
    rows = []
    for name, decisions in networks().items():
        lost, dropped = outcomes_of(decisions), decisions["release_ns"] < 0
        ends = np.flatnonzero(np.concatenate([[True], ~lost, [True]]))
        goal = Goal("<=", CAP) if name.startswith("mansd") else None
        rows += [
            Row(f"{name}: dropped", 100 * float(dropped.mean()), "%"),
            Row(f"{name}: dropped or out of order", 100 * float(lost.mean()), "%"),
            Row(f"{name}: longest loss burst", int(np.diff(ends).max()) - 1, "", goal=goal),
        ]
        if name.startswith("mansd"):
            delay_ns = decisions["hold_back_ns"][decisions["hold_back_ns"] > 0]
            rows.append(Row(f"{name}: held back", 100 * len(delay_ns) / len(lost), "%"))
            rows.append(
                Row(f"{name}: held back by, median", float(np.median(delay_ns)) / 1e6, "ms")
            )
    return rows


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure costs and networks, then violations, then loss rates."""
    rows = [*cost_rows(), *network_rows()]
    for words, limits in COMBINATIONS.items():
        rows += check_rows(f"loss 50% {words}", limits, DECISIONS)
        rows += check_rows(f"loss 30% {_REORDERING} {words}", limits, DECISIONS)
    return rows + [expected_row(words, DECISIONS // 5) for words in EXPECTED]


BENCHMARK = Benchmark("guarantee", "Emulator: the guarantee over many decisions", measure)
