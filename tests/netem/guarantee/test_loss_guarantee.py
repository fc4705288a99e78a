"""The rules of a guarantee: what they allow, and what they imply.

That links keep them is in tests/netem/impairments/test_mansd.py.
"""

from itertools import groupby, product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem.guarantee.loss_guarantee import (
    DeliveriesBetweenBursts,
    LongestBurst,
    LossAutomaton,
    LossesInWindow,
    LossGuarantee,
    LossHistory,
    LossRule,
    find_counterexample,
)

SEQUENCE_LENGTH = 11

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
    sequences = np.array(list(product([False, True], repeat=SEQUENCE_LENGTH)))
    states, allowed = np.zeros(len(sequences), np.int64), np.ones(len(sequences), bool)
    for lost in sequences.T:
        after_loss = automaton.after_loss(states)
        allowed &= ~lost | (after_loss >= 0)
        states = np.where(lost & (after_loss >= 0), after_loss, automaton.after_delivery(states))
    expected = [all(keeps(tuple(sequence), rule) for rule in rules) for sequence in sequences.tolist()]
    assert allowed.tolist() == expected


@given(st.lists(st.booleans(), max_size=30), st.sampled_from(GUARANTEES))
def test_a_history_finds_the_first_violation_of_each_rule(
    lost: list[bool], rules: tuple[LossRule, ...]
) -> None:
    history, first = LossHistory(rules), dict.fromkeys(rules, len(lost))
    for i, is_lost in enumerate(lost):
        for rule, _ in history.add(is_lost):
            first[rule] = min(first[rule], i)
    for rule, at in first.items():
        assert keeps(tuple(lost[:at]), rule)
        assert at == len(lost) or not keeps(tuple(lost[: at + 1]), rule)


def guarantee(*rules: LossRule) -> LossGuarantee:
    return LossGuarantee(rules)


def allows(rules: LossGuarantee, delivered: tuple[bool, ...]) -> bool:
    history = LossHistory(rules.rules)
    return not any(history.add(not outcome) for outcome in delivered)


def random_guarantee(rng: np.random.Generator) -> LossGuarantee:
    rules: list[LossRule] = [LongestBurst(int(rng.integers(1, 5)))]
    if rng.random() < 0.6:
        window = int(rng.integers(2, 8))
        rules.append(LossesInWindow(int(rng.integers(1, window + 1)), window))
    if rng.random() < 0.5:
        rules.append(DeliveriesBetweenBursts(int(rng.integers(1, 5))))
    return LossGuarantee(tuple(rules[int(len(rules) > 1 and rng.random() < 0.3) :]))


def test_a_guarantee_implies_another_if_no_pattern_keeps_only_the_first() -> None:
    rng, longest, implied = np.random.default_rng(0), 9, 0
    patterns = [pattern for k in range(longest + 1) for pattern in product((True, False), repeat=k)]
    for _ in range(60):
        known, other = random_guarantee(rng), random_guarantee(rng)
        beyond = (p for p in patterns if allows(known, p) and not allows(other, p))
        shortest, pattern = next(beyond, None), find_counterexample(known, other)
        if pattern is None:
            implied += 1
            assert shortest is None
        else:
            assert allows(known, pattern)
            assert not allows(other, pattern)
            assert allows(other, pattern[:-1])
            assert len(pattern) > longest if shortest is None else len(pattern) == len(shortest)
    assert 5 < implied < 55


def test_one_window_implies_another_as_the_closed_form_says() -> None:
    """At most m in K allow at most m ⌊k/K⌋ + min(m, k mod K) losses in k packets."""
    for (window, other), losses in product(product(range(2, 6), range(1, 10)), range(3)):
        most = losses * (other // window) + min(losses, other % window)
        for limit in range(other):
            known = guarantee(LossesInWindow(losses, window))
            implied = find_counterexample(known, guarantee(LossesInWindow(limit, other))) is None
            assert implied == (limit >= min(most, other)) or losses >= window
