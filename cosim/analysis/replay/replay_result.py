"""The result of a replay: by process, by flow of messages, and the first difference."""

import math
import struct

import numpy as np
from numpy.typing import ArrayLike

from cosim.analysis.summary.summary_model import ReplayDifference, ReplayPart, SummaryPart
from noack.protocol.record_tables import entry_names

Value = float | int | str | None


def difference(
    table: str,
    row: int,
    now_ns: int,
    description: str,
    column: str = "",
    recorded: object = None,
    replayed: object = None,
) -> ReplayDifference:
    """Return a difference with its values formatted."""
    (first, first_hex), (second, second_hex) = _format_value(recorded), _format_value(replayed)
    return ReplayDifference(
        table=table,
        row=row,
        column=column,
        recorded=first,
        recorded_hex=first_hex,
        replayed=second,
        replayed_hex=second_hex,
        what=description,
        now_ns=now_ns,
    )


def first_row_difference(table: str, row: int, recorded: np.void, replayed: np.void) -> ReplayDifference:
    """Return the first column in which two rows of a table differ in any bit."""
    now_ns = int(recorded["now_ns"])
    for name in recorded.dtype.names or ():
        if (entry := first_entry(recorded[name], replayed[name])) is not None:
            index, *values = entry
            width = np.size(recorded[name])
            column = entry_names(name, width)[index] if np.ndim(recorded[name]) else name
            return difference(table, row, now_ns, "the row differs", column, *values)
    raise ValueError("the rows are equal")


def first_entry(recorded: ArrayLike, replayed: ArrayLike) -> tuple[int, object, object] | None:
    """Return index and values of the first entry in which a column's two values differ."""
    pairs = zip(np.atleast_1d(recorded), np.atleast_1d(replayed), strict=True)
    for i, (first, second) in enumerate(pairs):
        if first.tobytes() != second.tobytes():
            return i, first.item(), second.item()
    return None


def _format_value(value: object) -> tuple[Value, str | None]:
    if isinstance(value, float):
        if math.isnan(value):  # NaNs may differ in their bits
            return None, f"nan, bits {struct.pack('>d', value).hex()}"
        return value if math.isfinite(value) else None, value.hex()
    if isinstance(value, bytes):
        return value.hex(), None
    if isinstance(value, int) and not -(2**63) <= value < 2**63:  # of a damaged record
        return None, hex(value)
    return (value if isinstance(value, int | str) else None), None


class ProcessReplay(SummaryPart):
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
    def is_complete(self) -> bool:
        """Whether every input of the process was replayed."""
        return self.gap is None

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


class MessagesReplay(SummaryPart):
    """The comparison of one hop: messages sent in the replay, messages received in the run."""

    hop: str
    received: int
    """Messages in the receiver's record."""
    compared: int
    """Compared messages; the replay of their sender covers them."""
    difference: ReplayDifference | None


class ReplayResult(SummaryPart):
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
        differences = [messages.difference for messages in self.messages]
        differences += [process.difference for process in self.processes]
        return min(filter(None, differences), key=lambda difference: difference.now_ns, default=None)

    @property
    def bit_exact(self) -> bool | None:
        """Whether there is no difference; None if nothing was compared."""
        return self.first_difference is None if self.inputs else None

    @property
    def gaps(self) -> list[str]:
        """The gaps of the record that the replay does not cover, in words."""
        return [gap for process in self.processes if (gap := process.gap)]

    def verdict(self) -> ReplayPart:
        """The result for the run's summary."""
        return ReplayPart(
            bit_exact=self.bit_exact,
            complete=not self.gaps,
            inputs=self.inputs,
            first_difference=self.first_difference,
        )

    def to_json(self) -> dict[str, object]:
        """Return the complete result for JSON."""
        verdict = self.verdict().model_dump(exclude={"error"})
        return verdict | {"gaps": self.gaps} | self.model_dump()
