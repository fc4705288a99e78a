"""The cost of ten thousand flows for a relay, and the speed of the link's decisions.

Flows differ in the sender's address (127.1.0.0 and on); datagrams come from them in turn. The cost
is the relay's CPU time per datagram while it empties a full receive buffer, as in
:mod:`benchmarks.relays`. The C relay, which ignores addresses, shows the kernel's share of it; with
a socket per client, it shows that of our relay with the reverse direction. The loss bursts of the
decisions are counted from the fates only.
"""

import argparse
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import NamedTuple

from benchmarks._relay_cores import BEFORE_OTHERS, LOAD_CORE, on_core, scheduled
from benchmarks._relay_decisions import (
    LOSS,
    MANSD,
    Decide,
    LossRuns,
    compiled,
    plain,
    predicted_loss,
)
from benchmarks._relay_load import built, sources
from benchmarks._relay_ours import Ours
from benchmarks._relay_process import Relay, c_relay, in_turn, our_relay, start_all
from benchmarks._report import Benchmark, Goal, MeasurementError, Peer, Rounds, Row, say

ROUNDS = 30
FLOWS = 10_000
WORDS = "loss 5% mansd 4 seed 7"
COST_GOAL = Goal("<=", 1.3)
KINDS = {
    "ours": Ours(WORDS),
    "ours, with the reverse direction": Ours(WORDS, reverse=True),
}
PEER, PATHS = "C relay", "C relay, a socket per client"
_PACKETS = 10
"""Packets of each flow in a call."""


def flow_rows(rounds: Rounds) -> list[Row]:
    """Return the rows of the relays: the cost of many flows compared with the cost of one."""
    rows = []
    for name in (*KINDS, PEER, PATHS):
        many, one = f"{name}, {FLOWS:,} flows", f"{name}, one flow"
        if name in rounds.missing:
            rounds.add(many, rounds.missing[name])
        goal = COST_GOAL if name in KINDS else None
        row = rounds.row(f"{many}: cost", "µs CPU each", "cpu_us", many, one, goal, paired=True)
        rows.append(row)
    many = f"ours, with the reverse direction, {FLOWS:,} flows"
    peer = f"{PATHS}, {FLOWS:,} flows"
    rows.append(rounds.row(f"{many}: cost", "µs CPU each", "cpu_us", many, peer, paired=True))
    return rows


class Decided(NamedTuple):
    """Results of the link's decisions."""

    per_s: float
    runs: LossRuns


def decide_all(decide: Decide, decisions: int, flows: int) -> Decided:
    """Make at least this number of decisions, batch by batch; only the link's time counts."""
    runs, seconds = LossRuns(flows), 0.0
    runs.add(decide(1))  # creates the flows' states, compiles the code
    unmeasured = runs.decisions
    while runs.decisions < decisions:
        begun_s = time.perf_counter()
        fates = decide(_PACKETS)
        seconds += time.perf_counter() - begun_s
        runs.add(fates)
    return Decided((runs.decisions - unmeasured) / seconds, runs)


def decision_rows(name: str, found: Decided | str) -> list[Row]:
    """Return the rows of one way to run the link: the results, or why there are none."""
    if isinstance(found, str):
        return [Row(f"{name}: decisions", None, "/s", unjudged=found)]
    runs = found.runs
    note = f"{runs.decisions:,} decisions, loss {LOSS:.0%}, mansd {MANSD}, {FLOWS:,} flows"
    return [
        Row(f"{name}: decisions", found.per_s, "/s", note=note),
        Row(f"{name}: longest loss burst", runs.longest, "", goal=Goal("<=", MANSD)),
        Row(f"{name}: loss", 100 * runs.lost / runs.decisions, "%",
            Peer("predicted", 100 * predicted_loss(LOSS, MANSD))),
    ]  # fmt: skip


def _decisions(name: str, make: Callable[[int], Decide], count: int) -> list[Row]:
    say(f"{count:,} decisions, {name}")
    try:
        return decision_rows(name, decide_all(make(FLOWS), count, FLOWS))
    except MeasurementError as error:
        return decision_rows(name, str(error))


def _measure_flows() -> list[Row]:
    rounds = Rounds()
    with built() as tools, on_core(LOAD_CORE), scheduled(BEFORE_OTHERS), ExitStack() as stack:
        kinds = {PEER: c_relay(tools), PATHS: c_relay(tools, "paths")} | {
            name: our_relay(name, ours) for name, ours in KINDS.items()
        }
        relays = start_all(kinds, tools, stack, rounds)
        one, many = sources(1), sources(FLOWS)

        def costs(relay: Relay, counted: bool) -> None:
            figures = relay.burst(one), relay.burst(many)
            if counted:
                rounds.add(f"{relay.name}, one flow", figures[0])
                rounds.add(f"{relay.name}, {FLOWS:,} flows", figures[1])

        for number in range(-1, ROUNDS):  # the first creates the flows' states; not counted
            if number % 10 == 0:
                say(f"rounds {number + 1} to {number + 10} of {ROUNDS}")
            in_turn(relays, rounds, partial(costs, counted=number >= 0))
    return flow_rows(rounds)


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure the flows, then the decisions."""
    return [
        *_measure_flows(),
        *_decisions("compiled", compiled, 100_000_000),
        *_decisions("plain Python", plain, 500_000),
    ]


BENCHMARK = Benchmark("relay_flows", "Relays: flows and decisions", measure)
