"""What is guaranteed of losses, over very many decisions."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import ZERO, Goal, Peer, Row, announce, benchmark
from netem.impairments.target_loss import expected_loss
from netem.link_state import LinkState
from netem.tc_words import settings_of
from tests.oracles.loss_language import is_allowed, longest_burst, outcomes_of

DECISIONS = 100_000_000
_FLOW_DECISIONS = 1_000_000
REORDERING = "delay 5ms 5ms reorder 20% duplicate 5% corrupt 5%"
COMBINATIONS = (
    "mansd 4",
    "atmost 3 in 10",
    "atmost 20 in 100",
    "mansd 4 recover 3",
    "mansd 2 atmost 3 in 10 recover 2",
)
CAP = 3
_LOSS, _DELAY = "loss 30%", "delay 10ms 10ms distribution normal reorder 10% limit 1000000"
_SPACING_NS = 2_000_000
"""Time between two packets."""


def decide(words: str, flow: int = 0, spacing_ns: int = 10_000) -> NDArray[Any]:
    """Return the decisions for the datagrams of a flow, ``spacing_ns`` apart."""
    link, count = LinkState(settings_of(words), 7, "relay", "forward"), _FLOW_DECISIONS
    link.start_flow(0, flow)
    return link.decide_many(np.zeros(count, np.int64), np.full(count, 72), np.arange(count) * spacing_ns)


def check_rows(impairments: str, guarantee: str, count: int) -> Iterator[Row]:
    """Yield the flows with a violation in ``count`` decisions, and the loss rate if it can be predicted."""
    words, guarantee_settings = f"{impairments} {guarantee}", settings_of(guarantee)
    announce(f"{count:,} decisions, {words}")
    numbers = range(count // _FLOW_DECISIONS)
    flows = [outcomes_of(decide(f"{words} limit 1000000", flow)) for flow in numbers]
    number = sum(not is_allowed(lost, guarantee_settings) for lost in flows)
    yield Row(f"{words}: flows with a violation", number, "", goal=ZERO, note=f"{count:,} decisions")
    if "delay" not in words and (predicted_rate := expected_loss(settings_of(words)).rate):
        yield Row(f"{words}: lost", 100 * float(np.mean(flows)), "%", Peer("predicted", 100 * predicted_rate))


def network_rows() -> Iterator[Row]:
    """Yield the losses at the receiver of three networks with the same random numbers."""
    cap = f"mansd {CAP}"
    capped = decide(_DELAY, spacing_ns=_SPACING_NS)
    capped["release_ns"][decide(f"{_LOSS} {cap}", spacing_ns=_SPACING_NS)["release_ns"] < 0] = -1
    networks = {
        "no cap": decide(f"{_LOSS} {_DELAY}", spacing_ns=_SPACING_NS),
        f"cap {CAP} on drops only": capped,
        cap: decide(f"{_LOSS} {_DELAY} {cap}", spacing_ns=_SPACING_NS),
    }
    for name, decisions in networks.items():
        lost, dropped = outcomes_of(decisions), decisions["release_ns"] < 0
        goal = Goal("<=", CAP) if name == cap else None
        yield Row(f"{name}: dropped", 100 * float(dropped.mean()), "%")
        yield Row(f"{name}: dropped or out of order", 100 * float(lost.mean()), "%")
        yield Row(f"{name}: longest loss burst", longest_burst(lost), "", goal=goal)
    back_ns = networks[cap]["hold_back_ns"]
    back_ns = back_ns[back_ns > 0]
    yield Row(f"{cap}: held back", 100 * len(back_ns) / _FLOW_DECISIONS, "%")
    yield Row(f"{cap}: held back by, median", float(np.median(back_ns)) / 1e6, "ms")


@benchmark("guarantee", "Emulator: the guarantee over many decisions")
def guarantee() -> Iterator[Row]:
    """Measure networks, then violations and loss rates over very many decisions.

    A check that uses nothing of netem looks for violations at the receiver, a million datagrams per
    flow: a datagram counts as lost if it is dropped, or if a later one arrives before it. A cap on
    drops only forces a datagram after m drops, and leaves the delays as they are.
    """
    yield from network_rows()
    for constraint in COMBINATIONS:
        for before in ("loss 50%", f"loss 30% {REORDERING}"):
            yield from check_rows(before, constraint, DECISIONS)
