"""CoDel, controlled delay (RFC 8289); see native/impairments/codel.c."""

from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, FiniteFloat

from noack.core.clock import NS_PER_S
from noack.impairments.feature import QueueDiscipline, Stage, Table, Word
from noack.impairments.words import COUNT, OWN_TIME_S, WordReader, time_text


def _read(reader: WordReader) -> Table:
    table: Table = {}
    for word, key in (("target", "target_s"), ("interval", "interval_s")):
        if reader.accept(word):
            table[key] = reader.value(OWN_TIME_S)
    if reader.accept("mtu"):
        table["mtu_bytes"] = reader.value(COUNT)
    return table


_TimeS = Annotated[FiniteFloat, Field(ge=1e-6, le=3600)]
_EXAMPLE = "rate 10mbit queue 1000 codel target 5ms interval 100ms"


class Codel(QueueDiscipline):
    """Drops packets while the delay of the queue stays above a target (RFC 8289)."""

    kind: Literal["codel"] = "codel"
    target_s: _TimeS = 0.005
    """Delay that the queue may have."""
    interval_s: _TimeS = 0.1
    """The delay must be above the target for this long before the first packet is dropped."""
    mtu_bytes: Annotated[int, Field(ge=0, le=65_535)] = 1500
    """A packet with at most this number of bytes before it in the queue is not dropped."""

    words: ClassVar = (
        Word("codel", _EXAMPLE, _read, grammar="codel [target T] [interval T] [mtu BYTES]"),
        *(Word(name, _EXAMPLE, after="rate RATE codel") for name in ("target", "interval")),
        Word("mtu", f"{_EXAMPLE} mtu 1200", after="rate RATE codel"),
    )
    tc_missing: ClassVar = "the discipline codel, which is a qdisc of its own"

    @property
    def prediction_note(self) -> str:
        return "as long as no queue overflows or CoDel drops"

    @classmethod
    def examples(cls) -> Sequence[Self]:
        return [cls(), cls(target_s=1e-5, interval_s=1e-4, mtu_bytes=0)]

    def text(self) -> str:
        words = f"codel target {time_text(self.target_s)} interval {time_text(self.interval_s)}"
        return words if self.mtu_bytes == 1500 else f"{words} mtu {self.mtu_bytes}"

    def meaning(self) -> str:
        return (
            "more are dropped; CoDel drops packets while the delay of the queue stays above "
            f"{time_text(self.target_s)} for {time_text(self.interval_s)} or longer"
        )

    def queue_stage(self, bottleneck: Mapping[str, int], queue_places: int) -> Stage:
        numbers = {
            **bottleneck,
            "target_ns": round(self.target_s * NS_PER_S),
            "interval_ns": round(self.interval_s * NS_PER_S),
            "mtu_ns": self.mtu_bytes * 8 * NS_PER_S // bottleneck["rate_bps"],
        }
        return Stage(self.kind, numbers, "bottleneck", queue_places)
