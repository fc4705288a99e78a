"""Dynamic triggering: what the relative rule would have saved may be spent later.

    η̇ = −λη + w,   w = σ xᵀQx − 2 xᵀPBK e_s,   transmit when η + θw ≤ 0

with AᵀP+PA = −Q of the closed loop A = Â+B̂K (Girard, IEEE TAC 60(7), 2015). θ = 0 transmits when
η is used up; θ → ∞ is the static rule w < 0, which ensures V̇ ≤ −(1−σ) xᵀQx where every update
arrives. Events are never earlier than those of the static rule from the same state on. When
updates are lost, the same holds as of the relative rule.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from noack.core.linear_systems import Matrix
from noack.trigger.trigger_condition import DynamicVariable, QuadraticForm, quadratic_form
from noack.trigger.trigger_rule import TriggerRule


@dataclass(frozen=True)
class DynamicTrigger:
    """The dynamic rule.

    Args:
        sigma: σ in (0, 1).
        theta_s: θ ≥ 0, in seconds.
        decay_per_s: λ ≥ 0.
        P: of the Lyapunov function, (n, n).
        Q: its decrease, (n, n).
        BK: B̂K, (n, n).
        initial_dynamic_variable: η at the start, ≥ 0.
        weight: only for showing errors.
    """

    sigma: float
    theta_s: float
    decay_per_s: float
    P: Matrix
    Q: Matrix
    BK: Matrix
    initial_dynamic_variable: float = 0.0
    weight: Matrix | None = None

    @cached_property
    def _forms(self) -> tuple[QuadraticForm, QuadraticForm]:
        """−θw and w."""
        n, cross = len(self.P), self.P @ self.BK
        w = np.zeros((2 * n, 2 * n))
        w[:n, :n] = self.sigma * self.Q
        w[:n, n:] = -cross
        w[n:, :n] = -cross.T
        return quadratic_form(-self.theta_s * w), quadratic_form(w)

    def trigger_rule(self, n: int) -> TriggerRule:
        """The same after every event; η goes on."""
        spent, gained = self._forms
        return TriggerRule(spent, dynamic_variable=DynamicVariable(self.decay_per_s, gained))
