"""Losses whose rate is kept under the guarantee and the other impairments (``loss 30% keep``).

The probability is the smallest for which the predicted loss rate of the whole direction is the
asked one. Finding it may take seconds; a process that must not wait is told what another one found.
"""

import json
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from noack.impairments.feature import Impairment
from noack.impairments.kinds.loss import LossOf
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_models.bernoulli import BernoulliLoss
from noack.impairments.loss_prediction import LossPrediction, predict
from noack.impairments.markov_chain import NotPredictableError
from noack.impairments.quantities import brief_percent

_PARTS = 16
"""In so many parts of the possible probabilities the smallest one is searched."""
_TINY = 1e-12
_DIGITS = 12
"""The probability is rounded, so that every machine draws the same losses."""
_MOST_FOUND = 1000
_found: dict[str, float] = {}
"""Probabilities by :func:`_key`."""


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
    key = _key(settings)
    if key not in _found:
        remember({key: _probability(settings, places[0])})
    return _with_probability(settings, places[0], _found[key])


def found_probabilities(*links: LinkSettings) -> dict[str, float]:
    """Return the probabilities of valid settings, for :func:`remember`; none where none is kept."""
    keys = [_key(one) for one in links if with_kept_loss(one) is not one]
    return {key: _found[key] for key in keys}


def remember(found: Mapping[str, float]) -> Mapping[str, float]:
    """Use these probabilities, which another process found, instead of computing them."""
    while len(_found) > _MOST_FOUND:
        del _found[next(iter(_found))]
    _found.update(found)
    return found


def _key(settings: LinkSettings) -> str:
    """Return all that the prediction depends on."""
    parts = [one.text() for one in settings.impairments if _matters(one)]
    return json.dumps([parts, settings.mansd, *(one.text() for one in settings.constraints)])


def _matters(impairment: Impairment) -> bool:
    try:
        return not impairment.delays or bool(impairment.chains())
    except NotPredictableError:
        return True


def _with_probability(settings: LinkSettings, place: int, probability: float) -> LinkSettings:
    kept: Any = settings.impairments[place]
    loss = kept.loss.model_copy(update={"probability": probability, "keep": False})
    impairments = list(settings.impairments)
    impairments[place] = kept.model_copy(update={"loss": loss})
    return settings.model_copy(update={"impairments": tuple(impairments)})


def _probability(settings: LinkSettings, place: int) -> float:
    from scipy.optimize import brentq  # slow to import

    kept: Any = settings.impairments[place]
    text, target = kept.text(), kept.loss.probability

    def rate_at(probability: float, of: LinkSettings = settings) -> float:
        rate, note = predict(_with_probability(of, place, float(probability)))
        if rate is None:
            raise ValueError(f"{text}: the loss rate cannot be predicted: {note}")
        return rate

    # Without the guarantee, more packets are lost: all but (1 − p)(1 − others).
    others = rate_at(0.0, settings.model_copy(update={"mansd": None, "constraints": ()}))
    if others > target and (others := rate_at(0.0)) > target + _TINY:
        raise ValueError(
            f"{text}: impossible, the other impairments lose {brief_percent(others)} already"
        )
    least = 0.0 if others >= target else (target - others) / (1 - others)
    places = np.linspace(least, 1.0, _PARTS + 1)
    rates = [rate_at(least)]
    for low, high in pairwise(places):
        if rates[-1] >= target - _TINY:
            return round(float(low), _DIGITS)
        rates.append(rate_at(high))
        if rates[-1] > target + _TINY:
            found = brentq(lambda one: rate_at(one) - target, low, high, xtol=1e-13)
            return round(float(found), _DIGITS)
    if rates[-1] >= target - _TINY:
        return 1.0
    most = brief_percent(max(rates))
    raise ValueError(f"{text}: impossible with this guarantee, which allows at most {most}")
