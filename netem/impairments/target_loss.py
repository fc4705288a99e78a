"""Loss rates that are asked for: the probability of a loss that gives one.

``loss 30% keep`` asks for a loss rate under the guarantee and the other impairments (the target
loss rate). :func:`with_target_loss` finds the smallest probability for which the predicted rate of
the whole direction is the target. That may take seconds; a process that must not wait receives what
another one computed (:func:`store_probabilities`). What needs such settings is here, too: files are
read (:func:`read_files`), the losses of a direction are predicted (:func:`expected_loss`,
:func:`loss_process`).
"""

import json
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from netem.core.errors import CallerError
from netem.impairments.feature import Impairment
from netem.impairments.kinds.loss import LossOf
from netem.impairments.link_settings import LinkSettings
from netem.impairments.loss_models.bernoulli import BernoulliLoss
from netem.impairments.loss_prediction import (
    LossPrediction,
    LossProcess,
    joint_chain,
    order_and_notes,
    predict,
)
from netem.impairments.markov_chain import NotPredictableError, require_scipy
from netem.impairments.words import brief_percent

_PARTS = 16
"""Number of parts of the range of probabilities that are searched."""
_TINY = 1e-12
"""Tolerance of a loss rate that is met."""
_DIGITS = 12
"""The probability is rounded, so that every machine draws the same losses."""


