"""The chance of a loss burst longer than M − 1, and the mean burst, against independent computations."""

from itertools import groupby, product

import numpy as np
import pytest

from netem.impairments.burst_prediction import BurstPrediction, chance_text, predict_bursts
from netem.impairments.target_loss import loss_process
from netem.tc_words import settings_of


def predicted(words: str, caps: list[int], packets: int) -> BurstPrediction:
    return predict_bursts(loss_process(settings_of(words)), caps, packets)


def chance_by_counting(good_to_bad: float, bad_to_good: float, cap: int, packets: int) -> float:
    """Return the chance that one of n packets ends more than ``cap`` losses.

    Losses are the bad state; the chain begins in the good one.
    """
    run = np.zeros(cap + 1)  # probability of so many losses at the end, none longer so far
    run[0], run[1] = 1 - good_to_bad, good_to_bad
    for _ in range(packets - 1):
        following = np.zeros(cap + 1)
        following[0] = run[0] * (1 - good_to_bad) + run[1:].sum() * bad_to_good
        following[1] = run[0] * good_to_bad
        following[2:] = run[1:-1] * (1 - bad_to_good)
        run = following
    return float(1 - run.sum())


@pytest.mark.parametrize("packets", [1, 50, 600, 5000])
@pytest.mark.parametrize("cap", [1, 2, 7])
def test_the_chance_of_a_longer_burst_is_that_of_the_recursion(cap: int, packets: int) -> None:
    chance = predicted("loss 10%", [cap], packets).chance[cap]
    assert chance == pytest.approx(chance_by_counting(0.1, 0.9, cap, packets), abs=1e-12)
    # Bursts of 3 on average, 10 % of the packets: p = r·0.1/0.9 with r = 1/3.
    chance = predicted("loss burst 10% 3", [cap], packets).chance[cap]
    assert chance == pytest.approx(chance_by_counting(1 / 27, 1 / 3, cap, packets), abs=1e-9)


def test_the_chance_is_that_of_all_outcomes_of_a_few_packets() -> None:
    exact = sum(
        np.prod([0.3 if lost else 0.7 for lost in outcome])
        for outcome in product((False, True), repeat=10)
        if max((len([*run]) for lost, run in groupby(outcome) if lost), default=0) > 2
    )
    assert predicted("loss 30%", [2], 10).chance[2] == pytest.approx(exact, rel=1e-9)


def test_the_known_examples_and_the_mean_bursts() -> None:
    independent, bursty = predicted("loss 10%", [2], 600), predicted("loss burst 10% 2", [2], 600)
    assert chance_text(independent.chance[2]) == "41.7%"
    assert chance_text(bursty.chance[2]) == "99.96%"
    assert independent.mean_burst == pytest.approx(1 / 0.9)
    assert bursty.mean_burst == pytest.approx(2)
    # A cap does not matter: the question is how often it would be reached.
    assert predicted("loss 10% mansd 1", [2], 600) == independent
    assert predicted("loss 100%", [2], 600).mean_burst is None
    assert predicted("loss none", [2], 600) == BurstPrediction(600, None, {2: 0.0})


def test_chances_near_0_and_1_are_bounds() -> None:
    texts = [chance_text(chance) for chance in (0, 1e-9, 1e-4, 0.417, 0.9963, 0.999_99, 1)]
    assert texts == ["0%", "<0.001%", "0.01%", "41.7%", "99.6%", ">99.99%", "100%"]
