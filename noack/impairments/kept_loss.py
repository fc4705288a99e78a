"""Losses whose rate is kept under the guarantee and the other impairments (``loss 30% keep``).

The probability is the smallest for which the predicted loss rate of the whole direction is the
asked one.
"""

from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np

from noack.impairments.kinds.loss import LossOf
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_models.bernoulli import BernoulliLoss
from noack.impairments.loss_prediction import LossPrediction, predict
from noack.impairments.quantities import brief_percent

_GRID = np.linspace(0.0, 1.0, 17)
_TINY = 1e-12
_DIGITS = 12
"""The probability is rounded, so that every machine draws the same losses."""


def expected_loss(settings: LinkSettings) -> LossPrediction:
    """Predict the loss rate of a direction, see :func:`predict`; a kept one is as asked.

    Raises:
        ValueError: a loss rate cannot be kept.
    """
    return predict(with_kept_loss(settings))


def with_kept_loss(settings: LinkSettings) -> LinkSettings:
    """Return settings with the probability that gives the asked loss rate.

    Raises:
        ValueError: there is none; one line.
    """
    places = [
        place
        for place, one in enumerate(settings.impairments)
        if isinstance(one, LossOf) and isinstance(one.loss, BernoulliLoss) and one.loss.keep
    ]
    if not places:
        return settings
    if len(places) > 1:
        kept = settings.impairments[places[0]].text()
        raise ValueError(f"{kept}: only one loss of a direction can be kept")
    return _with_probability(settings, places[0], _probability(settings, places[0]))


def _with_probability(settings: LinkSettings, place: int, probability: float) -> LinkSettings:
    kept: Any = settings.impairments[place]
    loss = kept.loss.model_copy(update={"probability": probability, "keep": False})
    impairments = list(settings.impairments)
    impairments[place] = kept.model_copy(update={"loss": loss})
    return settings.model_copy(update={"impairments": tuple(impairments)})


@lru_cache(maxsize=64)
def _probability(settings: LinkSettings, place: int) -> float:
    from scipy.optimize import brentq  # slow to import

    kept: Any = settings.impairments[place]
    text, target = kept.text(), kept.loss.probability

    def surplus(probability: float) -> float:
        rate, note = predict(_with_probability(settings, place, float(probability)))
        if rate is None:
            raise ValueError(f"{text}: the loss rate cannot be predicted: {note}")
        return float(rate - target)

    rates = [surplus(0.0)]
    if rates[0] > _TINY:
        others = brief_percent(rates[0] + target)
        raise ValueError(f"{text}: impossible, the other impairments lose {others} already")
    for low, high in pairwise(_GRID):
        rates.append(surplus(high))
        if rates[-1] >= -_TINY:
            found = high if rates[-1] <= _TINY else brentq(surplus, low, high, xtol=1e-13)
            return round(float(found), _DIGITS)
    most = brief_percent(max(rates) + target)
    raise ValueError(f"{text}: impossible with this guarantee, which allows at most {most}")
