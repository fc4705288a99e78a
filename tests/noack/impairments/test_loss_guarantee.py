"""The rules of a guarantee against all sequences of outcomes, enumerated and judged by windows."""

from itertools import groupby, product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from noack.impairments.loss_guarantee import (
    DeliveriesBetweenBursts,
    LongestBurst,
    LossAutomaton,
    LossesInWindow,
    LossGuarantee,
    LossHistory,
    LossRule,
)

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
