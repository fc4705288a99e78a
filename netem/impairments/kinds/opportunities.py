"""Delivery opportunities from a trace of mahimahi; see native/impairments/opportunities.c."""

from itertools import pairwise
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from netem.core.clock import NS_PER_S
from netem.core.core_library import core
from netem.core.errors import shortened
from netem.core.named_file import NamedFile
from netem.impairments.clauses import Clause, FileOr, Part
from netem.impairments.feature import (
    LONGEST_NS,
    FileFeature,
    Impairment,
    PacketOrder,
    Stage,
    StageTables,
    add_numbers,
)
from netem.impairments.trace_offset import OFFSET, Offset, offset_meaning, offset_ns, require_inside
from netem.impairments.words import COUNT, SIGNED_COUNT, brief_number, list_of

OPPORTUNITY_BYTES: int = core.NOACK_OPPORTUNITY_BYTES
MOST_TIMES = 2_000_000
_NS_PER_MS = NS_PER_S // 1000
_LONGEST_MS = LONGEST_NS // _NS_PER_MS


class Opportunities(FileFeature, Impairment):
    """A link that delivers packets at recorded times, from a finite queue, as mahimahi does."""

    kind: Literal["opportunities"] = "opportunities"
    file: Annotated[str, Field(min_length=1)] | None = None
    """The trace: on each line a time in ms at which up to 1504 bytes can be delivered."""
    times_ms: (
        Annotated[
            tuple[Annotated[int, Field(ge=0, le=_LONGEST_MS)], ...],
            Field(min_length=1, max_length=MOST_TIMES),
        ]
        | None
    ) = None
    """Instead of a file: these times, which do not descend; they repeat after the last."""
    queue: Annotated[int, Field(ge=1, le=1_000_000)] = 1000
    """Maximum number of packets that wait; further packets are dropped."""
    queue_bytes: Annotated[int, Field(ge=1, le=2**40)] | None = None
    """Maximum number of bytes that wait; by default not limited."""
    overhead_bytes: Annotated[int, Field(ge=-65_535, le=65_535)] = 32
    """Bytes added to each payload; 32: UDP, IPv4, and 4 bytes of a TUN device, as in mahimahi."""
    offset_s: Offset = 0.0
    """Begin at this time of the trace, in seconds; random: at a time that the seed chooses."""

    clauses: ClassVar = (
        Clause(
            "opportunities",
            "opportunities trace.up",
            FileOr(
                "times_ms",
                list_of(COUNT, "times in ms that do not descend, e.g. 0,1,5"),
                "N,N,...",
                "at",
                "opportunities at 0,1,5",
                expected="a file with delivery opportunities, in ms",
            ),
            Part("overhead_bytes", SIGNED_COUNT, "N", "overhead", "opportunities trace.up overhead 28"),
            Part("queue", COUNT, "N", "queue", "opportunities trace.up queue 20"),
            Part("queue_bytes", COUNT, "N", "bytes", "opportunities trace.up bytes 30000"),
            Part("offset_s", OFFSET, "T|random", "from", "opportunities trace.up from random"),
        ),
    )
    delays: ClassVar = True
    queues: ClassVar = True
    tc_missing: ClassVar = "delivery opportunities"

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.file is None) == (self.times_ms is None):
            raise ValueError("file: delivery opportunities need a file, or times_ms")
        if self.times_ms is not None:
            if any(a > b for a, b in pairwise(self.times_ms)):
                raise ValueError("times_ms: must not descend")
            if self.times_ms[-1] == 0:
                raise ValueError("times_ms: the last must not be 0; the times repeat after it")
            require_inside(self.offset_s, self.length_ns)
        return self

    @property
    def length_ns(self) -> int:
        """Time after which the opportunities repeat."""
        return (self.times_ms or (0,))[-1] * _NS_PER_MS

    @property
    def rate_bps(self) -> float:
        """Bits per second that it delivers on average; the times must have been read."""
        times = len(self.times_ms or ())
        return times * OPPORTUNITY_BYTES * 8 * NS_PER_S / self.length_ns

    def line_bits(self, payload_bytes: int) -> int:
        """Return the bits that a payload needs on the link."""
        return 8 * max(payload_bytes + self.overhead_bytes, 1)

    @property
    def longest_s(self) -> float:
        """Longest time until a full queue of packets of one opportunity each has been delivered."""
        if self.times_ms is None:
            return 0.0
        cycles, remainder = divmod(self.queue + 1, len(self.times_ms))
        times_ms = np.array(self.times_ms)
        later_ms = np.concatenate((times_ms, times_ms + times_ms[-1]))[remainder:][: len(times_ms)]
        longest_ms = cycles * int(times_ms[-1]) + int((later_ms - times_ms).max())
        return longest_ms * _NS_PER_MS / NS_PER_S

    @property
    def is_bounded(self) -> bool:
        return False

    @property
    def prediction_note(self) -> str:
        return "as long as no queue overflows"

    def order_after(self, before: PacketOrder) -> PacketOrder:
        return PacketOrder(delayed=True)  # it serves in the order of arrival

    def meaning(self) -> str:
        recording = self.file
        if self.times_ms is not None:
            length_s = self.length_ns / NS_PER_S
            recording = (
                f"{len(self.times_ms)} times in {brief_number(length_s)} s, "
                f"{brief_number(self.rate_bps / 1e6)} Mbit/s on average"
            )
        most = "" if self.queue_bytes is None else f" or {self.queue_bytes} bytes"
        return (
            f"delivers up to {OPPORTUNITY_BYTES} bytes at each recorded time, each packet with "
            f"{self.overhead_bytes} bytes beside its payload: {recording}"
            f"{offset_meaning(self.offset_s)}, repeated; {self.queue} packets{most} may wait, "
            "more are dropped"
        )

    def stage(self, tables: StageTables) -> Stage:
        self.require_content()
        begin, end = add_numbers(tables.integers, self.times_ms or ())
        numbers = {
            "begin": begin,
            "end": end,
            "offset_ns": offset_ns(self.offset_s, self.length_ns, tables),
            "overhead_bytes": self.overhead_bytes,
            "queue_bytes": self.queue_bytes or 0,
        }
        return Stage(self.kind, numbers, queue_places=self.queue)

    def read_file(self, file: NamedFile) -> Self:
        opportunities = self.model_copy(update={"times_ms": _times_ms(file), "file": None})
        require_inside(self.offset_s, opportunities.length_ns, file)
        return opportunities


def _times_ms(file: NamedFile) -> tuple[int, ...]:
    times_ms: list[int] = []
    for number, line in file.lines():
        if not (line.isascii() and line.isdigit() and len(line) <= 16):
            excerpt = shortened(line, 20)
            file.wrong(f"line {number}: {excerpt!r}: expected a time in whole ms, e.g. 12")
        if int(line) > _LONGEST_MS:
            file.wrong(f"line {number}: {line}: more than 31 years")
        if times_ms and int(line) < times_ms[-1]:
            file.wrong(f"line {number}: {line}: before {times_ms[-1]}; times must not descend")
        times_ms.append(int(line))
        if len(times_ms) > MOST_TIMES:
            file.wrong(f"has more than {MOST_TIMES} delivery opportunities")
    if not times_ms or times_ms[-1] == 0:
        file.wrong("has no time after 0; expected a time in ms on each line")
    return tuple(times_ms)
