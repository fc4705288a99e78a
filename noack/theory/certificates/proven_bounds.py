"""Bounds that the checker has proven, as floats; ``noack.theory.witnesses.outward`` rounds them."""

import math
from collections.abc import Mapping
from typing import NamedTuple, Self

import numpy as np

from netem.core.number_format import at_least, at_most
from noack.core.linear_systems import Vector


class ProvenBound(NamedTuple):
    """At most ``decaying`` · e^(−rate·t) + ``constant``."""

    decaying: float
    constant: float

    @property
    def first(self) -> float:
        """The constant that a formula names first."""
        return self.decaying or self.constant


def _times(size: float, bound: float) -> float:
    """Return a product, rounded up."""
    return math.nextafter(size * bound, math.inf) if bound else 0.0


class ProvenBounds(NamedTuple):
    """What the checker has proven for some plants under some conditions."""

    rate_per_s: float
    """Of all bounds."""
    bounds: Mapping[str, ProvenBound]
    """From the start on, by the output: "x"; "e_s" and "e_c", the errors in the trigger's norm; "y[0]", …
    for the outputs of the loop; with noise or an observer "estimate", the error x̂ − x in this norm."""
    limits: Mapping[str, float]
    """In the limit t → ∞, by the output: "x", and "y[0]", "y[1]", … for the outputs of the loop."""
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

    def of_output(self, name: str, size: float) -> Self:
        """Return the bounds with that of an output in the place of that of ‖x‖, which it is at most.

        Args:
            name: the output, e.g. "y[0]".
            size: the norm of its row, rounded up: it is at most this times ‖x‖.
        """
        bounds, limits = dict(self.bounds), dict(self.limits)
        if name in bounds:
            bounds["x"] = bounds[name]
        elif "x" in bounds:
            bounds["x"] = ProvenBound(*(_times(size, part) for part in bounds["x"]))
        if name in limits:
            limits["x"] = limits[name]
        elif "x" in limits:
            limits["x"] = _times(size, limits["x"])
        return self._replace(bounds=bounds, limits=limits)

    def entries(self, n: int, m: int) -> Mapping[int, ProvenBound]:
        """Return the bounds of entries of (x, u), by their index; n states and m inputs."""
        names = [*(f"x[{i}]" for i in range(n)), *(f"u[{j}]" for j in range(m))]
        return {index: self.bounds[name] for index, name in enumerate(names) if name in self.bounds}

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

    def most_events(self, until_s: float, started_s: float, tests_s: float) -> int | None:
        """Return the largest number of events up to a time; None: it is not known.

        Args:
            until_s: the time.
            started_s: when the first input acts at the latest.
            tests_s: the shortest time between two tests; 0: there is none.
        """
        apart_s, most = self.inter_event_s or 0.0, 1 + 1e-12
        if not apart_s or not (self.is_quiet or tests_s):
            return None
        found = math.floor(until_s / apart_s * most) + 1
        if not self.is_quiet:  # before the first input each test may be an event
            return found + math.floor(started_s / tests_s * most) + 1
        return found + ((self.first_event_s or 0.0) < apart_s)

    @property
    def exception(self) -> str:
        """Between which events the inter-event time is not proven, in words; empty: between all."""
        if not self.is_quiet:
            return "after the first input"
        if (self.first_event_s or 0.0) < (self.inter_event_s or 0.0):
            return "except between the first two events"
        return ""
