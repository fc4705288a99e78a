"""Bounds that the checker has proven, as floats; ``noack.theory.witnesses.outward`` rounds them."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Vector
from noack.core.number_format import at_least, at_most


class ProvenBound(NamedTuple):
    """At most ``decaying`` · e^(−rate·t) + ``constant``."""

    decaying: float
    constant: float

    @property
    def first(self) -> float:
        """The constant that a formula names first."""
        return self.decaying or self.constant


class ProvenBounds(NamedTuple):
    """What the checker has proven for some plants under some conditions."""

    rate_per_s: float
    """Of all bounds."""
    bounds: Mapping[str, ProvenBound]
    """From the start on, by the output: "x", "e_s" and "e_c", the errors in the trigger's norm."""
    limits: Mapping[str, float]
    """In the limit t → ∞, by the output: "x", and "x[0]", "x[1]", … for the states."""
    inter_event_s: float | None
    """Two events after the one at t = 0 are at least this far apart; None: nothing is known."""
    first_event_s: float | None
    """No event follows the one at t = 0 before this time; None: nothing is known."""
    is_quiet: bool
    """No event follows the one at t = 0 before the first input acts. Else the inter-event time, and the
    bound of e_c, hold from this input on."""

    def to_json(self) -> dict[str, object]:
        """Return all fields for JSON."""
        return self._asdict() | {"bounds": {name: bound._asdict() for name, bound in self.bounds.items()}}

    def at(self, output: str, t_s: Vector) -> Vector:
        """Return the bound of an output at times (k,)."""
        decaying, constant = self.bounds[output]
        return np.asarray(decaying * np.exp(-self.rate_per_s * t_s) + constant)

    def formula(self, quantity: str, output: str) -> str:
        """Return the bound of an output in words of mathematics; ``{}`` stands for its first constant."""
        bound, rate = self.bounds[output], self.rate_per_s
        decay = f" e^(−{at_least(rate, 3)}t)" if rate and bound.decaying else ""
        added = f" + {at_most(bound.constant)}" if bound.decaying and bound.constant else ""
        return f"{quantity} ≤ {{}}{decay}{added}"

    def apart_s(self, events_s: Vector, started_s: float) -> Vector:
        """Return how far after each event the next one is at least, (k,); 0 where nothing is known.

        Args:
            events_s: times of the events, (k,); the first one is at 0.
            started_s: when the first input acts.
        """
        apart_s = self.inter_event_s or 0.0
        if not self.is_quiet:
            return np.where(events_s >= started_s, apart_s, 0.0)
        return np.where(events_s > 0, apart_s, min(self.first_event_s or 0.0, apart_s))

    @property
    def exception(self) -> str:
        """Between which events the inter-event time is not proven, in words; empty: between all."""
        if not self.is_quiet:
            return "after the first input"
        if (self.first_event_s or 0.0) < (self.inter_event_s or 0.0):
            return "from the second event on"
        return ""
