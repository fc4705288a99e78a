"""Transmit when the sensor error is large relative to the state: ‖e_s‖_W² > σ²‖x‖_W² + ε².

ε = 0 is the relative rule (Tabuada, IEEE TAC 52(9), 2007): where every update arrives, and σ is
small enough, the loop is asymptotically stable and the minimum inter-event time positive. When
updates are lost, e_c no longer follows e_s: a small state then does not mean a small e_c, and
events may accumulate near the origin. σ = 0 is send-on-delta. With ε > 0 stability is practical,
and the minimum inter-event time positive for bounded states.
"""

from typing import ClassVar, Literal

import numpy as np

from noack.core.linear_systems import Matrix
from noack.trigger_policies.policy_settings import ModelMatrices, Ratio, Size, WeightedSettings
from noack.trigger_policies.trigger_rule import QuadraticForm, TriggerRule, error_map, state_map


class MixedSettings(WeightedSettings):
    """Transmit when ‖e_s‖_W² > σ²‖x‖_W² + ε²."""

    example_keys: ClassVar = {"sigma": 0.1, "epsilon": 0.05}

    policy: Literal["mixed"]
    sigma: Ratio
    """σ."""
    epsilon: Size
    """ε, in the units of ‖W x‖."""

    def trigger_policy(self, model: ModelMatrices) -> TriggerRule:
        return mixed_rule(len(model.A), self.sigma, self.epsilon, self.weight_matrix)

    @property
    def description(self) -> str:
        return f"‖e_s‖² > {self.sigma:g}² ‖x‖² + {self.epsilon:g}²"


def mixed_rule(n: int, sigma: float, epsilon: float, weight: Matrix | None) -> TriggerRule:
    """Return the rule for n states; σ > 0 without a unit, ε ≥ 0 in the units of ‖W x‖."""
    negative = np.asarray(sigma * state_map(n, weight))
    return TriggerRule(QuadraticForm(error_map(n, weight), negative), floor=epsilon, weight=weight)
