"""The memory of the machines of one role of many loops: arrays that compiled code works on.

A role has two functions, which run as they stand or compiled: ``handle`` takes a message, and
``on_timer`` does what is due. Both write one row of the record, without the loop's number in front,
to ``row``, and a message to the next place of ``out``. They return :data:`SENDS` if they wrote a
message, or else 0; or :data:`NEEDS_MATRIX`: then they have changed nothing and are called again.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.config.parameter_changes import ChangeSchedule
from noack.config.scenario import Scenario
from noack.core.model_arrays import Transitions
from noack.protocol.datagram_seal import TAG_BYTES
from noack.protocol.machine_interface import Notice
from noack.protocol.wire_format import HEADER_BYTES, MAX_DIMENSION

SENDS = 1
"""A message was written."""
NEEDS_MATRIX = -1
"""A transition matrix is missing in the table."""
HEADER_WORDS = HEADER_BYTES // 8
STRIDE = (HEADER_BYTES + TAG_BYTES) // 8 + MAX_DIMENSION + 1
"""Words of 8 bytes from one datagram's place to the next; one more than the longest has."""
SCRATCH = 16 * MAX_DIMENSION
NEVER_NS = 2**63 - 1

LOOP = np.dtype(
    [
        (name, "<i8")
        for name in (
            "phase_ns",  # when the loop begins; all other times are its own
            "due_ns",  # the nominal time of the next tick; NEVER_NS: none
            "step",  # its number
            "period_ns",  # from one tick to the next
            "horizon_ns",  # no tick is later
            "newest",  # sequence number of the newest message accepted; -1: none
            "accepted",  # messages
            "inputs",  # number of the machine's next input
        )
    ]
)
FLEET = np.dtype(
    [
        (name, "<i8")
        for name in (
            "n", "m", "loops",
            "out",  # messages that wait to be sent
            "notes",  # that wait to be written to the log
        )
    ]
)  # fmt: skip
NOTE = np.dtype(
    [
        (name, "<i8")
        for name in (
            "loop",
            "t_ns",
            "since_ns",  # when actuations began to be missing, if they arrive again
            "newest_ns",  # the time of the newest actuation
            "newest_sequence",
        )
    ]
)
"""What a plant's line for the log is made of."""


class FleetMemory(NamedTuple):
    """The part of the memory that is the same in each role."""

    fleet: NDArray[Any]
    """(1,) :data:`FLEET`."""
    loops: NDArray[Any]
    """(L,) :data:`LOOP`."""
    out: NDArray[np.int64]
    """(k STRIDE,) Datagrams to be sent, as words."""
    out_reals: NDArray[np.float64]
    """The same memory."""
    arrived: NDArray[np.int64]
    """(k STRIDE,) Datagrams received."""
    arrived_reals: NDArray[np.float64]
    notes: NDArray[Any]
    """(k,) :data:`NOTE`."""
    row: NDArray[np.int64]
    """(words of the longest row,)"""
    row_reals: NDArray[np.float64]
    scratch: NDArray[np.float64]


def new_loops(
    resolved: Sequence[Scenario], ticks_ns: Iterable[tuple[int, int]] | None = None
) -> NDArray[Any]:
    """Return the loops before their start, (L,); ``ticks_ns``: the first tick and the period."""
    loops = np.zeros(len(resolved), LOOP)
    loops["newest"], loops["due_ns"] = -1, NEVER_NS
    loops["horizon_ns"] = [one.timing.horizon_ns for one in resolved]
    if ticks_ns is not None:
        for one, (first_ns, period_ns) in zip(loops, ticks_ns, strict=True):
            one["period_ns"] = period_ns
            one["due_ns"] = first_ns if first_ns <= one["horizon_ns"] else NEVER_NS
    return loops


def next_tick(memory: FleetMemory, loop: int) -> None:
    """Set the loop's deadline to its next tick."""
    one = memory.loops[loop]
    due_ns = one.due_ns + one.period_ns
    one.step += 1
    one.due_ns = due_ns if due_ns <= one.horizon_ns else NEVER_NS


def begin_row(memory: FleetMemory, loop: int, sequence: int, t_ns: int, now_ns: int) -> None:
    """Write the columns that all tables have."""
    one = memory.loops[loop]
    memory.row[0] = one.inputs
    memory.row[1] = sequence
    memory.row[2] = t_ns
    memory.row[3] = now_ns
    one.inputs += 1


def write_message(
    memory: FleetMemory, sequence: int, t_ns: int, source: Any, begin: int, count: int
) -> None:
    """Write number, time and vector of the next message; its vector begins in ``source``."""
    place = memory.fleet[0].out * STRIDE
    memory.out[place + 2] = sequence
    memory.out[place + 3] = t_ns
    copy_reals(source, begin, memory.out_reals, place + HEADER_WORDS, count)


def copy_reals(source: Any, begin: int, result: Any, into: int, count: int) -> None:
    """Copy ``count`` numbers."""
    for k in range(count):
        result[into + k] = source[begin + k]


class FleetParts(NamedTuple):
    """The machines of L loops in arrays."""

    arrays: Any
    """The arrays of the role, a NamedTuple."""
    loops: NDArray[Any]
    """(L,) :data:`LOOP`, see :func:`new_loops`."""
    transitions: Transitions | None = None
    """Of a role with models, the field ``models`` of its arrays."""
    notice: Callable[[Any, Any], Notice] | None = None
    """Returns the line for the log that a machine asked for, from its arrays and a NOTE."""
    inspect: Callable[[NDArray[np.void]], Sequence[tuple[int, Notice]]] | None = None
    """Returns lines for the log about new rows of ``on_message``, each with its loop."""
    changes: str = ""
    """The table of announced changes; none can be announced to other roles."""
    follow: Callable[[ChangeSchedule, Sequence[int]], None] | None = None
    """Takes the announced changes of the network, in the time of the run, and the phases."""


class FleetRole(NamedTuple):
    """A role whose machines can be in arrays."""

    module: str
    """The module with its functions ``handle`` and ``on_timer``."""
    on_message: str
    """The table of the rows of ``handle``."""
    on_timer: str | None
    """The table of the rows of ``on_timer``."""
    parts_of: Callable[[Sequence[Scenario]], FleetParts | None]
    """Returns the machines of resolved scenarios; None if one cannot be compiled."""
