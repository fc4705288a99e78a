"""The emulator's rows of each loop, from those of the network that all loops share.

A loop's rows have the loop's own time, which is 0 at its phase; its flows are numbered as in a run
of one loop; and its inputs are numbered in turn. A row that is missing in the record leaves its
number free in every loop.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cosim.record.record_source import Rows
from noack.config.resolution import network_tables
from noack.protocol.machine_interface import GENERATION
from noack.protocol.record_tables import LOOP, NETEM_SETTING, OWNER

_TIMES = ("t_ns", "now_ns", "since_ns", "release_ns", "copy_ns")
_NEVER = ("release_ns", "copy_ns")
"""Columns in which −1 is no time."""


def rows_by_loop(table: str, rows: Rows, phases_ns: Sequence[int]) -> Iterator[tuple[int, Rows]]:
    """Yield the number and the rows of each loop, from a part of a table of the live record.

    The inputs of the emulator keep their numbers. Rows of a run without [[loops]] are of loop 0.
    """
    shared = OWNER[table] == "netem"
    names = [name for name in rows.dtype.names or () if name != LOOP]
    if not shared and len(names) == len(rows.dtype.names or ()):
        yield 0, rows
        return
    own = np.dtype([(name, rows.dtype[name]) for name in names])
    numbers = rows["flow"] % len(phases_ns) if shared else rows[LOOP].astype(np.int64)
    order = np.argsort(numbers, kind="stable")
    ends = np.cumsum(np.bincount(numbers, minlength=len(phases_ns)))
    for number in np.unique(numbers).tolist():
        if number >= len(phases_ns):  # damaged
            continue
        chosen = rows[order[ends[number - 1] if number else 0 : ends[number]]]
        found = chosen if shared else np.empty(len(chosen), own)
        if shared:
            _shift(found, phases_ns[number])
            found["flow"] //= len(phases_ns)
        else:
            for name in names:
                found[name] = chosen[name]
        yield number, found


def network_rows_by_loop(
    rows: Mapping[str, Rows], phases_ns: Sequence[int]
) -> Iterator[dict[str, Rows]]:
    """Yield the rows of each loop, from all rows of the tables of the network."""
    tables = {table: rows[table] for table in network_tables()}
    count = len(phases_ns)
    loops = {
        table: np.full(len(found), -1) if table == NETEM_SETTING else found["flow"] % count
        for table, found in tables.items()
    }  # a change of settings concerns every loop
    inputs = np.sort(np.concatenate([found["input"] for found in tables.values()]))
    places = {
        table: np.append(0, np.cumsum(np.bincount(loop[loop >= 0], minlength=count)))
        for table, loop in loops.items()
    }
    orders = {table: np.argsort(loop, kind="stable") for table, loop in loops.items()}
    for number, phase_ns in enumerate(phases_ns):
        own = {}
        for table, found in tables.items():
            first, last = places[table][number : number + 2]
            is_common = table == NETEM_SETTING
            own[table] = found[slice(None) if is_common else orders[table][first:last]].copy()
        _renumber(own, inputs)
        for table, found in own.items():
            _shift(found, phase_ns)
            if table != NETEM_SETTING:
                found["flow"] //= count
        yield own


def _renumber(own: Mapping[str, Rows], inputs: NDArray[np.int64]) -> None:
    """Number a loop's inputs in turn, within each generation of the emulator.

    ``inputs`` has the numbers of all loops, ascending. The rows of other loops are left out of the
    count; rows that are missing are not.
    """
    mine = np.sort(np.concatenate([found["input"] for found in own.values()]))
    for found in own.values():
        numbers = found["input"].copy()
        begin = numbers // GENERATION * GENERATION
        for counted, sign in ((inputs, -1), (mine, 1)):
            before = np.searchsorted(counted, numbers) - np.searchsorted(counted, begin)
            found["input"] += sign * before


def _shift(rows: Rows, phase_ns: int) -> None:
    """Change times of the run into times of a loop."""
    for name in _TIMES:
        if name in (rows.dtype.names or ()):
            is_time = rows[name] >= 0 if name in _NEVER else slice(None)
            rows[name][is_time] -= phase_ns
            if "since_ns" in (rows.dtype.names or ()) and name != "now_ns":
                np.maximum(rows[name], 0, out=rows[name])  # a change before the loop begins
