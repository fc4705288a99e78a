"""What reports and recorded packet fates use of a link; native/noack.h declares the rest."""

from dataclasses import dataclass

from noack.core.core_library import core

NEVER_NS: int = core.NOACK_NEVER_NS
"""A time that never comes."""


@dataclass(slots=True)
class RecordedDecision:
    """A recorded decision for a packet: the fields of ``noack_recorded``."""

    fate: int
    delay_ns: int
    """Time from arrival to departure; −1: it never left."""
    copy_delay_ns: int
    bit: int
    copy_bit: int


@dataclass(slots=True)
class Counters:
    """Counts of one direction of a link: the fields of ``noack_counters``."""

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
