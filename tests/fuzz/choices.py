"""Bytes as choices: what a structured input is made of, however long the bytes are.

Beyond their end every choice is the first one, so that all bytes make an input, and fewer bytes a
simpler one. It needs no fuzzer, so that a kept input means the same to all who run it.
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
"""Few choices and many."""
EDITS = tuple(b"\0" + seed for seed in SEEDS)
"""The same for parsers of text, of which a zero byte begins edits of valid text."""


class Choices:
    """Takes choices from bytes, first to last."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    @property
    def left(self) -> int:
        """Bytes that no choice has taken."""
        return len(self._data) - self._at

    def take(self, count: int) -> bytes:
        """So many bytes."""
        taken = self._data[self._at : self._at + count]
        self._at += len(taken)
        return taken.ljust(count, b"\0")

    def rest(self) -> bytes:
        """All that is left."""
        return self.take(self.left)

    def below(self, limit: int) -> int:
        """A number from 0 to below ``limit``."""
        size = 1 if limit <= 256 else 2
        return int.from_bytes(self.take(size), "little") % limit

    def one(self, of: Sequence[T]) -> T:
        """One of these."""
        return of[self.below(len(of))]

    def flag(self) -> bool:
        """Yes or no."""
        return bool(self.below(2))

    def integer(self) -> int:
        """An integer: one where something is apt to go wrong, a small one, or any of 64 bits."""
        match self.below(3):
            case 0:
                return self.one(INTEGERS)
            case 1:
                return self.below(256)
            case _:
                return int(struct.unpack("<q", self.take(8))[0])

    def real(self) -> float:
        """A real number: one where something is apt to go wrong, or of any bits."""
        if self.flag():
            return float(struct.unpack("<d", self.take(8))[0])
        return self.one(FLOATS)

    def text(self) -> str:
        """A short text, of any characters that UTF-8 can say."""
        return self.take(self.below(16)).decode("utf-8", errors="replace")
