"""Records that the rules of a link use: slotted dataclasses, or rows of an array.

The same definition serves both: :func:`dtype_of` gives the row type for compiled code.
"""

from collections.abc import Iterable, MutableSequence, Sequence
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

_FORMATS = {"int": "<i8", "float": "<f8"}

NEVER_NS = -1
"""A time that never comes."""
DELIVERED = 0
DROPPED = 1
FORCED = 2
CORRUPTED = 3
OVERFLOWED = 4
BLACKED_OUT = 5
"""The values of :class:`noack.protocol.record_tables.Fate`."""


def union_dtype(records: Iterable[type]) -> np.dtype[np.void]:
    """Return the structured dtype that has the fields of several record classes.

    Raises:
        TypeError: two classes have a field of the same name and of different types.
    """
    formats: dict[str, str] = {}
    for record in records:
        for field in fields(record):
            kind = field.type if isinstance(field.type, str) else field.type.__name__
            if formats.setdefault(field.name, _FORMATS[kind]) != _FORMATS[kind]:
                raise TypeError(f"{record.__name__}.{field.name}: another record has another type")
    return np.dtype(list(formats.items()))


@cache
def dtype_of(record: type) -> np.dtype[np.void]:
    """Return the structured dtype of a record class."""
    return union_dtype([record])


def array_of(dtype: np.dtype[np.void], rows: Sequence[Any]) -> NDArray[np.void]:
    """Return records as a structured array, (k,); fields that a record lacks are 0."""
    array = np.zeros(len(rows), dtype)
    for number, row in enumerate(rows):
        array[number] = tuple(getattr(row, name, 0) for name in array.dtype.names or ())
    return array


@dataclass(slots=True, kw_only=True)
class RuleStage:
    """One impairment of a link; derived classes add its settings as fields."""

    kind: int = -1
    """Number of its behaviour; see :mod:`noack.impairments.stage_dispatch`."""
    place: int = 0
    """Its number in the program."""
    key0: int = 0
    """Key of its random stream."""
    key1: int = 0
    queue_places: int = 0
    """Maximum number of packets in its queue; 0: no queue."""
    queue_begin: int = 0
    """Place of its ring of departure times."""


@dataclass(slots=True)
class RecordedDecision:
    """A recorded decision for a packet."""

    fate: int
    delay_ns: int
    """Time from arrival to departure; −1: it never left."""
    copy_delay_ns: int
    bit: int
    copy_bit: int


@dataclass(slots=True)
class WindowRule:
    """A maximum of losses among any ``packets`` consecutive packets of a flow."""

    losses: int
    packets: int


@dataclass(slots=True)
class StageMemory:
    """A stage's memory of a flow."""

    phase: int = 0
    score: float = 0.0


@dataclass(slots=True)
class FlowState:
    """A link's state of a flow."""

    number: int
    """Number of the flow, never used again on this link; selects its random numbers."""
    forced_first: int = 0
    """1: the first packet has not arrived yet, and must be delivered."""
    packets: int = 0
    """Packets that have arrived."""
    consecutive_losses: int = 0
    """Number of consecutive packets, up to the last, that are not effectively delivered."""
    first_release_ns: int = NEVER_NS
    """Departure time of the first packet, if it had to be delivered."""
    score: float = 0.0
    """Normal score of the link's state for the last packet; larger is worse."""
    newest: int = -1
    """Greatest number among the packets that have left intact."""
    since: int = 0
    """Number of the first packet under the present settings."""
    longest_loss_burst: int = 0
    """Maximum number of consecutive losses since then; counts final losses only."""


@dataclass(slots=True)
class QueueState:
    """The queue of a stage; its departure times lie in a ring."""

    head: int = 0
    count: int = 0
    entry_ns: int = 0
    busy_until_ns: int = 0
    carry: int = 0
    """Fraction of a nanosecond, in units of 1/rate_bps."""


@dataclass(slots=True)
class LinkState:
    """A link's state that all flows share."""

    in_flight: int = 0
    """Number of delayed packets and copies."""


