"""The relative rule: transmit when ‖e_s‖_W > σ‖x‖_W (Tabuada, IEEE TAC 52(9), 2007).

The mixed rule without its constant; see :mod:`noack.trigger.mixed`.
"""

from typing import Literal, Self

from noack.core.linear_systems import Matrix
from noack.trigger.mixed import MixedTrigger
from noack.trigger.policy_settings import ModelMatrices, Share, WeightedSettings


class RelativeSettings(WeightedSettings):
    """Transmit when ‖e_s‖_W > σ‖x‖_W (Tabuada 2007)."""

    policy: Literal["relative"]
    sigma: Share
    """σ."""

    @classmethod
    def example(cls, n: int) -> Self:
        return cls(policy="relative", sigma=0.2)

    def trigger_policy(self, model: ModelMatrices) -> MixedTrigger:
        return relative_trigger(self.sigma, self.weight_matrix)

    @property
    def description(self) -> str:
        return f"‖e_s‖ > {self.sigma:g} ‖x‖"

    @property
    def least_threshold(self) -> float:
        return 0.0


def relative_trigger(sigma: float, weight: Matrix | None = None) -> MixedTrigger:
    """Return the relative rule; σ > 0 without a unit."""
    return MixedTrigger(sigma, 0.0, weight)
