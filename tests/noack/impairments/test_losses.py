"""Rules of a guarantee and probabilities of losses, against all sequences of outcomes."""

from itertools import groupby, product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_guarantee import (
    DeliveriesBetweenBursts,
    LongestBurst,
    LossAutomaton,
    LossesInWindow,
    LossGuarantee,
    LossHistory,
    LossRule,
)
from noack.impairments.loss_prediction import LossProcess, loss_process
from noack.impairments.markov_chain import NotPredictableError

LENGTH = 11

GUARANTEES = [
    (LongestBurst(0),),
    (LongestBurst(3),),
    (LossesInWindow(1, 2),),
    (LossesInWindow(2, 5),),
    (LossesInWindow(3, 4), LossesInWindow(4, 9)),
    (LongestBurst(2), DeliveriesBetweenBursts(3)),
    (LossesInWindow(3, 7), DeliveriesBetweenBursts(2), LongestBurst(2)),
]


def keeps(lost: tuple[bool, ...], rule: LossRule) -> bool:
    """Judge a whole sequence, from the definition."""
    runs = [(value, len(list(run))) for value, run in groupby(lost)]
    if isinstance(rule, LongestBurst):
        return all(length <= rule.limit for value, length in runs if value)
    if isinstance(rule, LossesInWindow):
        ends = range(1, len(lost) + 1)
        return all(sum(lost[max(i - rule.window, 0) : i]) <= rule.limit for i in ends)
    assert isinstance(rule, DeliveriesBetweenBursts)
    return all(length >= rule.deliveries for value, length in runs[1:-1] if not value)


@pytest.mark.parametrize("rules", GUARANTEES, ids=str)
def test_the_automaton_allows_exactly_the_sequences_that_keep_every_rule(
    rules: tuple[LossRule, ...],
) -> None:
    automaton = LossAutomaton(LossGuarantee(rules))
    sequences = np.array(list(product([False, True], repeat=LENGTH)))
    states, allowed = np.zeros(len(sequences), np.int64), np.ones(len(sequences), bool)
    for lost in sequences.T:
        after_loss = automaton.after_loss(states)
        allowed &= ~lost | (after_loss >= 0)
        states = np.where(lost & (after_loss >= 0), after_loss, automaton.after_delivery(states))
    expected = [all(keeps(tuple(one), rule) for rule in rules) for one in sequences.tolist()]
    assert allowed.tolist() == expected


@given(st.lists(st.booleans(), max_size=30), st.sampled_from(GUARANTEES))
def test_a_history_finds_the_first_violation_of_each_rule(
    lost: list[bool], rules: tuple[LossRule, ...]
) -> None:
    history, first = LossHistory(rules), dict.fromkeys(rules, len(lost))
    for i, one in enumerate(lost):
        for rule, _ in history.add(one):
            first[rule] = min(first[rule], i)
    for rule, at in first.items():
        assert keeps(tuple(lost[:at]), rule)
        assert at == len(lost) or not keeps(tuple(lost[: at + 1]), rule)


# --- probabilities --------------------------------------------------------------------------------

P = 0.3
INDEPENDENT = {"kind": "loss", "loss": {"model": "bernoulli", "probability": P}}
BURSTY = {
    "kind": "loss",
    "loss": {
        "model": "gilbert_elliott", "good_to_bad": 0.2, "bad_to_good": 0.4,
        "loss_in_good": 0.1, "loss_in_bad": 0.9,
    },
}  # fmt: skip
KEPT = [
    LossGuarantee((LongestBurst(2),)),
    LossGuarantee((LongestBurst(3), LossesInWindow(3, 6))),
    LossGuarantee((LongestBurst(2), DeliveriesBetweenBursts(2))),
]


def process(*impairments: dict[str, object], first: bool = False) -> LossProcess:
    return loss_process(LinkSettings.model_validate({"impairments": impairments, "first_delivered": first}))


def probability(losses: LossProcess, outcomes: tuple[bool, ...]) -> float:
    """The probability of these outcomes (True: lost), following every state of the chain."""
    weights = losses.start
    for number, lost in enumerate(outcomes):
        weights = weights @ losses.moves
        forced = number == 0 and losses.first_delivered
        weights = weights * (float(not lost) if forced else losses.lost if lost else 1 - losses.lost)
    return float(weights.sum())


def is_kept(guarantee: LossGuarantee, outcomes: tuple[bool, ...]) -> bool:
    history = LossHistory(guarantee.rules)
    return not any(history.add(lost) for lost in outcomes)


@pytest.mark.parametrize("first", [False, True])
@pytest.mark.parametrize("guarantee", KEPT, ids=lambda one: one.meaning)
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
