"""A bottleneck with a finite queue, and a discipline for the queue."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, Field, model_validator

from netem.core.settings_section import Table
from netem.impairments.clauses import Clause, Part, Word
from netem.impairments.disciplines import DISCIPLINES, Discipline
from netem.impairments.disciplines.tail_drop import TailDrop
from netem.impairments.feature import Impairment, PacketOrder, Scheduler, Stage, StageTables
from netem.impairments.words import COUNT, RATE_BPS, SIGNED_COUNT, WordReader, rate_text

_TC_HEADERS_BYTES = 42
"""Bytes that tc adds to a payload on an Ethernet device: headers of Ethernet, IPv4 and UDP."""


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
    queue: Annotated[int, Field(ge=1, le=1_000_000)] = 1000
    """Maximum number of packets that wait or are being sent; further packets are dropped."""
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
            Part("queue", COUNT, "N", "queue", "rate 1mbit queue 20"),
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
        # The work on one packet and the time for a full queue must fit into 64 signed bits.
        work = line_bytes * 8 * 10**9 + self.rate_bps
        if max(work, self.queue * work // self.rate_bps) > 2**62:
            raise ValueError(
                "rate_bps: a full queue of the longest packets would take more than a century; "
                "more rate, a shorter queue or fewer bytes of overhead per cell"
            )
        return self

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
        """Transmission time of a full queue of packets of 1,500 bytes, in seconds."""
        return self.queue * 8 * 1500 / self.rate_bps

    @property
    def is_bounded(self) -> bool:
        return False

    @property
    def prediction_note(self) -> str:
        return self.discipline.prediction_note or "as long as no queue overflows"

    def order_after(self, before: PacketOrder) -> PacketOrder:
        return PacketOrder(delayed=True)  # it serves in the order of arrival

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
        names = {"rate_bps", "overhead_bytes", "cell_bytes", "cell_overhead_bytes"}
        return self.discipline.queue_stage(self.model_dump(include=names), self.queue, tables)

    def tc_text(self) -> str:
        cells = (self.cell_bytes, self.cell_overhead_bytes)
        numbers = (self.overhead_bytes - _TC_HEADERS_BYTES, *(cells if any(cells) else ()))
        return " ".join(["rate", rate_text(self.rate_bps), *map(str, numbers)])

    def tc_lacks(self, earlier: Sequence[Impairment]) -> str:
        return self.discipline.tc_lacks(earlier)

    def tc_notes(self) -> Sequence[str]:
        return ("its queue is the limit; its overhead is for an Ethernet device, with IPv4",)
