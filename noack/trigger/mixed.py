"""Transmit when the sensor error is large relative to the state: ‖e_s‖_W² > σ²‖x‖_W² + ε².

ε = 0 is the relative rule (Tabuada, IEEE TAC 52(9), 2007): where every update arrives, and σ is
small enough, the loop is asymptotically stable and the minimum inter-event time positive. When
updates are lost, e_c no longer follows e_s: a small state then does not mean a small e_c, and
events may accumulate near the origin. σ = 0 is send-on-delta. With ε > 0 stability is practical,
and the minimum inter-event time positive for bounded states.
"""

from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from noack.core.linear_systems import Matrix
from noack.trigger.policy_settings import ModelMatrices, Share, Size, WeightedSettings
from noack.trigger.trigger_rule import QuadraticForm, TriggerRule, error_map, state_map


class MixedSettings(WeightedSettings):
    """Transmit when ‖e_s‖_W² > σ²‖x‖_W² + ε²."""

    policy: Literal["mixed"]
    sigma: Share
    """σ."""
    epsilon: Size
    """ε, in the units of ‖W x‖."""

    @classmethod
    def example(cls, n: int) -> Self:
        return cls(policy="mixed", sigma=0.1, epsilon=0.05)

    def trigger_policy(self, model: ModelMatrices) -> "MixedTrigger":
        return MixedTrigger(self.sigma, self.epsilon, self.weight_matrix)

    @property
    def description(self) -> str:
        return f"‖e_s‖² > {self.sigma:g}² ‖x‖² + {self.epsilon:g}²"

    @property
    def largest_threshold(self) -> float:
        return self.epsilon

    @property
    def least_threshold(self) -> float:
        return self.epsilon


@dataclass(frozen=True)
class MixedTrigger:
    """The mixed rule; σ > 0 without a unit, ε ≥ 0 in the units of ‖W x‖."""

    sigma: float
    epsilon: float = 0.0
    weight: Matrix | None = None
    initial_dynamic_variable = 0.0

    def trigger_rule(self, n: int) -> TriggerRule:
        down: Matrix = self.sigma * state_map(n, self.weight)
        return TriggerRule(
            QuadraticForm(error_map(n, self.weight), np.asarray(down)), floor=self.epsilon
        )
