"""Loss rates that are asked for, and the probabilities that give them."""

import json

import pytest

from netem.impairments.kinds.loss import LossOf
from netem.impairments.link_settings import LinkSettings
from netem.impairments.loss_models.bernoulli import BernoulliLoss
from netem.impairments.loss_prediction import predict
from netem.impairments.target_loss import (
    ProbabilityCache,
    expected_loss,
    known_probabilities,
    store_probabilities,
    with_target_loss,
)
from netem.tc_words import settings_of


@pytest.mark.parametrize(
    ("words", "rate"),
    [
        ("loss 30% keep mansd 2", 0.3),
        ("loss 80% keep mansd 4", 0.8),
        ("loss 30% keep atmost 3 in 10", 0.3),
        ("loss 25% 50% keep mansd 3 corrupt 5% duplicate 10%", 0.25),
        ("loss 40% keep loss burst 10% 3 mansd 4 atmost 6 in 9", 0.4),
    ],
)
def test_a_target_loss_is_predicted(words: str, rate: float) -> None:
    asking = settings_of(words)
    assert predict(with_target_loss(asking)).rate == pytest.approx(rate, abs=1e-9)
    assert expected_loss(asking).rate == pytest.approx(rate, abs=1e-9)


def probability(settings: LinkSettings, known: ProbabilityCache) -> float:
    first = with_target_loss(settings, known=known).impairments[0]
    assert isinstance(first, LossOf)
    assert isinstance(first.loss, BernoulliLoss)
    return first.loss.probability


def test_a_probability_that_another_process_found_is_not_computed_again() -> None:
    """Not even by the loops of a run; but other settings have another probability."""
    settings = settings_of("loss 10% keep loss 5% mansd 1 delay 1ms")
    there, here = ProbabilityCache(10), ProbabilityCache(10)
    computed = probability(settings, there)
    found = known_probabilities(settings, settings_of("delay 1ms"), known=there)
    assert list(found.values()) == [computed]
    received = 0.123  # no computation gives this
    store_probabilities(json.loads(json.dumps(dict.fromkeys(found, received))), known=here)
    assert probability(settings, here) == received
    assert probability(settings_of("loss 10% keep loss 5% delay 9ms mansd 1"), here) == received
    for other in ("loss 10% keep loss 5% mansd 2", "loss 10% keep mansd 1"):
        assert probability(settings_of(other), here) != received
