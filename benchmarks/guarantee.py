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
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks._report import Benchmark, Goal, Row, compared, say
from netem.link_state import LinkState
from netem.tc_words import settings_of
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
_COSTED, _ROUNDS = 200_000, 30
CAP = 3
_LOSS, _DELAY = "loss 30%", "delay 10ms 10ms distribution normal reorder 10% limit 1000000"
_SPACING_NS = 2_000_000


class Decider:
    """Decides for a flow after the other, with this time between two datagrams."""

    def __init__(self, words: str, spacing_ns: int = 10_000) -> None:
        self._link, self._flow = LinkState(settings_of(words), 7, "relay", "forward"), 0
        columns = np.zeros(_BATCH, np.int64), np.full(_BATCH, 72), np.arange(_BATCH) * spacing_ns
        self._columns = columns

    def decide(self, count: int = _BATCH) -> NDArray[Any]:
        """Return the decisions for the first datagrams of the next flow."""
        self._link.start_flow(0, self._flow)
        self._link.core.in_flight = 0
        self._flow += 1
        return self._link.decide_many(*(column[:count] for column in self._columns))

    def outcomes(self, count: int) -> list[Outcomes]:
        """Return which datagrams are lost, of several flows."""
        return [outcomes_of(self.decide()) for _ in range(count // _BATCH)]

    def cost(self) -> Callable[[], float]:
        """Return what measures nanoseconds per decision."""

        def measured() -> float:
            begun_ns = time.perf_counter_ns()
            self.decide(_COSTED)
            return (time.perf_counter_ns() - begun_ns) / _COSTED

        measured()
        return measured


def check_row(words: str, limits: Limits, count: int) -> Row:
    """Return the violations in a number of decisions."""
    say(f"{count:,} decisions, {words}")
    flows = Decider(f"{words} limit 1000000").outcomes(count)
    note = f"{count:,} decisions, {np.mean(flows):.2%} lost"
    found = sum(violations(lost, limits) for lost in flows)
    return Row(f"{words}: violations", found, "", goal=Goal("==", 0), note=note)


def expected_row(words: str, count: int) -> Row:
    """Return the realised loss rate beside the expected one, which may be asked for (keep)."""
    say(f"{count:,} decisions, {words}")
    share = float(np.mean(Decider(words).outcomes(count)))
    expected = expected_loss(settings_of(words)).rate or 0.0
    note = f"{count:,} decisions: {share:.4%} lost, {expected:.4%} expected"
    error = 100 * abs(share - expected)
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


def cost_row(before: str, words: str, cap: str) -> Row:
    """Return the time per decision beside that of the plain cap with as many consecutive losses."""
    ours, plain = (Decider(f"{before} {one} limit 1000000").cost() for one in (words, cap))
    return compared(
        f"{before} {words}: decision", "ns", ours, (f"{before} {cap}", plain), Goal("<=", 1.3),
        rounds=_ROUNDS,
    )  # fmt: skip


def network_rows() -> list[Row]:
    """Return the losses at the receiver of three networks."""
    held = f"mansd {CAP}"
    drops = Decider(f"{_LOSS} {held}", _SPACING_NS).decide()["release_ns"] < 0
    capped = Decider(_DELAY, _SPACING_NS).decide().copy()
    capped["release_ns"][drops] = -1
    networks = {
        "no cap": Decider(f"{_LOSS} {_DELAY}", _SPACING_NS).decide().copy(),
        f"cap {CAP} on drops only": capped,
        held: Decider(f"{_LOSS} {_DELAY} {held}", _SPACING_NS).decide(),
    }
    rows = []
    for name, decisions in networks.items():
        lost, dropped = outcomes_of(decisions), decisions["release_ns"] < 0
        ends = np.flatnonzero(np.concatenate([[True], ~lost, [True]]))
        goal = Goal("<=", CAP) if name == held else None
        rows += [
            Row(f"{name}: dropped", 100 * float(dropped.mean()), "%"),
            Row(f"{name}: dropped or out of order", 100 * float(lost.mean()), "%"),
            Row(f"{name}: longest loss burst", int(np.diff(ends).max()) - 1, "", goal=goal),
        ]
    back_ns = networks[held]["hold_back_ns"]
    back_ns = back_ns[back_ns > 0]
    return [
        *rows,
        Row(f"{held}: held back", 100 * len(back_ns) / _BATCH, "%"),
        Row(f"{held}: held back by, median", float(np.median(back_ns)) / 1e6, "ms"),
    ]


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure costs and networks, then violations, then loss rates."""
    caps = {words: f"mansd {settings_of(words).longest_burst}" for words in COMBINATIONS}
    befores = ("loss 50%", f"loss 50% {_REORDERING}")
    return [
        *(
            cost_row(before, *pair)
            for before in befores
            for pair in caps.items()
            if len({*pair}) > 1
        ),
        *network_rows(),
        *(
            check_row(f"{before} {words}", limits, DECISIONS)
            for words, limits in COMBINATIONS.items()
            for before in ("loss 50%", f"loss 30% {_REORDERING}")
        ),
        *(expected_row(words, DECISIONS // 5) for words in EXPECTED),
    ]


BENCHMARK = Benchmark("guarantee", "Emulator: the guarantee over many decisions", measure)
