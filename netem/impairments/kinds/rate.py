"""A bottleneck with a finite queue, and a discipline for the queue."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, Field, FiniteFloat, model_validator

from netem.core.clock import NS_PER_S
from netem.core.settings_section import Table
from netem.impairments.clauses import Clause, Part, Word
from netem.impairments.disciplines import DISCIPLINES, Discipline
from netem.impairments.disciplines.tail_drop import TailDrop
from netem.impairments.feature import Impairment, PacketOrder, Scheduler, Stage, StageTables
from netem.impairments.words import (
    COUNT,
    OWN_TIME_S,
    RATE_BPS,
    SIGNED_COUNT,
    SIZE_BYTES,
    Quantity,
    WordReader,
    rate_text,
    size_text,
    time_text,
)

_TC_HEADERS_BYTES = 42
"""Bytes that tc adds to a payload on an Ethernet device: headers of Ethernet, IPv4 and UDP."""
_ETHERNET_MTU_BYTES = 1514
"""The longest packet of an Ethernet device, as tc counts it."""
_MOST_QUEUED = 1_000_000
"""Most packets in a queue."""
_USUAL_QUEUE = 1000
_QUEUE_SIZES: tuple[tuple[str, Quantity[Any]], ...] = (
    ("queue", COUNT),
    ("queue_bytes", SIZE_BYTES),
    ("queue_s", OWN_TIME_S),
)
"""The keys of a queue's size; in words, the unit tells which of them it is."""


@dataclass(frozen=True)
class _QueuePart(Part):
    """The size of the queue: in packets, in bytes, or in the time that the rate needs for it."""

    def read(self, reader: WordReader, table: Table) -> None:
        expected = "datagrams, bytes or a time, e.g. 20, 64kb or 50ms"
        word = reader.word(expected)
        for key, quantity in _QUEUE_SIZES:
            with suppress(ValueError):
                table[key] = quantity.read(word)
                return
        reader.wrong(f"expected {expected}")

    def text(self, settings: BaseModel) -> str:
        assert isinstance(settings, Rate)
        return f"{self.word} {settings.queue_text}"


@dataclass(frozen=True)
class _DisciplinePart(Part):
    """A discipline of the queue, by the clause that its kind has."""

    @property
    def _clause(self) -> Clause:
        return next(clause for kind in DISCIPLINES for clause in kind.clauses if clause.word == self.word)

    @property
    def grammar(self) -> str:
        return self._clause.grammar

    def read(self, reader: WordReader, table: Table) -> None:
        table["discipline"] = self._clause.read(reader)

    def is_default(self, settings: BaseModel) -> bool:
        assert isinstance(settings, Rate)
        return self._clause not in settings.discipline.clauses

    def text(self, settings: BaseModel) -> str:
        assert isinstance(settings, Rate)
        return settings.discipline.text()

    def list_words(self, preceding: str) -> Iterator[Word]:
        yield from (word._replace(grammar="") for word in self._clause.list_words(preceding))