@dataclass(slots=True)
class PacketDecision:
    """The decision for a packet; the stages of a link modify it one after the other."""

    fate: int = DELIVERED
    """:class:`noack.protocol.record_tables.Fate`."""
    packet: int = 0
    """Its number in its flow."""
    consecutive_losses: int = 0
    """Number of consecutive losses up to this packet."""
    release_ns: int = NEVER_NS
    """Departure time; −1: never."""
    copy_ns: int = NEVER_NS
    """Departure time of its copy; −1: never."""
    bit: int = -1
    """The bit that is flipped; −1 none."""
    copy_bit: int = -1
    """The bit that is flipped in the copy; −1 none."""
    hold_back_ns: int = 0
    """Time for which it is held back for the guarantee."""
    makes_stale: int = 0
    """Number of packets that it makes stale."""
    arrival_ns: int = 0
    size_bytes: int = 0
    """Of the payload."""
    must_pass: int = 0
    """1: the guarantee requires its delivery."""
    spared: int = 0
    """1: it must pass, and a stage would have lost it."""


@dataclass(slots=True)
class Counters:
    """Counts of one direction of a link."""

    received: int = 0
    received_bytes: int = 0
    delivered: int = 0
    """Fates; see :class:`noack.protocol.record_tables.Fate`."""
    dropped: int = 0
    forced: int = 0
    corrupted: int = 0
    overflowed: int = 0
    blacked_out: int = 0
    duplicated: int = 0
    held_back: int = 0
    """Held back for the guarantee."""
    forwarded: int = 0
    """Packets and copies that have left."""
    forwarded_bytes: int = 0
    delivered_out_of_order: int = 0
    """Packets that left after a later one of their flow: stale at the receiver."""
    longest_loss_burst: int = 0
    """Maximum number of consecutive losses of a flow under the present settings."""
    most_in_flight: int = 0


class LinkProgram(NamedTuple):
    """The settings of a link, as its rules read them: k stages, and their tables."""

    stages: Sequence[Any]
    """(k,) In order of application; each of a class derived from :class:`RuleStage`."""
    integers: Sequence[int]
    """Tables of the stages."""
    reals: Sequence[float]
    """Tables of the stages."""
    decisions: Sequence[RecordedDecision]
    """Recorded decisions to be repeated, flow by flow."""
    decisions_begin: Sequence[int]
    """(flows + 1,) Begin of each recorded flow's decisions, and the end of the last; or empty."""
    windows: Sequence[WindowRule]
    """Further maxima of losses."""
    recovery: int
    """Minimum number of consecutive deliveries between two loss bursts; 0: none."""
    mansd: int
    """Maximum number of consecutive losses that the guarantee allows; −1: no maximum."""
    limit: int
    """Maximum number of packets delayed at once."""
    tracks: bool
    """Whether packets can be delivered out of order."""


class LinkMemory(NamedTuple):
    """The state of a link."""

    flows: Sequence[FlowState]
    """(rows,) After the end of a flow, its row may be used for another flow."""
    memory: Sequence[Sequence[StageMemory]]
    """(rows, k)"""
    recent_ns: Sequence[MutableSequence[int]]
    """(rows, mansd + 1) Release times; see :mod:`netem.rules.guarantee`."""
    losses: Sequence[MutableSequence[int]]
    """(rows, power of 2) Numbers of losses so far; see :mod:`netem.rules.guarantee`."""
    queues: Sequence[Any]
    """(k,) One per stage, of :class:`QueueState` or a class derived from it."""
    departures_ns: MutableSequence[int]
    """The rings of the queues."""
    link: LinkState
    counters: Counters


class PacketContext(NamedTuple):
    """A packet for which a link decides, and the link."""

    program: LinkProgram
    state: LinkMemory
    flow: FlowState
    decision: PacketDecision


def refuse(decision: PacketDecision, fate: int) -> None:
    """Lose a packet by DROPPED, OVERFLOWED or BLACKED_OUT, unless it is lost or must pass."""
    if decision.fate == DELIVERED:
        if decision.must_pass != 0:
            decision.spared = 1
        else:
            decision.fate = fate
