"""Replays the rows of all loops of a role by compiled code, and compares them bit for bit."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.protocol.record_tables import LOOP
from noack.runtime.fleet import replay_driver
from noack.runtime.fleet.compiled_fleet import CompiledFleet

Rows = NDArray[np.void]
_VECTORS = ("x", "u")
"""The received vector, by its name in the rows of messages."""


class FleetReplay(NamedTuple):
    """The result of a replay."""

    inputs: int
    """Number of inputs whose rows were found again."""
    differs: tuple[str, int] | None
    """Table and place of the first row that differs; None if no row does."""


def replay_fleet(
    fleet: CompiledFleet, rows: Mapping[str, Rows], replay: Callable[..., int]
) -> FleetReplay:
    """Replay all rows of a role.

    Args:
        fleet: new machines.
        rows: the rows of its two tables, in any order of the loops.
        replay: the compiled code.
    """
    names = [table for table in fleet.tables if table in rows]
    numbers = [(rows[name][LOOP].astype(np.int64), rows[name]["input"]) for name in names]
    loops, inputs = (np.concatenate(part) for part in zip(*numbers, strict=True))
    sizes = [len(rows[name]) * rows[name].dtype.itemsize for name in names]
    begins = np.cumsum([0, *sizes[:-1]])
    places = [
        (begin + np.arange(len(rows[name])) * rows[name].dtype.itemsize) * 2
        + (name == fleet.timer_table != fleet.message_table)
        for begin, name in zip(begins.tolist(), names, strict=True)
    ]
    order = np.lexsort((inputs, loops))
    entries = np.concatenate([[0], np.concatenate(places)[order]]).astype(np.int64)
    record = np.frombuffer(b"".join(rows[name].tobytes() for name in names), np.uint8).copy()
    tables = record, entries, _vector(rows[fleet.message_table].dtype), np.zeros(512, np.int64)
    reason = fleet.replay(replay, tables, len(order))
    done = int(entries[0])
    if reason == replay_driver.DONE:
        return FleetReplay(done, None)
    row = int(order[done])
    for name in names:
        if row < len(rows[name]):
            return FleetReplay(done, (name, row))
        row -= len(rows[name])
    raise IndexError("the tables have fewer rows")


def _vector(dtype: np.dtype[np.void]) -> NDArray[np.int64]:
    """Return where a message's vector is in a row, in words, and its length."""
    name = next(one for one in _VECTORS if one in (dtype.names or ()))
    assert dtype.fields is not None
    kind, offset = dtype.fields[name][:2]
    prefix_bytes = 2 * (LOOP in (dtype.names or ()))
    return np.array([(offset - prefix_bytes) // 8, kind.shape[0]], np.int64)


def replay_arguments(fleet: CompiledFleet) -> tuple[Any, ...]:
    """Return arguments of the replay; only their types matter."""
    return (
        *fleet.arguments, np.zeros(1, np.uint8), np.zeros(1, np.int64), np.zeros(2, np.int64),
        np.zeros(1, np.int64),
    )  # fmt: skip
