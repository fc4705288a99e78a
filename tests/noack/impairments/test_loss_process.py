"""Probabilities of loss patterns against sums over all patterns, and against closed forms."""

from itertools import product

import pytest

from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_guarantee import (
    DeliveriesBetweenBursts,
    LongestBurst,
    LossesInWindow,
    LossGuarantee,
    LossHistory,
)
from noack.impairments.loss_prediction import LossProcess, loss_process
from noack.impairments.markov_chain import NotPredictableError

P = 0.3
INDEPENDENT = {"kind": "loss", "loss": {"model": "bernoulli", "probability": P}}
BURSTY = {
    "kind": "loss",
    "loss": {
        "model": "gilbert_elliott", "good_to_bad": 0.2, "bad_to_good": 0.4,
        "loss_in_good": 0.1, "loss_in_bad": 0.9,
    },
}  # fmt: skip
GUARANTEES = [
    LossGuarantee((LongestBurst(2),)),
    LossGuarantee((LongestBurst(3), LossesInWindow(3, 6))),
    LossGuarantee((LongestBurst(2), DeliveriesBetweenBursts(2))),
]


def process(*impairments: dict[str, object], first: bool = False) -> LossProcess:
    return loss_process(
        LinkSettings.model_validate({"impairments": impairments, "first_delivered": first})
    )


def probability(losses: LossProcess, outcomes: tuple[bool, ...]) -> float:
    """The probability of these outcomes (True: lost), following every state of the chain."""
    weights = losses.start
    for number, lost in enumerate(outcomes):
        weights = weights @ losses.moves
        forced = number == 0 and losses.first_delivered
        weights = weights * (
            float(not lost) if forced else losses.lost if lost else 1 - losses.lost
        )
    return float(weights.sum())


def is_kept(guarantee: LossGuarantee, outcomes: tuple[bool, ...]) -> bool:
    history = LossHistory(guarantee.rules)
    return not any(history.add(lost) for lost in outcomes)


@pytest.mark.parametrize("first", [False, True])
@pytest.mark.parametrize("guarantee", GUARANTEES, ids=lambda one: one.meaning)
@pytest.mark.parametrize("impairments", [[INDEPENDENT], [BURSTY], [BURSTY, INDEPENDENT]])
def test_a_guarantee_is_kept_with_the_total_probability_of_all_patterns_that_keep_it(
    impairments: list[dict[str, object]], guarantee: LossGuarantee, first: bool
) -> None:
    losses = process(*impairments, first=first)
    patterns = list(product([False, True], repeat=8))
    expected = sum(probability(losses, one) for one in patterns if is_kept(guarantee, one))
    assert losses.keeps(guarantee, 8) == pytest.approx(expected, rel=1e-9)


def test_tails_of_bursts_cover_every_packet_and_the_largest_probability_every_past() -> None:
    losses = process(BURSTY)
    assert not losses.is_independent
    tails, longest = losses.tails(4)
    for j in range(1, 5):
        for k in range(j, 9):
            ends = [one for one in product([False, True], repeat=k) if all(one[k - j :])]
            assert sum(probability(losses, one) for one in ends) <= tails[j - 1] * (1 + 1e-9)
    for past in product([False, True], repeat=5):
        given = probability(losses, (*past, True)) / probability(losses, past)
        assert given <= losses.largest_probability * (1 + 1e-9)
        all_lost = probability(losses, (*past, *[True] * 4)) / probability(losses, past)
        assert all_lost <= longest * (1 + 1e-9)


def test_losses_that_depend_on_times_are_refused() -> None:
    with pytest.raises(NotPredictableError):
        process(INDEPENDENT, {"kind": "delay", "delay_s": 0.1, "jitter_s": 0.05})
