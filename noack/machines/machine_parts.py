"""What a role describes of each of its machines, so that the core can make their steps.

A *part* is the description of one loop's machine: it fills the core's structure, and answers the
questions at which a step stops (``enum noack_question`` in native/noack.h).
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from noack.config.parameter_changes import ChangeSchedule, settings_key
from noack.config.scenario import Scenario
from noack.core.core_library import core
from noack.core.core_memory import CoreMemory
from noack.protocol.machine_interface import Notice
from noack.protocol.record_tables import RecordShape
from noack.protocol.wire_format import Flow

NEVER_NS = 2**63 - 1


class Role(NamedTuple):
    """What the machines of a process have in common."""

    name: str
    structure: str
    """Name of the core's structure of one machine, and of the field of ``noack_process``."""
    receives: Flow
    tables: tuple[str | None, str | None, str | None]
    """The record's tables of ticks, messages and acknowledgements."""
    changes: str | None = None
    """The table of announced changes of settings; None: none can be announced."""

    @property
    def number(self) -> int:
        """The role's number in the core."""
        return int(getattr(core, f"NOACK_{self.name.upper()}"))


class MachinePart(Protocol):
    """The description of one loop's machine, and what only Python can do for it."""

    role: Role

    @property
    def schedule(self) -> ChangeSchedule | None:
        """The announced changes of its settings; None if they cannot change."""
        ...

    @property
    def counts_every_message(self) -> bool:
        """Whether :meth:`inspect` needs all rows, not only those of messages after losses."""
        ...

    @property
    def shape(self) -> RecordShape:
        """The sizes of the rows that it writes."""
        ...

    def fill(self, structure: Any, memory: CoreMemory) -> None:
        """Fill the core's structure, at the start of the machine's work."""
        ...

    def redraw(self, structure: Any, memory: CoreMemory) -> None:
        """Set what the draws determine, in a copy of a structure that an alike part has filled."""
        ...

    def answer(self, question: int, structure: Any) -> Sequence[Notice]:
        """Do what a step needs before it goes on; return lines for the log."""
        ...

    def inspect(self, rows: NDArray[np.void]) -> Sequence[Notice]:
        """Return lines for the log about new rows of received messages."""
        ...

    def note(self, structure: Any, note: Any) -> Notice:
        """Return the line for the log that a step has asked for by a ``noack_note``."""
        ...


Part = TypeVar("Part", bound=MachinePart)


def alike_parts(
    loops: Sequence[Scenario],
    make: Callable[[Scenario], Part],
    redrawn: Callable[[Part, Scenario], Part],
) -> tuple[list[Part], list[int]]:
    """Return the part of each loop, and the number of the first loop that is alike.

    Loops are alike if they differ in their draws only. ``make`` makes the part of the first of
    them, ``redrawn`` one with the draws of another loop.
    """
    parts: list[Part] = []
    alike: list[int] = []
    firsts: dict[tuple[int, ...], int] = {}
    for number, loop in enumerate(loops):
        first = firsts.setdefault(settings_key(loop), number)
        parts.append(make(loop) if first == number else redrawn(parts[first], loop))
        alike.append(first)
    return parts, alike


def set_machine(
    machine: Any,
    *,
    n: int,
    m: int,
    entries: int,
    flow: Flow,
    first_number: int = 0,
    period_ns: int = 0,
    first_ns: int = 0,
    horizon_ns: int,
    step: int = 0,
) -> None:
    """Fill a ``noack_machine`` at its start."""
    machine.n, machine.m = n, m
    machine.first_number = machine.inputs = first_number
    machine.period_ns, machine.first_ns, machine.horizon_ns = period_ns, first_ns, horizon_ns
    machine.step, machine.reached_ns, machine.change_ns = step, -1, NEVER_NS
    machine.received.flow, machine.received.entries = flow, entries
    machine.acknowledgements.flow = Flow.ACKNOWLEDGEMENT
    for reception in (machine.received, machine.acknowledgements):
        reception.newest, reception.not_after_ns = -1, horizon_ns


def take_changes(schedule: ChangeSchedule | None, machine: Any) -> Sequence[Any]:
    """Return the changes that are due at the time at which a step asked, in order."""
    found: list[Any] = []
    while schedule is not None and (due := schedule.take(machine.change_ns)) is not None:
        found.append(due)
    machine.change_ns = next_change_ns(schedule)
    return found


def next_change_ns(schedule: ChangeSchedule | None) -> int:
    """Return the time of the next change."""
    if schedule is None or schedule.next_ns is None:
        return NEVER_NS
    return schedule.next_ns
