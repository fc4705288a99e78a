"""Bursty losses: a two-state Markov chain (Gilbert, 1960; Elliott, 1963).

The chain starts in the good state and may change its state before each datagram: good → bad with
probability p, bad → good with probability r. A datagram is lost with probability 1 − k in the good
state and 1 − h in the bad. In the stationary chain the loss rate is

    (1 − k) r/(p + r) + (1 − h) p/(p + r).
"""

import numpy as np


class GilbertElliottLoss:
    """Loss in bursts.

    Args:
        good_to_bad: p.
        bad_to_good: r.
        loss_in_good: 1 − k.
        loss_in_bad: 1 − h.
        rng: the flow's random stream; two numbers are drawn per datagram.
    """

    def __init__(
        self,
        good_to_bad: float,
        bad_to_good: float,
        loss_in_good: float,
        loss_in_bad: float,
        rng: np.random.Generator,
    ) -> None:
        self._good_to_bad = good_to_bad
        self._bad_to_good = bad_to_good
        self._loss_in_good = loss_in_good
        self._loss_in_bad = loss_in_bad
        self._rng = rng
        self._bad = False

    def lost(self) -> bool:
        """Whether the next datagram would be lost."""
        if self._rng.random() < (self._bad_to_good if self._bad else self._good_to_bad):
            self._bad = not self._bad
        return bool(self._rng.random() < (self._loss_in_bad if self._bad else self._loss_in_good))
