"""The relative rule: transmit when ‖e_s‖_W > σ‖x‖_W (Tabuada, IEEE TAC 52(9), 2007).

The mixed rule without its constant; see :mod:`noack.trigger.mixed`.
"""

from noack.core.linear_systems import Matrix
from noack.trigger.mixed import MixedTrigger


def relative_trigger(sigma: float, weight: Matrix | None = None) -> MixedTrigger:
    """Return the relative rule; σ > 0 without a unit."""
    return MixedTrigger(sigma, 0.0, weight)
