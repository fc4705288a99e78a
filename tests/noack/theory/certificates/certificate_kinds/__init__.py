"""Kinds of certificates, one in each file: how loops are drawn, certified and simulated."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

Bounds = Mapping[str, float]
"""Certified upper bounds, by name; a lower bound is given by its reciprocal."""


class Observed(NamedTuple):
    """The result of all runs of one loop."""

    runs: int
    worst: Mapping[str, float]
    """The largest value of each bounded quantity, by the names of the bounds."""


class Broken(NamedTuple):
    """A wrong certificate, to show that the comparison can fail."""

    certify: Callable[[Any], Bounds | None]
    draw: Callable[[np.random.Generator], Any] | None = None
    """Draws loops in which the mistake matters; by default any loops of the kind."""


@dataclass(frozen=True)
class Kind:
    """A kind of certificate; a loop may be an object of any type."""

    name: str
    draw: Callable[[np.random.Generator], Any]
    """Draws a random loop."""
    certify: Callable[[Any], Bounds | None]
    """Returns the bounds that noack certifies; None if it certifies nothing."""
    simulate: Callable[[Any, np.random.Generator], Observed]
    """Simulates runs with random and adversarial losses, without any code of noack."""
    broken: Mapping[str, Broken] = field(default_factory=dict)
    """Wrong certificates, by the mistake."""


@dataclass(frozen=True)
class Tally:
    """The comparison of many loops with their bounds."""

    loops: int
    runs: int
    refused: int
    """Number of loops without a certificate, which were drawn again."""
    violated: Counter[str]
    """Number of loops that exceed a bound, by its name; "": any bound."""
    closest: Counter[str]
    """The largest observed value divided by its bound."""

    def plus(self, other: "Tally") -> "Tally":
        """Return both together."""
        return Tally(
            self.loops + other.loops, self.runs + other.runs, self.refused + other.refused,
            self.violated + other.violated, self.closest | other.closest,
        )  # fmt: skip
