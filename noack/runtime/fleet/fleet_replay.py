"""Replays recorded inputs of a role by compiled code, and compares the rows bit for bit."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.protocol.record_tables import LOOP
from noack.runtime.fleet import replay_driver
from noack.runtime.fleet.compiled_fleet import CompiledFleet, Driver

Rows = NDArray[np.void]
Numbers = NDArray[np.int64]
_VECTORS = ("x", "u")
"""The received vector, by its name in the rows of messages."""


class SentMessages(NamedTuple):
    """Messages of a flow."""

    sequences: Numbers
    t_ns: Numbers
    vectors: NDArray[np.float64]
    """(k, entries)"""

    def at(self, places: slice | Numbers) -> "SentMessages":
        """Return those at some places."""
        return SentMessages(self.sequences[places], self.t_ns[places], self.vectors[places])

    def followed_by(self, more: "SentMessages") -> "SentMessages":
        """Return these and more."""
        if not len(self.sequences):
            return more
        return SentMessages(
            np.concatenate([self.sequences, more.sequences]),
            np.concatenate([self.t_ns, more.t_ns]),
            np.concatenate([self.vectors, more.vectors]),
        )


class FleetReplay:
    """The machines of a role under replay, part by part of the record.

    Args:
        fleet: new machines.
        code: from :func:`noack.runtime.fleet.compiled_driver.compiled_replay`.
    """

    def __init__(self, fleet: CompiledFleet, code: Driver) -> None:
        self._fleet, self._code = fleet, code

    def take(self, rows: Mapping[str, Rows], order: Numbers) -> SentMessages | None:
        """Replay the next rows; return the messages sent, or None if anything differs.

        Args:
            rows: rows by table.
            order: the places of the inputs in order, among the rows of all tables.
        """
        fleet = self._fleet
        own = {table: rows[table] for table in fleet.tables}
        if sum(map(len, own.values())) < sum(map(len, rows.values())):
            return None  # such as changes of settings
        entries = np.empty(1 + len(order), np.int64)
        entries[0] = 0
        places = [np.zeros(0, np.int64)]
        begin = 0
        for table, found in rows.items():
            is_timer = table == fleet.timer_table != fleet.message_table
            at = begin + np.arange(len(found)) * found.dtype.itemsize
            places.append(at * 2 + is_timer)
            begin += len(found) * found.dtype.itemsize
        entries[1:] = np.concatenate(places)[order]
        record = np.frombuffer(b"".join(found.tobytes() for found in rows.values()), np.uint8)
        sent = np.empty(1 + len(order) * fleet.sent_words, np.int64)
        sent[0] = 0
        vector = _vector(own[fleet.message_table].dtype)
        tables = record, entries, vector, np.zeros(512, np.int64), sent
        if fleet.replay(self._code, tables, len(order)) != replay_driver.DONE:
            return None
        words = sent[1 : 1 + int(sent[0]) * fleet.sent_words].reshape(-1, fleet.sent_words)
        vectors = np.ascontiguousarray(words[:, 2:]).view(np.float64)
        return SentMessages(words[:, 0].copy(), words[:, 1].copy(), vectors)


def _vector(dtype: np.dtype[np.void]) -> Numbers:
    """Return where a message's vector is in a row, in words, and its length."""
    name = next(one for one in _VECTORS if one in (dtype.names or ()))
    assert dtype.fields is not None
    kind, offset = dtype.fields[name][:2]
    prefix_bytes = 2 * (LOOP in (dtype.names or ()))
    return np.array([(offset - prefix_bytes) // 8, kind.shape[0]], np.int64)


def replay_arguments(fleet: CompiledFleet) -> tuple[Any, ...]:
    """Return arguments of the replay; only their types matter."""
    numbers = np.zeros(1, np.int64)
    return (*fleet.arguments, np.zeros(1, np.uint8), numbers, np.zeros(2, np.int64), numbers,
            numbers)  # fmt: skip
