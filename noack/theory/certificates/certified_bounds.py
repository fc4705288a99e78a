"""A certificate: bounds over time that the checker has proven, with their conditions and assumptions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np

from netem.core.number_format import at_most
from noack.core.linear_systems import Matrix, Vector
from noack.theory.certificates.assumptions import Assumption
from noack.theory.certificates.conditions import BOX, NetworkConditions
from noack.theory.certificates.proven_bounds import ProvenBounds

Quantity = Literal["x", "e_c", "e_s", "estimate"]
"""What a certificate bounds: ‖x‖, or an output in its place; ‖e_c‖_W and ‖e_s‖_W; ‖x̂ − x‖_W at tests."""
LONGEST_S, _TIME_ACCURACY = 1e7, 1e-6
"""The longest run, and the relative accuracy of the time at which a bound is small enough."""
_CLEARLY_SMALLER = 0.95
"""A bound is worth a mention beside another one below this share of it."""


@dataclass(frozen=True)
class ScenarioCertificate:
    """The guaranteed bounds of a loop."""

    scope: str
    """The plants that it covers."""
    conditions: NetworkConditions
    """What it assumes of network and schedule."""
    assumptions: tuple[Assumption, ...]
    proven: ProvenBounds | None
    """The bounds; None if there is no certificate."""
    void: str | None = None
    """Reason for having no certificate; None if there is one."""

    @property
    def exists(self) -> bool:
        """Whether there is a certificate."""
        return self.proven is not None

    def has(self, quantity: Quantity) -> bool:
        """Whether there is a bound of a quantity from the start on."""
        return self.proven is not None and quantity in self.proven.bounds

    def of_output(self, index: int, row: Sequence[float]) -> Self:
        """Return the certificate with the bound of an output, |c x|, in the place of that of ‖x‖.

        It is the output's own, if one is proven, or else ‖c‖ times that of ‖x‖.

        Args:
            index: the output's place among those of the loop.
            row: its row c, n factors.
        """
        if self.proven is None:
            return self
        size = math.nextafter(math.hypot(*row) * (1 + 4 * np.finfo(float).eps), math.inf)
        return replace(self, proven=self.proven.of_output(f"y[{index}]", size))

    @property
    def ultimate_state(self) -> float:
        """What the bound of ‖x‖, or of the output, tends to as t → ∞; infinite without a bound."""
        reached = float(self.state(np.array([LONGEST_S]))[0]) if self.has("x") else math.inf
        limit = math.inf if self.proven is None else self.proven.limits.get("x", math.inf)
        return min(reached, limit)

    @property
    def is_smaller_in_limit(self) -> bool:
        """Whether a smaller bound is proven for t → ∞ than the one from the start on tends to."""
        return self.ultimate_state < _CLEARLY_SMALLER * float(self.state(np.array([LONGEST_S]))[0])

    def settles_s(self, allowed: float) -> float | None:
        """Return from when on ‖x‖, or the output, is at most a value; None: it may exceed it for ever."""

        def within(t_s: float) -> bool:
            return bool(self.state(np.array([t_s]))[0] <= allowed)

        if not within(LONGEST_S):
            return None
        if within(0.0):
            return 0.0
        low_s, high_s = 0.0, LONGEST_S
        while high_s - low_s > _TIME_ACCURACY * high_s:
            middle_s = (low_s + high_s) / 2
            low_s, high_s = (low_s, middle_s) if within(middle_s) else (middle_s, high_s)
        return high_s

    def first(self, quantity: Quantity) -> float | None:
        """The first number in a bound, see :meth:`formula`; None if there is no such bound."""
        if self.proven is None or quantity not in self.proven.bounds:
            return None
        return self.proven.bounds[quantity].first

    def pattern(self, symbol: str, quantity: Quantity) -> str:
        """Return the bound of a quantity in words of mathematics; ``{}`` stands for its first constant."""
        assert self.proven is not None
        return self.proven.formula(symbol, quantity)

    def formula(self, symbol: str, quantity: Quantity) -> str:
        """Return the bound of a quantity in words of mathematics, e.g. "‖x‖ ≤ 2 e^(−0.3t) + 0.1"."""
        return self.pattern(symbol, quantity).format(at_most(self.first(quantity)))

    @property
    def source(self) -> str:
        """Name of the certificate as the source of a claim."""
        return "box certificate" if self.scope == BOX else "certificate"

    @property
    def inter_event_s(self) -> float | None:
        """Lower bound of the inter-event time; None if there is none. See :meth:`apart_s`."""
        return None if self.proven is None else self.proven.inter_event_s

    def apart_s(self, events_s: Vector, started_s: float) -> Vector:
        """Return how far after each event the next one is at least, (k,); 0 where nothing is known.

        Args:
            events_s: times of the events, (k,); the first one is at 0.
            started_s: when the first input acts.
        """
        if self.proven is None:
            return np.zeros(len(events_s))
        return self.proven.apart_s(events_s, started_s)

    def bound(self, t_s: Matrix, quantity: Quantity) -> Matrix:
        """Bound of a quantity at times (k,); NaN where there is none."""
        times = np.asarray(t_s, dtype=float)
        if self.proven is None or quantity not in self.proven.bounds:
            return np.full(len(times), np.nan)
        return self.proven.at(quantity, times)

    def sensor_error(self, t_s: Matrix) -> Matrix:
        """Bound of ‖e_s‖_W at times (k,); NaN without a certificate."""
        return self.bound(t_s, "e_s")

    def controller_error(self, t_s: Matrix) -> Matrix:
        """Bound of ‖e_c‖_W at times (k,); NaN without a certificate."""
        return self.bound(t_s, "e_c")

    def state(self, t_s: Matrix) -> Matrix:
        """Bound of ‖x‖ at times (k,); NaN without a certificate."""
        return self.bound(t_s, "x")

    def to_json(self) -> dict[str, object]:
        """Return all fields for JSON."""
        return {
            "scope": self.scope,
            "conditions": self.conditions._asdict()
            | {"constraints": [rule.name for rule in self.conditions.constraints]},
            "assumptions": [assumption._asdict() for assumption in self.assumptions],
            "proven": None if self.proven is None else self.proven.to_json(),
            "inter_event_s": self.inter_event_s,
            "void": self.void,
        }
