"""Build structured inputs from bytes of any length: the bytes determine each choice.

Beyond the end of the bytes, every choice is the first option. So all bytes give an input, and fewer
bytes give a simpler one. No fuzzer is needed, so a kept input has the same meaning everywhere.
"""

import struct
from collections.abc import Sequence
from typing import TypeVar

T = TypeVar("T")

INTEGERS = (
    0, 1, -1, 2, 3, 5, 64, 65, 255, 65_535, 65_536, 10**6, 10**9, 2**31, 2**53 + 1,
    2**63 - 1, 2**63, -(2**63), 2**64 - 1, 2**64, 10**30, 10**400,
)  # fmt: skip
FLOATS = (
    0.0, -0.0, 0.5, 1.0, -1.0, 1.5, 0.1, 100.0, 1e-9, 1e-3, 1e9, 1e17, 1e300,
    1.7976931348623157e308, 5e-324, float("inf"), float("-inf"), float("nan"),
)  # fmt: skip

SEEDS = (b"", bytes(range(256)), bytes(range(255, -1, -1)) * 2)
"""Seeds with few choices and with many."""
EDITS = tuple(b"\0" + seed for seed in SEEDS)
"""The same seeds for parsers of text, where a zero byte selects edits of valid text."""


class Choices:
    """Reads choices from bytes, first to last."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    @property
    def left(self) -> int:
        """Number of unused bytes."""
        return len(self._data) - self._at

    def take(self, count: int) -> bytes:
        """Return the next ``count`` bytes."""
        taken = self._data[self._at : self._at + count]
        self._at += len(taken)
        return taken.ljust(count, b"\0")

    def rest(self) -> bytes:
        """Return all unused bytes."""
        return self.take(self.left)

    def below(self, limit: int) -> int:
        """Return a number from 0 to ``limit`` − 1."""
        size = 1 if limit <= 256 else 2
        return int.from_bytes(self.take(size), "little") % limit

    def one(self, of: Sequence[T]) -> T:
        """Return one of these options."""
        return of[self.below(len(of))]

    def flag(self) -> bool:
        """Return True or False."""
        return bool(self.below(2))

    def integer(self) -> int:
        """Return an integer: a boundary value, a small one, or any of 64 bits."""
        match self.below(3):
            case 0:
                return self.one(INTEGERS)
            case 1:
                return self.below(256)
            case _:
                return int(struct.unpack("<q", self.take(8))[0])

    def real(self) -> float:
        """Return a float: a boundary value, or any 64 bits."""
        if self.flag():
            return float(struct.unpack("<d", self.take(8))[0])
        return self.one(FLOATS)

    def text(self) -> str:
        """Return a short text of any UTF-8 characters."""
        return self.take(self.below(16)).decode("utf-8", errors="replace")
