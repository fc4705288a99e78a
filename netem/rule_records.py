"""Records: what the rules work on. A slotted dataclass of ints and floats, or a row of an array.

The same definition serves both: :func:`dtype_of` gives the row type for compiled code.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

_FORMATS = {"int": "<i8", "float": "<f8"}


@cache
def dtype_of(record: type) -> np.dtype[np.void]:
    """Return the structured dtype of a record class."""
    formats = [
        (f.name, f.type if isinstance(f.type, str) else f.type.__name__) for f in fields(record)
    ]
    return np.dtype([(name, _FORMATS[kind]) for name, kind in formats])


def array_of(record: type, rows: Sequence[Any]) -> NDArray[np.void]:
    """Return records as a structured array, (k,)."""
    names = [field.name for field in fields(record)]
    return np.array(
        [tuple([getattr(row, name) for name in names]) for row in rows], dtype_of(record)
    )


@dataclass(slots=True)
class RuleStage:
    """One impairment of a link."""

    kind: int
    """A constant of :mod:`netem.rule_program`."""
    place: int
    """Which of its kind's settings are its own."""
    key0: int
    """Key of its random stream."""
    key1: int


@dataclass(slots=True)
class ChanceSettings:
    """A probability, and how far successive datagrams share their fortune."""

    probability: float
    threshold: float
    """z with 1 − Φ(z) = probability; infinite if that is 0 or 1."""
    correlation: float
    innovation: float
    """√(1 − correlation²)."""
    gap: int
    """Of how many datagrams one has its turn."""


@dataclass(slots=True)
class GilbertElliottSettings:
    """A Gilbert–Elliott chain."""

    good_to_bad: float
    bad_to_good: float
    loss_in_good: float
    loss_in_bad: float
    share_bad: float
    """Share of time in the bad state: p/(p + r)."""


@dataclass(slots=True)
class FourStateSettings:
    """A Markov chain of four states."""

    p13: float
    p31: float
    p32: float
    p23: float
    p14: float


@dataclass(slots=True)
class ScriptSettings:
    """Which numbers of a flow are lost."""

    period: int
    """0: played once."""
    begin: int
    """Place of its first number in the program's table."""
    end: int
    burst: int
    """Of a periodic loss; −1 if the numbers are in the table."""
    first: int


@dataclass(slots=True)
class DelaySettings:
    """A delay."""

    constant_ns: float
    jitter_ns: float
    shape: int
    """A constant of :mod:`netem.rules.delay`."""
    begin: int
    """Place of an empirical quantile table, in ns."""
    end: int
    correlation: float
    innovation: float
    loss_correlation: float
    loss_innovation: float


@dataclass(slots=True)
class RateSettings:
    """A rate limit and its queue."""

    rate_bps: int
    queue: int
    overhead_bytes: int
    cell_bytes: int
    cell_overhead_bytes: int
    begin: int
    """Place of its ring of departure times."""


@dataclass(slots=True)
class BlackoutSettings:
    """Blackouts: intervals of time in a table."""

    begin: int
    end: int
    period_ns: int
    """0: once."""


@dataclass(slots=True)
class RecordedDecision:
    """What once became of a datagram."""

    fate: int
    delay_ns: int
    """From its arrival until it left; −1 never."""
    copy_delay_ns: int
    bit: int
    copy_bit: int


@dataclass(slots=True)
class StageMemory:
    """What a stage remembers of a flow."""

    phase: int
    score: float


@dataclass(slots=True)
class FlowState:
    """What a link remembers of a flow."""

    number: int
    """Chooses its random numbers; no other flow of the link ever has it."""
    packets: int
    """Datagrams that have come."""
    run: int
    """Successive datagrams, up to the last, that are not effectively delivered."""
    forced_first: int
    """1: the first datagram has yet to come, and must be delivered."""
    first_release_ns: int
    """When the first datagram leaves, if it had to be delivered."""
    score: float
    """How bad the times are for the last datagram, as a normal score."""
    newest: int
    """Greatest number among the datagrams that have left intact."""
    since: int
    """Number of its first datagram under the settings that the link has now."""
    longest_loss_burst: int
    """Most successive datagrams since then that were not effectively delivered, as far as that is
    certain."""


@dataclass(slots=True)
class QueueState:
    """A bottleneck's queue; its departure times lie in a ring."""

    head: int
    count: int
    entry_ns: int
    busy_until_ns: int
    carry: int
    """Of a nanosecond, in units of 1/rate_bps."""


@dataclass(slots=True)
class LinkState:
    """What a link remembers besides."""

    in_flight: int
    """Datagrams, and copies, that are delayed."""


@dataclass(slots=True)
class PacketDecision:
    """What becomes of a datagram."""

    fate: int
    """:class:`noack.protocol.record_tables.Fate`."""
    packet: int
    """Its number in its flow."""
    run: int
    """Successive datagrams, up to this one, that are not effectively delivered."""
    release_ns: int
    """When it leaves; −1 never."""
    copy_ns: int
    """When its copy leaves; −1 never."""
    bit: int
    """Which of its bits is flipped; −1 none."""
    copy_bit: int
    """Which of its copy's bits is flipped; −1 none."""
    hold_back_ns: int
    """By how much it is held back, as overtaking would break the guarantee."""
    makes_stale: int
    """How many datagrams it makes stale."""


@dataclass(slots=True)
class Counters:
    """What has happened on a link, in one direction."""

    arrived: int = 0
    arrived_bytes: int = 0
    delivered: int = 0
    """Fates; see :class:`noack.protocol.record_tables.Fate`."""
    dropped: int = 0
    forced: int = 0
    corrupted: int = 0
    overflowed: int = 0
    blacked_out: int = 0
    duplicated: int = 0
    held_back: int = 0
    """Not let overtake, as that would have broken the guarantee."""
    forwarded: int = 0
    """Datagrams and copies that have left."""
    forwarded_bytes: int = 0
    delivered_out_of_order: int = 0
    """Left after a newer one of their flow: stale at the receiver."""
    longest_loss_burst: int = 0
    """Most successive datagrams of a flow that were not effectively delivered, of those that came
    since the settings are in force."""
    most_in_flight: int = 0
