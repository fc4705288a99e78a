"""The cost of ten thousand flows for a relay.

Flows differ in the sender's address (127.1.0.0 and on); datagrams come from them in turn. The cost
is the relay's CPU time per datagram while it empties a full receive buffer, as in
:mod:`benchmarks.relays`. The C relay, which ignores addresses, shows the kernel's share of it; with
a socket per client, it does what our relay with the reverse direction does: it also waits for
answers at all sockets and returns them. (To wait for a socket by epoll costs when sending, too.)
"""

import argparse
from contextlib import ExitStack
from functools import partial

from benchmarks._relay_cores import BEFORE_OTHERS, LOAD_CORE, on_core, scheduled
from benchmarks._relay_load import built, sources
from benchmarks._relay_ours import Ours
from benchmarks._relay_process import Relay, c_relay, in_turn, our_relay, start_all
from benchmarks._report import Benchmark, Goal, Rounds, Row, say

ROUNDS = 30
FLOWS = 10_000
WORDS = "loss 5% mansd 4 seed 7"
COST_GOAL = Goal("<=", 1.3)
KINDS = {
    "ours": Ours(WORDS),
    "ours, with the reverse direction": Ours(WORDS, reverse=True),
}
PEER, PATHS = "C relay", "C relay, a socket per client"


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
    name, goal = f"{many}: cost", Goal("<=", 1)
    rows.append(rounds.row(name, "µs CPU each", "cpu_us", many, peer, goal, paired=True))
    return rows


def measure(options: argparse.Namespace) -> list[Row]:
    """Send bursts from many addresses and from one to each relay in turn."""
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


BENCHMARK = Benchmark("relay_flows", "Relays: flows", measure)
