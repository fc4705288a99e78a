"""The result of a replay: by process, by flow of messages, and the first difference of all."""

import math
import struct
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from noack.protocol.record_tables import entry_names

Value = float | int | str | None


@dataclass(frozen=True)
class ReplayDifference:
    """A value that differs between record and replay.

    Floating-point values also have their ``float.hex()``, which shows every bit; a value that is
    not finite has this form only.
    """

    table: str
    row: int
    """Index in the table, from 0."""
    column: str
    """Name as in the Parquet file, such as ``x_2``; empty if no single column differs."""
    recorded: Value
    recorded_hex: str | None
    replayed: Value
    replayed_hex: str | None
    what: str
    """The difference in words."""
    now_ns: int
    """The row's recorded time."""

    def __str__(self) -> str:
        column = f", {self.column}" if self.column else ""
        values = ""
        if self.recorded is not None or self.recorded_hex is not None:
            recorded = _text(self.recorded, self.recorded_hex)
            values = f": recorded {recorded}, replayed {_text(self.replayed, self.replayed_hex)}"
        return f"{self.table} row {self.row}{column}: {self.what}{values}"


def difference(
    table: str,
    row: int,
    now_ns: int,
    what: str,
    column: str = "",
    recorded: object = None,
    replayed: object = None,
) -> ReplayDifference:
    """Return a difference with its values formatted."""
    (first, first_hex), (second, second_hex) = _shown(recorded), _shown(replayed)
    return ReplayDifference(table, row, column, first, first_hex, second, second_hex, what, now_ns)


def rows_differ(table: str, row: int, recorded: np.void, replayed: np.void) -> ReplayDifference:
    """Name the first column in which two rows of a table differ in any bit."""
    now_ns = int(recorded["now_ns"])
    for name in recorded.dtype.names or ():
        if (entry := first_entry(recorded[name], replayed[name])) is not None:
            place, *values = entry
            width = np.size(recorded[name])
            column = entry_names(name, width)[place] if np.ndim(recorded[name]) else name
            return difference(table, row, now_ns, "the row differs", column, *values)
    raise ValueError("the rows are equal")


def first_entry(recorded: Any, replayed: Any) -> tuple[int, object, object] | None:
    """Return index and values of the first entry in which a column's two values differ."""
    pairs = zip(np.atleast_1d(recorded), np.atleast_1d(replayed), strict=True)
    for i, (one, other) in enumerate(pairs):
        if one.tobytes() != other.tobytes():
            return i, one.item(), other.item()
    return None


def _shown(value: object) -> tuple[Value, str | None]:
    if isinstance(value, float):
        if math.isnan(value):  # NaNs may differ in their bits
            return None, f"nan, bits {struct.pack('>d', value).hex()}"
        return value if math.isfinite(value) else None, value.hex()
    if isinstance(value, bytes):
        return value.hex(), None
    return (value if isinstance(value, int | str) else None), None


def _text(value: Value, as_hex: str | None) -> str:
    if value is None:
        return as_hex or "nothing"
    return f"{value} ({as_hex})" if as_hex else str(value)


@dataclass(frozen=True)
class ProcessReplay:
    """The result of one process's replay."""

    process: str
    inputs: int
    """Inputs in the record."""
    compared: int
    """Replayed inputs; the row of each was compared."""
    missing_from: int | None
    """Number of the first input without a row in the record; the replay stops before it."""
    end_known: bool
    """Whether the process wrote a report with its number of rows."""
    difference: ReplayDifference | None

    @property
    def whole(self) -> bool:
        """Whether every input of the process was replayed."""
        return self.end_known and self.compared == self.inputs and self.missing_from is None

    @property
    def gap(self) -> str | None:
        """The part of the record that the replay of this process does not cover, in words."""
        if self.missing_from is not None:
            return f"{self.process}: rows are missing from input {self.missing_from} on"
        if self.compared < self.inputs:
            return f"{self.process}: replayed up to input {self.compared}"
        if not self.end_known:
            return f"{self.process}: left no report; whether its last rows are missing is not known"
        return None


@dataclass(frozen=True)
class MessagesReplay:
    """The comparison of one hop: messages sent in the replay, messages received in the run."""

    leg: str
    received: int
    """Messages in the receiver's record."""
    compared: int
    """Compared messages; the replay of their sender covers them."""
    difference: ReplayDifference | None


@dataclass(frozen=True)
class Replay:
    """The result of a replay."""

    processes: tuple[ProcessReplay, ...]
    messages: tuple[MessagesReplay, ...]

    @property
    def inputs(self) -> int:
        """Number of replayed inputs."""
        return sum(process.compared for process in self.processes)

    @property
    def first_difference(self) -> ReplayDifference | None:
        """The earliest difference by recorded time; at equal times messages come before rows."""
        found = [messages.difference for messages in self.messages]
        found += [process.difference for process in self.processes]
        differences = [one for one in found if one is not None]
        return min(differences, key=lambda difference: difference.now_ns, default=None)

    @property
    def bit_exact(self) -> bool | None:
        """Whether there is no difference; None if nothing was compared."""
        return self.first_difference is None if self.inputs else None

    @property
    def gaps(self) -> list[str]:
        """The gaps of the record that the replay does not cover, in words."""
        return [gap for process in self.processes if (gap := process.gap)]

    def verdict(self) -> dict[str, Any]:
        """The result for the run's summary."""
        found = self.first_difference
        return {
            "bit_exact": self.bit_exact,
            "complete": not self.gaps,
            "inputs": self.inputs,
            "first_difference": None if found is None else asdict(found),
        }

    def document(self) -> dict[str, Any]:
        """The complete result for JSON."""
        return self.verdict() | {
            "gaps": self.gaps,
            "processes": [asdict(process) for process in self.processes],
            "messages": [asdict(messages) for messages in self.messages],
        }
