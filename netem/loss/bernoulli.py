"""Independent losses: each datagram is lost with probability p."""

import numpy as np


class BernoulliLoss:
    """Loss with probability ``probability``, independent of the past."""

    def __init__(self, probability: float, rng: np.random.Generator) -> None:
        self._probability = probability
        self._rng = rng

    def lost(self) -> bool:
        """Whether the next datagram would be lost."""
        return bool(self._rng.random() < self._probability)
