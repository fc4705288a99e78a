"""The sending times of a sender with a constant period, by the arrivals.

They are on the straight line below all arrivals. If there is no such line, delays are not known: a sender
that pauses while its numbers go on and a clock that is set make a step, another period bends the line, and
packets that are sent in groups are beside it.
"""

from typing import NamedTuple

import numpy as np

from netem.traces.smallest_delays import (
    FEWEST,
    SMALLEST_BLOCK,
    SMALLEST_STEP_NS,
    Int64s,
    Reals,
    block_edges,
    envelope_slope,
    find_steps,
    spreads,
    steps_text,
)

_LARGEST_GROUP = 32
_MOST_PACKETS = 200_000
"""Packets, the first ones, that are searched for groups."""
_UNEVEN = 0.45
"""Largest part of the period by which the smallest delay may vary with the place in a group."""
_SHUFFLES = 8
_MOST_AT_ONCE = 0.3
"""Share of packets that may arrive together with the one before, of a sender with a constant period."""
_MOST_APART = 0.1
"""Share of the blocks that may stay above the line: a network may be busy for a while."""


_BOTH = "give the captures of both ends"


class SendingPlan(NamedTuple):
    """The sending times of n packets."""

    sent_ns: Int64s
    period_ns: float
    unknown: str  # Why they are not known, and those here mean nothing; empty: they are
    note: str  # What is strange about them


def plan_sending(number: Int64s, received_ns: Int64s) -> SendingPlan:
    """Return the sending times of packets by a constant period.

    Args:
        number: (n,) Their numbers, ascending, from 0.
        received_ns: (n,) When they arrived.

    Raises:
        ValueError: one line; the arrivals do not show a period.
    """
    period_ns = envelope_slope(number, received_ns) if len(number) > 1 else 1.0
    if period_ns <= 0:
        raise ValueError(
            "the sender's period is 0 ms by the arrivals: without a period, losses and delays cannot be "
            "told; check --sequence-at"
        )
    planned_ns = np.rint(period_ns * number).astype(np.int64)
    delay_ns = received_ns - planned_ns
    sent_ns = planned_ns + delay_ns.min()
    if len(number) < FEWEST:
        return SendingPlan(
            sent_ns, period_ns, f"fewer than {FEWEST} datagrams do not show a constant period; {_BOTH}", ""
        )
    steps = find_steps(planned_ns.astype(float), delay_ns.astype(float), period_ns / 4)
    if steps:
        unknown = (
            f"{steps_text(steps, received_ns)}: the sender paused or became slower while its numbers went "
            "on, the receiver's clock was set, the route changed, or a queue stays full; measure the parts "
            f"(editcap -A, -B), or {_BOTH}"
        )
        return SendingPlan(sent_ns, period_ns, unknown, "")
    unknown, note = why_not_straight(number, period_ns, (received_ns - sent_ns).astype(float))
    return SendingPlan(sent_ns, period_ns, unknown and f"{unknown}; {_BOTH}", note)


def why_not_straight(number: Int64s, period_ns: float, delay_ns: Reals) -> tuple[str, str]:
    """Return why the sender had no constant period, and what is only strange; both may be empty.

    Args:
        number: (n,) Numbers of the packets, ascending.
        period_ns: the sender's period.
        delay_ns: (n,) Delays above the line.
    """
    if _are_grouped(number, period_ns, delay_ns):
        return "the packets are sent in groups, or arrive in groups", ""
    edges = block_edges(len(number))
    lowest = np.minimum.reduceat(delay_ns, edges[:-1])
    apart = lowest > max(period_ns / 2, SMALLEST_STEP_NS, spreads(delay_ns)[0])
    if apart.mean() > _MOST_APART:
        return "the packets are not sent with a constant period, or the network is hardly ever idle", ""
    if apart.any():
        return "", (
            f"in {int(apart.sum())} of {len(apart)} equal parts of the trace all delays are long; if the "
            "sender was slower there, they are not the network's"
        )
    return "", ""


def _are_grouped(number: Int64s, period_ns: float, delay_ns: Reals) -> bool:
    """Return whether many packets arrive together, or the smallest delay depends on the place in a group."""
    number, delay_ns = number[:_MOST_PACKETS], delay_ns[:_MOST_PACKETS]
    successive = np.diff(number) == 1
    at_once = np.abs(np.diff(delay_ns)[successive] + period_ns) < period_ns / 10
    if successive.any() and at_once.mean() > _MOST_AT_ONCE:
        return True
    rng = np.random.default_rng(1)
    by_number = np.full(int(number[-1]) + 1, np.inf)
    by_number[number] = delay_ns
    sizes = range(2, min(_LARGEST_GROUP, len(number) // SMALLEST_BLOCK) + 1)
    ranges = np.array([_range_of_lowest(by_number, size) for size in sizes])
    by_chance = np.zeros(len(sizes))
    for _ in range(_SHUFFLES):
        by_number[number] = rng.permutation(delay_ns)
        by_chance = np.maximum(by_chance, [_range_of_lowest(by_number, size) for size in sizes])
    return bool((ranges > np.maximum(_UNEVEN * period_ns, 2 * by_chance)).any())


def _range_of_lowest(by_number: Reals, size: int) -> float:
    """Return by how much the smallest delay varies with the place in groups of a size."""
    padded = np.concatenate((by_number, np.full(-len(by_number) % size, np.inf)))
    lowest = padded.reshape(-1, size).min(axis=0)
    return float(np.ptp(lowest[np.isfinite(lowest)]))