class ProbabilityCache:
    """The newest probabilities that have been found, by all that the predicted loss rate depends on."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._probabilities = dict[str, float]()

    def __contains__(self, key: str) -> bool:
        return key in self._probabilities

    def __getitem__(self, key: str) -> float:
        return self._probabilities[key]

    def add(self, probabilities: Mapping[str, float]) -> None:
        """Add some as the newest; the oldest ones are removed."""
        kept = {key: value for key, value in self._probabilities.items() if key not in probabilities}
        self._probabilities = dict([*kept.items(), *probabilities.items()][-self._most :])


PROBABILITIES = ProbabilityCache(1000)
"""Those of this process: a run descriptor is validated where no cache can be passed."""


class _TargetLoss(NamedTuple):
    """A loss of which the rate is given, not the probability."""

    number: int
    impairment: LossOf
    loss: BernoulliLoss


def _target_losses(settings: LinkSettings) -> list[_TargetLoss]:
    """Return the losses of which the rate is given; valid settings have at most one."""
    return [
        _TargetLoss(number, impairment, impairment.loss)
        for number, impairment in enumerate(settings.impairments)
        if isinstance(impairment, LossOf)
        and isinstance(impairment.loss, BernoulliLoss)
        and impairment.loss.keep
    ]


def number_of_target_loss(settings: LinkSettings) -> int:
    """Return the number of the impairment with the first of them; 0 if there is none."""
    return next((target.number for target in _target_losses(settings)), 0)


def with_target_loss(settings: LinkSettings, *, known: ProbabilityCache = PROBABILITIES) -> LinkSettings:
    """Return settings with the probability that gives the asked loss rate; it is kept in ``known``.

    Raises:
        ValueError: there is none; one line.
    """
    target_losses = _target_losses(settings)
    if not target_losses:
        return settings
    target_loss = target_losses[0]
    if len(target_losses) > 1:
        raise ValueError(f"{target_loss.impairment.text()}: only one loss of a direction can be kept")
    key = _key(settings)
    if key not in known:
        known.add({key: _probability(settings, target_loss)})
    return _with_probability(settings, target_loss, known[key])


def known_probabilities(*links: LinkSettings, known: ProbabilityCache = PROBABILITIES) -> dict[str, float]:
    """Return the probabilities that the check of these settings has found, for :func:`store_probabilities`.

    There is none where no loss rate is kept.
    """
    keys = [_key(link) for link in links if _target_losses(link)]
    return {key: known[key] for key in keys if key in known}


def store_probabilities(
    probabilities: Mapping[str, float], *, known: ProbabilityCache = PROBABILITIES
) -> Mapping[str, float]:
    """Use these probabilities, which another process found, instead of computing them."""
    known.add(probabilities)
    return probabilities


def _key(settings: LinkSettings) -> str:
    """Return all that the prediction depends on."""
    parts = [impairment.text() for impairment in settings.impairments if _matters(impairment)]
    return json.dumps([parts, settings.mansd, *(constraint.text() for constraint in settings.constraints)])


def _matters(impairment: Impairment) -> bool:
    try:
        return not impairment.delays or bool(impairment.chains())
    except NotPredictableError:
        return True


def _with_probability(settings: LinkSettings, target_loss: _TargetLoss, probability: float) -> LinkSettings:
    loss = target_loss.loss.model_copy(update={"probability": probability, "keep": False})
    impairments: list[Impairment] = list(settings.impairments)
    impairments[target_loss.number] = target_loss.impairment.model_copy(update={"loss": loss})
    return settings.model_copy(update={"impairments": tuple(impairments)})


def _probability(settings: LinkSettings, target_loss: _TargetLoss) -> float:
    text, target = target_loss.impairment.text(), target_loss.loss.probability
    try:
        require_scipy()
    except NotPredictableError as error:
        raise ValueError(f"{text}: {error}") from None
    from scipy.optimize import brentq  # slow to import

    def rate_at(probability: float, link_settings: LinkSettings = settings) -> float:
        rate, note = predict(_with_probability(link_settings, target_loss, float(probability)))
        if rate is None:
            raise ValueError(f"{text}: the loss rate cannot be predicted: {note}")
        return rate

    # Without the guarantee, more packets are lost: all but (1 − p)(1 − base_rate).
    base_rate = rate_at(0.0, settings.model_copy(update={"mansd": None, "constraints": ()}))
    if base_rate > target and (base_rate := rate_at(0.0)) > target + _TINY:
        raise ValueError(f"{text}: impossible, the other impairments lose {brief_percent(base_rate)} already")
    least = 0.0 if base_rate >= target else (target - base_rate) / (1 - base_rate)
    probabilities = np.linspace(least, 1.0, _PARTS + 1)
    rates = [rate_at(least)]
    for low, high in pairwise(probabilities):
        if rates[-1] >= target - _TINY:
            return round(float(low), _DIGITS)
        rates.append(rate_at(high))
        if rates[-1] > target + _TINY:
            root = brentq(lambda probability: rate_at(probability) - target, low, high, xtol=1e-13)
            return round(float(root), _DIGITS)
    if rates[-1] >= target - _TINY:
        return 1.0
    most = brief_percent(max(rates))
    raise ValueError(f"{text}: impossible with this guarantee, which allows at most {most}")


def read_files(settings: LinkSettings, folder: Path, place: str = "") -> LinkSettings:
    """Return settings with the files' contents instead of their names.

    Args:
        settings: settings of one direction of a link.
        folder: folder to which relative names refer.
        place: as in :meth:`netem.impairments.feature.StageFeature.without_files`.

    Raises:
        CallerError: one line; a file cannot be read, or has wrong content; or a loss rate cannot
            be kept.
    """
    impairments = tuple(
        impairment.without_files(folder, f"{place}.impairments.{number}" if place else "")
        for number, impairment in enumerate(settings.impairments)
    )
    read = settings.model_copy(update={"impairments": impairments})
    try:
        with_target_loss(read)
    except ValueError as error:
        raise CallerError(f"{place}: {error}" if place else str(error)) from None
    return read


def loss_process(settings: LinkSettings) -> LossProcess:
    """Return the losses of a link's direction without its guarantee.

    A loss rate that is kept becomes the probability with which the emulator drops packets.

    Raises:
        NotPredictableError: they cannot be computed; the message is the reason.
    """
    order, notes = order_and_notes(settings)
    if notes:
        raise NotPredictableError(f"the losses are known only {notes[0]}")
    if order.reordered:
        raise NotPredictableError("packets may arrive out of order, which counts as a loss")
    try:
        start, transitions, lost = joint_chain(with_target_loss(settings))
    except ValueError as error:  # the loss rate cannot be kept
        raise NotPredictableError(str(error)) from None
    return LossProcess(start, transitions, lost, settings.first_delivered)


def expected_loss(settings: LinkSettings) -> LossPrediction:
    """Predict the loss rate of a direction, see :func:`predict`; a kept one is as asked.

    Raises:
        ValueError: a loss rate cannot be kept.
    """
    return predict(with_target_loss(settings))