class Rate(Impairment):
    """A bottleneck: sends one packet after the other, with a finite queue."""

    kind: Literal["rate"] = "rate"
    rate_bps: Annotated[int, Field(ge=1, le=10**12)]
    """Bits per second."""
    queue: Annotated[int, Field(ge=1, le=_MOST_QUEUED)] = _USUAL_QUEUE
    """Maximum number of packets that wait or are being sent; further packets are dropped."""
    queue_bytes: Annotated[int, Field(ge=1, le=2**40)] | None = None
    """Instead: the maximum number of their bytes, with the overhead."""
    queue_s: Annotated[FiniteFloat, Field(gt=0, le=1e6)] | None = None
    """Instead: what the rate forwards in this time, in seconds."""
    burst_bytes: Annotated[int, Field(ge=1, le=2**40)] | None = None
    """Size of a token bucket, which the rate fills: after a pause, packets of this number of bytes
    leave at once, and longer packets are dropped. By default each takes its time at the rate."""
    overhead_bytes: Annotated[int, Field(ge=-65_535, le=65_535)] = 28
    """Bytes added to each payload; 28: the headers of UDP and IPv4."""
    cell_bytes: Annotated[int, Field(ge=0, le=65_535)] = 0
    """Payload of a link-layer cell, e.g. 48; 0: no cells."""
    cell_overhead_bytes: Annotated[int, Field(ge=0, le=1000)] = 0
    """Header of a cell, e.g. 5."""
    discipline: Discipline = TailDrop.model_construct()
    """The rule by which the queue drops packets."""

    clauses: ClassVar = (
        Clause(
            "rate",
            "rate 1mbit",
            Part("rate_bps", RATE_BPS, "RATE"),
            Part("overhead_bytes", SIGNED_COUNT, "OVERHEAD"),
            Part("cell_bytes", COUNT, "CELL"),
            Part("cell_overhead_bytes", SIGNED_COUNT, "CELL_OVERHEAD"),
            _QueuePart(
                " ".join(key for key, _ in _QUEUE_SIZES), None, "N|SIZE|T", "queue", "rate 1mbit queue 20"
            ),
            Part("burst_bytes", SIZE_BYTES, "SIZE", "burst", "rate 10mbit queue 50ms burst 20kb"),
            *(
                _DisciplinePart("discipline", word=clause.word)
                for kind in DISCIPLINES
                for clause in kind.clauses
            ),
        ),
    )
    delays: ClassVar = True
    queues: ClassVar = True

    @model_validator(mode="after")
    def _check(self) -> Self:
        line_bytes = max(65_535 + self.overhead_bytes, 0)
        if self.cell_bytes:
            cells = -(-line_bytes // self.cell_bytes)
            line_bytes = cells * (self.cell_bytes + self.cell_overhead_bytes)
        sizes = [key for key, _ in _QUEUE_SIZES if getattr(self, key) != type(self).model_fields[key].default]
        if len(sizes) > 1:
            raise ValueError(f"{sizes[1]}: the queue has a size by {sizes[0]} already; give one of them")
        if self.most_bytes == 0:
            raise ValueError(
                f"queue_s: {rate_text(self.rate_bps)} forwards less than a byte in {self.queue_text}; "
                "a longer time or more rate"
            )
        if self.burst_bytes is not None and self.scheduler is not None:
            raise ValueError(
                f"burst_bytes: goes with a queue in the order of arrival, not with {self.discipline.kind}"
            )
        # The work on one packet, on a burst, and the time for a full queue must fit into 64 signed bits.
        work = line_bytes * 8 * NS_PER_S + self.rate_bps
        full_ns = self.queue * work // self.rate_bps
        if self.most_bytes is not None:
            full_ns = self.most_bytes * 8 * NS_PER_S // self.rate_bps
        burst_ns = (self.burst_bytes or 0) * 8 * NS_PER_S // self.rate_bps
        if max(work, full_ns, 2 * burst_ns + 2) > 2**62:
            raise ValueError(
                "rate_bps: a full queue of the longest packets would take more than a century; "
                "more rate, a shorter queue or fewer bytes of overhead per cell"
            )
        return self

    @property
    def most_bytes(self) -> int | None:
        """Maximum number of bytes in the queue; None: their number is not limited."""
        if self.queue_s is None:
            return self.queue_bytes
        return int(Fraction(repr(self.queue_s)) * self.rate_bps / 8)

    @property
    def queue_text(self) -> str:
        """The size of the queue, as a word."""
        if self.queue_s is not None:
            return time_text(self.queue_s)
        return str(self.queue) if self.queue_bytes is None else size_text(self.queue_bytes)

    @property
    def _most_packets(self) -> int:
        """Maximum number of packets in the queue, of which each counts a byte at least."""
        if self.most_bytes is None:
            return self.queue
        shortest_bytes = max(int(self.line_bits(0)) // 8, 1)
        return min(max(self.most_bytes // shortest_bytes, 1), _MOST_QUEUED)

    def line_bits(self, payload_bytes: ArrayLike) -> NDArray[np.int64]:
        """Return the bits that payloads need on the link, of the shape of ``payload_bytes``."""
        payload_bytes = np.asarray(payload_bytes, np.int64)
        line_bytes: NDArray[np.int64] = np.maximum(payload_bytes + self.overhead_bytes, 0)
        if self.cell_bytes:
            line_bytes = -(-line_bytes // self.cell_bytes) * (self.cell_bytes + self.cell_overhead_bytes)
        return 8 * line_bytes

    @property
    def scheduler(self) -> Scheduler | None:
        """The discipline, if it chooses what is sent next when the link is free."""
        return self.discipline if isinstance(self.discipline, Scheduler) else None

    @property
    def longest_s(self) -> float:
        """Transmission time of a full queue (of packets of 1,500 bytes), in seconds."""
        most_bytes = self.queue * 1500 if self.most_bytes is None else self.most_bytes
        return 8 * most_bytes / self.rate_bps

    @property
    def is_bounded(self) -> bool:
        return False

    @property
    def prediction_note(self) -> str:
        return self.discipline.prediction_note or "as long as no queue overflows"

    def order_after(self, before: PacketOrder) -> PacketOrder:
        return PacketOrder(delayed=True)  # it serves in the order of arrival

    def meaning(self) -> str:
        waiting = str(self.queue) if self.most_bytes is None else f"{self.most_bytes} bytes"
        if self.queue_s is not None:
            waiting += f" ({time_text(self.queue_s)} at this rate)"
        text = (
            f"forwards {rate_text(self.rate_bps)} per second, one packet after the other, each "
            f"with {self.overhead_bytes} bytes beside its payload; {waiting} may wait, "
            f"{self.discipline.meaning()}"
        )
        if self.burst_bytes is not None:
            text += (
                f"; after a pause, {self.burst_bytes} bytes leave at once (a token bucket), and "
                "longer packets are dropped"
            )
        if self.cell_bytes:
            text += f"; in cells of {self.cell_bytes} + {self.cell_overhead_bytes} bytes"
        return text

    def stage(self, tables: StageTables) -> Stage:
        names = {"rate_bps", "overhead_bytes", "cell_bytes", "cell_overhead_bytes"}
        burst_bytes = self.burst_bytes or 0
        work = burst_bytes * 8 * NS_PER_S
        numbers = self.model_dump(include=names) | {
            "queue_bytes": self.most_bytes or 0,
            "burst_bytes": burst_bytes,
            "burst_ns": -(-work // self.rate_bps),
            "burst_carry": -work % self.rate_bps,
        }
        return self.discipline.queue_stage(numbers, self._most_packets, tables)

    def tc_text(self) -> str:
        cells = (self.cell_bytes, self.cell_overhead_bytes)
        numbers = (self.overhead_bytes - _TC_HEADERS_BYTES, *(cells if any(cells) else ()))
        return " ".join(["rate", rate_text(self.rate_bps), *map(str, numbers)])

    @property
    def _is_shaped(self) -> bool:
        """Whether tc needs its token bucket for it: the rate of its netem has no queue or burst."""
        return self.most_bytes is not None or self.burst_bytes is not None

    def tc_qdisc(self) -> str:
        if not self._is_shaped:
            return ""
        burst_bytes = self.burst_bytes or _ETHERNET_MTU_BYTES
        limit = self.queue * _ETHERNET_MTU_BYTES if self.most_bytes is None else self.most_bytes
        words = f"tbf rate {rate_text(self.rate_bps)} burst {size_text(burst_bytes)} limit {limit}"
        overhead_bytes = self.overhead_bytes - _TC_HEADERS_BYTES
        return f"{words} overhead {overhead_bytes}" if overhead_bytes > 0 else words

    def tc_lacks(self, earlier: Sequence[Impairment]) -> str:
        if self._is_shaped and self.cell_bytes:
            return "cells of a tbf"
        return self.discipline.tc_lacks(earlier)

    def tc_notes(self) -> Sequence[str]:
        if self._is_shaped:
            return tuple(self._tbf_notes())
        return ("its queue is the limit; its overhead is for an Ethernet device, with IPv4",)

    def _tbf_notes(self) -> Iterator[str]:
        """Yield what tbf does otherwise."""
        more = _TC_HEADERS_BYTES - self.overhead_bytes
        if more > 0:
            yield f"tbf counts {more} bytes more of each packet, for an Ethernet device with IPv4"
        if self.burst_bytes is None:
            yield "tbf sends a packet at once if it has tokens for it; here each takes its time at the rate"
        if self.most_bytes is None:
            yield f"its queue is in bytes: {self.queue} packets of {_ETHERNET_MTU_BYTES} bytes"
