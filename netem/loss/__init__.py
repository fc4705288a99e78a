"""Loss models: each says of every datagram whether it would be lost, before the MANSD cap.

One model per file. A model's settings are a section of the scenario; the objects here hold the
state of one flow, with its own random stream.
"""

from typing import Protocol

import numpy as np

from netem.loss.bernoulli import BernoulliLoss
from netem.loss.gilbert_elliott import GilbertElliottLoss
from netem.loss.worst_case import WorstCaseLoss
from noack.scenario import Bernoulli, GilbertElliott, Loss, Lossless, WorstCase


class LossModel(Protocol):
    """The loss process of one flow."""

    def lost(self) -> bool:
        """Whether the flow's next datagram would be lost."""
        ...


def loss_model(settings: Loss, rng: np.random.Generator) -> LossModel:
    """Return a flow's loss model with the given settings and random stream."""
    match settings:
        case Lossless():
            return BernoulliLoss(0.0, rng)
        case Bernoulli():
            return BernoulliLoss(settings.probability, rng)
        case GilbertElliott():
            return GilbertElliottLoss(
                settings.good_to_bad,
                settings.bad_to_good,
                settings.loss_in_good,
                settings.loss_in_bad,
                rng,
            )
        case WorstCase():
            return WorstCaseLoss()
