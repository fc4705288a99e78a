"""A bottleneck with a finite queue, and a discipline for the queue."""

from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from noack.impairments.disciplines import DISCIPLINES, Discipline
from noack.impairments.disciplines.tail_drop import TailDrop
from noack.impairments.feature import Impairment, Stage, StageTables, Table, Word
from noack.impairments.words import (
    COUNT,
    RATE_BPS,
    SIGNED_COUNT,
    WordReader,
    rate_text,
    without_defaults,
)

_QUEUE = 1000
_HEADERS_BYTES = 28
_TC_HEADERS_BYTES = 42
"""Bytes that tc adds to a payload on an Ethernet device: headers of Ethernet, IPv4 and UDP."""


def _read(reader: WordReader) -> Table:
    table: Table = {"rate_bps": reader.value(RATE_BPS)}
    for key, signs in (("overhead_bytes", "-"), ("cell_bytes", ""), ("cell_overhead_bytes", "-")):
        if not reader.number_follows(signs):
            break
        table[key] = reader.value(SIGNED_COUNT)
    if reader.accept("queue"):
        table["queue"] = reader.value(COUNT)
    for discipline in DISCIPLINES:
        for word in discipline.words:
            if word.read is not None and reader.accept(word.name):
                kind = discipline.model_fields["kind"].default
                table["discipline"] = {"kind": kind, **word.read(reader)}
    return table


class Rate(Impairment):
    """A bottleneck: sends one packet after the other, with a finite queue."""

    kind: Literal["rate"] = "rate"
    rate_bps: Annotated[int, Field(ge=1, le=10**12)]
    """Bits per second."""
    queue: Annotated[int, Field(ge=1, le=1_000_000)] = _QUEUE
    """Maximum number of packets that wait or are being sent; further packets are dropped."""
    overhead_bytes: Annotated[int, Field(ge=-65_535, le=65_535)] = _HEADERS_BYTES
    """Bytes added to each payload; 28: the headers of UDP and IPv4."""
    cell_bytes: Annotated[int, Field(ge=0, le=65_535)] = 0
    """Payload of a link-layer cell, e.g. 48; 0: no cells."""
    cell_overhead_bytes: Annotated[int, Field(ge=0, le=1000)] = 0
    """Header of a cell, e.g. 5."""
    discipline: Discipline = TailDrop.model_construct()
    """Which packets the queue drops."""

    words: ClassVar = (
        Word(
            "rate", "rate 1mbit", _read,
            grammar="rate RATE [OVERHEAD [CELL [CELL_OVERHEAD]]] [queue N]",
        ),
        Word("queue", "rate 1mbit queue 20", after="rate RATE"),
        *(
            word._replace(
                read=None, after=word.after or "rate RATE",
                grammar=word.grammar and f"rate RATE ... {word.grammar}",
            )
            for discipline in DISCIPLINES for word in discipline.words
        ),
    )  # fmt: skip
    delays: ClassVar = True

    @model_validator(mode="after")
    def _check(self) -> Self:
        line_bytes = max(65_535 + self.overhead_bytes, 0)
        if self.cell_bytes:
            cells = -(-line_bytes // self.cell_bytes)
            line_bytes = cells * (self.cell_bytes + self.cell_overhead_bytes)
        # The work on one packet and the time for a full queue must fit into 64 signed bits.
        work = line_bytes * 8 * 10**9 + self.rate_bps
        if max(work, self.queue * work // self.rate_bps) > 2**62:
            raise ValueError(
                "rate_bps: a full queue of the longest packets would take more than a century; "
                "more rate, a shorter queue or fewer bytes of overhead per cell"
            )
        return self

    def line_bits(self, payload_bytes: Any) -> Any:
        """Return the bits that a payload needs on the link; for an array, those of each entry."""
        line_bytes = np.maximum(payload_bytes + self.overhead_bytes, 0)
        if self.cell_bytes:
            line_bytes = -(-line_bytes // self.cell_bytes) * (
                self.cell_bytes + self.cell_overhead_bytes
            )
        return 8 * line_bytes

    @property
    def longest_s(self) -> float:
        """Transmission time of a full queue of packets of 1,500 bytes, in seconds."""
        return self.queue * 8 * 1500 / self.rate_bps

    @property
    def is_bounded(self) -> bool:
        return False

    @property
    def prediction_note(self) -> str:
        return self.discipline.prediction_note or "as long as no queue overflows"

    def reorders(self, delayed: bool, reordered: bool) -> tuple[bool, bool]:
        return True, False  # it serves in the order of arrival

    @classmethod
    def examples(cls) -> Sequence[Self]:
        disciplines = [example for kind in DISCIPLINES for example in kind.examples()]
        rates = ((5_000_000, 1), (5_000_000, 50), (10**8, 5))
        return [
            *(
                cls(rate_bps=rate_bps, queue=queue, discipline=discipline)
                for rate_bps, queue in rates for discipline in disciplines
            ),
            cls(rate_bps=10**9, overhead_bytes=-10, cell_bytes=48, cell_overhead_bytes=5),
        ]  # fmt: skip

    def text(self) -> str:
        numbers = (self.overhead_bytes, self.cell_bytes, self.cell_overhead_bytes)
        given = without_defaults(numbers, (_HEADERS_BYTES, 0, 0))
        words = ["rate", rate_text(self.rate_bps), *given]
        if self.queue != _QUEUE:
            words.append(f"queue {self.queue}")
        return " ".join(filter(None, [*map(str, words), self.discipline.text()]))

    def meaning(self) -> str:
        text = (
            f"forwards {rate_text(self.rate_bps)} per second, one packet after the other, each "
            f"with {self.overhead_bytes} bytes beside its payload; {self.queue} may wait, "
            f"{self.discipline.meaning()}"
        )
        if self.cell_bytes:
            text += f"; in cells of {self.cell_bytes} + {self.cell_overhead_bytes} bytes"
        return text

    def stage(self, tables: StageTables) -> Stage:
        names = ("rate_bps", "overhead_bytes", "cell_bytes", "cell_overhead_bytes")
        return self.discipline.queue_stage(
            {name: getattr(self, name) for name in names}, self.queue
        )

    def tc_text(self) -> str:
        cells = (self.cell_bytes, self.cell_overhead_bytes)
        numbers = (self.overhead_bytes - _TC_HEADERS_BYTES, *(cells if any(cells) else ()))
        return " ".join(["rate", rate_text(self.rate_bps), *map(str, numbers)])

    def tc_lacks(self, before: Sequence[Impairment]) -> str:
        return self.discipline.tc_lacks(before)

    def tc_notes(self) -> Sequence[str]:
        return ("its queue is the limit; its overhead is for an Ethernet device, with IPv4",)
