"""A channel with a static schedule of slots; see native/impairments/schedule.c."""

from collections.abc import Sequence
from itertools import accumulate, chain
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from netem.core.clock import NS_PER_S
from netem.impairments.clauses import Clause, Part
from netem.impairments.feature import (
    MOST_FLOWS,
    Impairment,
    PacketOrder,
    Stage,
    StageTables,
    add_numbers,
    numbers_text,
)
from netem.impairments.words import COUNT, OWN_TIME_S, SIGNED_COUNT, list_of, time_text

_EXAMPLE = "schedule 0,1,0,2 slot 5ms"


class Schedule(Impairment):
    """Slots of a fixed length in a periodic order, each for one packet of one flow."""

    kind: Literal["schedule"] = "schedule"
    order: Annotated[
        tuple[Annotated[int, Field(ge=-1, lt=MOST_FLOWS)], ...],
        Field(min_length=1, max_length=MOST_FLOWS),
    ]
    """The flow of each slot, counted from 0; −1: an idle slot. In a run: the number of the loop."""
    slot_s: Annotated[FiniteFloat, Field(ge=1e-6, le=3600)]
    """Length of a slot in seconds; the first slot begins at time 0."""
    queue: Annotated[int, Field(ge=1, le=1_000_000)] = 1000
    """Maximum number of packets of a flow that wait for a slot; further packets are dropped."""

    clauses: ClassVar = (
        Clause(
            "schedule",
            _EXAMPLE,
            Part("order", list_of(SIGNED_COUNT, "numbers of flows from 0, e.g. 0,1,0,2"), "N,N,..."),
            Part("slot_s", OWN_TIME_S, "T", "slot", _EXAMPLE),
            Part("queue", COUNT, "N", "queue", f"{_EXAMPLE} queue 1"),
        ),
    )
    delays: ClassVar = True
    queues: ClassVar = True
    tc_missing: ClassVar = "a schedule of slots"

    @model_validator(mode="after")
    def _check(self) -> Self:
        missing = set(range(max(self.order) + 1 or 1)) - {*self.order}
        if missing:
            raise ValueError(
                f"order: flow {min(missing)} has no slot; flows are counted from 0 (-1: an idle slot)"
            )
        return self

    @property
    def slots(self) -> list[list[int]]:
        """The numbers of the slots in a round, of each flow that has some."""
        by_flow: list[list[int]] = [[] for _ in range(max(self.order) + 1)]
        for slot, flow in enumerate(self.order):
            if flow >= 0:
                by_flow[flow].append(slot)
        return by_flow

    @property
    def slot_ns(self) -> int:
        """Length of a slot."""
        return round(self.slot_s * NS_PER_S)

    def wait_ns(self, slots: Sequence[int], count: int) -> int:
        """Return the longest time until ``count`` of these slots have begun."""
        rounds, remainder = divmod(count, len(slots))
        begins = np.array(slots)
        ends = np.concatenate((begins, begins + len(self.order)))[remainder:][: len(slots)]
        return (rounds * len(self.order) + int((ends - begins).max())) * self.slot_ns

    @property
    def longest_s(self) -> float:
        """Longest time until a full queue has left; packets that must pass may take longer."""
        return max(self.wait_ns(slots, self.queue) for slots in self.slots) / NS_PER_S

    @property
    def is_bounded(self) -> bool:
        return False

    @property
    def prediction_note(self) -> str:
        return "as long as every flow has slots, and no queue overflows"

    def order_after(self, before: PacketOrder) -> PacketOrder:
        return PacketOrder(delayed=True)  # a flow's packets leave in the order of arrival

    def meaning(self) -> str:
        return (
            f"delivers one packet at the begin of each slot of {time_text(self.slot_s)}, of the "
            f"flows {numbers_text(self.order)} in turn; of each flow "
            f"{self.queue} may wait, more are dropped, and all of a flow without a slot"
        )

    def stage(self, tables: StageTables) -> Stage:
        slots = self.slots
        firsts = accumulate(map(len, slots), initial=0)
        begin, _ = add_numbers(tables.integers, chain(firsts, *slots))
        numbers = {
            "begin": begin,
            "flows": len(slots),
            "slots": len(self.order),
            "slot_ns": self.slot_ns,
            "queue": self.queue,
        }
        return Stage(self.kind, numbers)
