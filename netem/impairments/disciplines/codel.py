"""CoDel, controlled delay (RFC 8289); see native/impairments/codel.c."""

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

from pydantic import Field, FiniteFloat

from netem.core.clock import NS_PER_S
from netem.impairments.clauses import Clause, Part
from netem.impairments.feature import QueueDiscipline, Stage, StageTables
from netem.impairments.words import COUNT, OWN_TIME_S, time_text

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

    clauses: ClassVar = (
        Clause(
            "codel",
            _EXAMPLE,
            Part("target_s", OWN_TIME_S, "T", "target", _EXAMPLE),
            Part("interval_s", OWN_TIME_S, "T", "interval", _EXAMPLE),
            Part("mtu_bytes", COUNT, "BYTES", "mtu", f"{_EXAMPLE} mtu 1200"),
            least=0,
            implied={"kind": "codel"},
        ),
    )
    tc_missing: ClassVar = "the discipline codel, which is a qdisc of its own"

    @property
    def prediction_note(self) -> str:
        return "as long as no queue overflows or CoDel drops"

    def meaning(self) -> str:
        return (
            "more are dropped; CoDel drops packets while the delay of the queue stays above "
            f"{time_text(self.target_s)} for {time_text(self.interval_s)} or longer"
        )

    def queue_stage(self, bottleneck: Mapping[str, int], queue_places: int, tables: StageTables) -> Stage:
        numbers = {
            **bottleneck,
            "target_ns": round(self.target_s * NS_PER_S),
            "interval_ns": round(self.interval_s * NS_PER_S),
            "mtu_ns": self.mtu_bytes * 8 * NS_PER_S // bottleneck["rate_bps"],
        }
        return Stage(self.kind, numbers, "bottleneck", queue_places)
