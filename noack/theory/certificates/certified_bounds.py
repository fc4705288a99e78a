"""What a certificate guarantees: bounds over time, under its conditions and assumptions."""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from noack.core.linear_systems import Matrix
from noack.theory.bounds.terms import Constants, NetworkConditions
from noack.theory.certificates.assumptions import Assumption
from noack.theory.certificates.conditions import OWN_PLANT


@dataclass(frozen=True)
class ScenarioCertificate:
    """The guaranteed bounds of a loop."""

    scope: str
    """The plants that it covers."""
    beta: float
    """β, or 0 if the threshold has no such part."""
    alpha_per_s: float
    floor: float
    """ε: the constant part of the threshold, or 0."""
    weighted: bool
    """Whether the trigger's norm is weighted."""
    conditions: NetworkConditions
    assumptions: tuple[Assumption, ...]
    constants: Constants | None
    """None if there is no certificate."""
    floor_constants: Constants | None
    """The constants from ``floor_from_s`` on, with ε in place of βe^{−αt} and without decay."""
    void: str | None
    """Reason for having no certificate; None if there is one."""
    persistent_constants: Constants | None = None
    """The constants, in units of 1 and without decay, whose bounds are added to those of
    ``constants`` under disturbances, noise, an observer or a constant threshold."""
    other: "ScenarioCertificate | None" = None
    """A second certificate of the same plants under the same conditions: both bounds hold."""

    @property
    def source(self) -> str:
        """Name of the certificate as the source of a claim."""
        return "certificate" if self.scope == OWN_PLANT else "box certificate"

    @property
    def floor_from_s(self) -> float:
        """Time at which βe^{−αt} falls below the floor ε; infinite without a floor."""
        return floor_from_s(self.beta, self.alpha_per_s, self.floor)

    @property
    def inter_event_s(self) -> float | None:
        """Lower bound of the inter-event time; None if there is none."""
        found = [c.inter_event_s for c in (self.constants, self.floor_constants) if c is not None]
        known = [value for value in found if value is not None]
        return min(known) if known and len(known) == len(found) else None

    @property
    def unit(self) -> str:
        """The unit of Δ and β̃: β or ε; empty for 1."""
        if self.beta > 0 and self.beta >= self.floor:
            return "β"
        is_added = self.persistent_constants is not None
        decays = self.constants is not None and self.constants.rate_per_s > 0
        return "ε" if self.floor > 0 and not is_added and not decays else ""

    @property
    def level(self) -> str:
        """The unit of the error bounds at all times: βe^{−αt}; without decay β or ε."""
        rate = 0.0 if self.constants is None else self.constants.rate_per_s
        return f"{self.unit}e^(−{rate:.3g}t)" if rate else self.unit

    def sensor_error(self, t_s: Matrix) -> Matrix:
        """Bound of ‖e_s‖_W at times (k,); NaN without a certificate."""
        return self._envelope(t_s, lambda c, level: c.overshoot * level)

    def controller_error(self, t_s: Matrix) -> Matrix:
        """Bound of ‖e_c‖_W at times (k,); NaN without a certificate."""
        return self._envelope(t_s, lambda c, level: c.delta * level)

    def state(self, t_s: Matrix) -> Matrix:
        """Bound of ‖x‖ at times (k,); NaN without a certificate."""
        return self._envelope(t_s, lambda c, level: c.state)

    def estimation_error(self, t_s: Matrix) -> Matrix:
        """Bound of ‖x̂ − x‖_W at measurements (k,); NaN without a certificate."""
        return self._envelope(t_s, lambda c, level: c.estimation_error)

    def to_json(self) -> dict[str, Any]:
        """Return all fields for JSON."""
        constants, late, rest = self.constants, self.floor_constants, self.persistent_constants
        return asdict(self) | {
            "conditions": self.conditions._asdict()
            | {"constraints": [rule.name for rule in self.conditions.constraints]},
            "assumptions": [assumption._asdict() for assumption in self.assumptions],
            "constants": None if constants is None else constants._asdict(),
            "floor_constants": None if late is None else late._asdict(),
            "persistent_constants": None if rest is None else rest._asdict(),
            "other": None if self.other is None else self.other.to_json(),
            "inter_event_s": self.inter_event_s,
            "floor_from_s": None if self.floor == 0 else self.floor_from_s,
        }

    def _envelope(self, t_s: Matrix, scale: Callable[[Constants, float], float]) -> Matrix:
        if self.constants is None:
            return np.full(len(t_s), np.nan)
        level = max(self.beta, self.floor if self.constants.rate_per_s == 0 else 0.0)
        bound = scale(self.constants, level or 1.0) * np.exp(-self.constants.rate_per_s * t_s)
        if self.floor_constants is not None:
            late = scale(self.floor_constants, self.floor)
            bound = np.where(t_s < self.floor_from_s, bound, late)
        if self.persistent_constants is not None:
            bound = bound + scale(self.persistent_constants, 1.0)
        if self.other is not None:
            bound = np.minimum(bound, self.other._envelope(t_s, scale))
        return np.asarray(bound)


def floor_from_s(beta: float, alpha_per_s: float, floor: float) -> float:
    """Return the time at which βe^{−αt} falls below the floor; infinite without a floor."""
    if floor == 0:
        return math.inf
    return math.log(beta / floor) / alpha_per_s if beta > floor else 0.0


def envelope_formula(
    quantity: str,
    certificate: ScenarioCertificate,
    constant: Literal["delta", "overshoot", "state", "estimation_error"],
) -> str:
    """Return a certificate's bound of a quantity; ``{:.4g}`` stands for its first constant."""
    in_levels = constant in {"delta", "overshoot"}
    parts: list[str] = []
    one: ScenarioCertificate | None = certificate
    while one is not None and one.constants is not None:
        rate = one.constants.rate_per_s
        decay = f"e^(−{rate:.3g}t)" if rate else ""
        formula = f"{getattr(one.constants, constant):.4g}" if parts else "{:.4g}"
        formula += f" {level}" if (level := one.level if in_levels else decay) else ""
        if (late := one.floor_constants) is not None:
            unit = " ε" if in_levels else ""
            formula += f", from {one.floor_from_s:.4g} s on ≤ {getattr(late, constant):.4g}{unit}"
        if (rest := one.persistent_constants) is not None:
            formula += f" + {getattr(rest, constant):.4g}"
        parts.append(formula)
        one = one.other
    return f"{quantity} ≤ {' and ≤ '.join(parts)}"
