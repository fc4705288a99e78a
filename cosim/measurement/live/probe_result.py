"""What a live probe found: the packet trace, and lines about how it was obtained."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from noack.traces.packet_trace import PacketTrace


class ProbeResult(NamedTuple):
    """The result at one end."""

    trace: PacketTrace | None
    """None at the sender of a one-way probe, which cannot know what arrived."""
    notes: Sequence[str]
    """Lines for the report."""
    kernel_drops: int | None
    """Datagrams that arrived at this host, and were dropped by its kernel because this process
    did not read them in time; None if the system does not count them."""


_REASONS = {
    "foreign": "not of this program",
    "version": "of another version of this program",
    "corrupted": "corrupted on the way",
    "impossible": "with impossible content",
    "ahead of schedule": "with a sequence number ahead of the schedule",
    "other session": "of another probe",
    "duplicate": "duplicates",
}


def counted(ignored: Mapping[str, int]) -> list[str]:
    """Return a line about the ignored datagrams; none if there are none."""
    parts = [f"{count} {_REASONS[reason]}" for reason, count in ignored.items() if count]
    return [f"ignored datagrams: {', '.join(parts)}"] if parts else []


def late_sends(sent: int, late: int, longest_ns: int) -> str:
    """Return a line about the sender's punctuality."""
    text = f"datagrams sent: {sent}; late sends: {late}"
    return f"{text}, the longest by {longest_ns / 1e6:.3g} ms" if late else text
