"""Random choices of a draw, which are a function of a seed and the draw's number."""

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")
Table = dict[str, Any]


class Chances:
    """The choices of one draw; numbers have few digits, so that a scenario file is short.

    Args:
        seed: the seed of the search.
        number: the draw's number.
    """

    def __init__(self, seed: int, number: int) -> None:
        self.generator = np.random.default_rng([seed, number])
        self.gentle = self.chance(0.5)
        """Whether the draw is easy to control, so that more draws have a certificate."""
        self.files: dict[str, str | bytes] = {}
        """The content of the files that the scenario names, by their names."""

    def chance(self, probability: float) -> bool:
        """Return true with a probability."""
        return bool(self.generator.random() < probability)

    def flag(self) -> bool:
        """Return true or false."""
        return self.chance(0.5)

    def integer(self, least: int, most: int) -> int:
        """Return one of the whole numbers from least to most."""
        return int(self.generator.integers(least, most, endpoint=True))

    def between(self, least: float, most: float) -> float:
        """Return a number that is uniformly distributed."""
        return _short(float(self.generator.uniform(least, most)))

    def size(self, least: float, most: float) -> float:
        """Return a positive number whose logarithm is uniformly distributed."""
        return _short(float(np.exp(self.generator.uniform(np.log(least), np.log(most)))))

    def share(self, most: float = 1.0) -> float:
        """Return a probability; the limits have a chance of 5 % each."""
        return (
            float(most)
            if self.chance(0.05) and most == 1.0
            else 0.0
            if self.chance(0.05)
            else self.between(0, most)
        )

    def one_of(self, *values: T) -> T:
        """Return one of some values."""
        return values[self.integer(0, len(values) - 1)]

    def row(self, entries: int, size: float = 1.0) -> list[float]:
        """Return normally distributed numbers."""
        return [_short(float(value)) for value in size * self.generator.standard_normal(entries)]

    def positives(self, entries: int, most: float) -> list[float]:
        """Return numbers from a hundredth of ``most`` to ``most``; some are 0."""
        return [0.0 if self.chance(0.1) else self.size(most / 100, most) for _ in range(entries)]

    def put(self, table: Table, probability: float, key: str, value: Callable[[], object]) -> None:
        """Set a key of a table with a probability."""
        if self.chance(probability):
            table[key] = value()

    def file(self, name: str, suffix: str, content: str | bytes) -> str:
        """Add a file beside the scenario; return its name."""
        full_name = f"{name}_{len(self.files)}{suffix}"
        self.files[full_name] = content
        return full_name


def _short(value: float) -> float:
    return float(f"{value:.6g}")
