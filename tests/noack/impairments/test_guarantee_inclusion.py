"""Whether a guarantee implies another, against all patterns and the closed form of windows."""

from itertools import product

import numpy as np

from noack.impairments.loss_guarantee import (
    DeliveriesBetweenBursts,
    LongestBurst,
    LossesInWindow,
    LossGuarantee,
    LossHistory,
    LossRule,
    find_pattern_beyond,
)


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


def test_implications_are_those_of_all_patterns() -> None:
    rng, longest, implied = np.random.default_rng(0), 9, 0
    patterns = [one for k in range(longest + 1) for one in product((True, False), repeat=k)]
    for _ in range(60):
        one, other = random_guarantee(rng), random_guarantee(rng)
        beyond = (p for p in patterns if allows(one, p) and not allows(other, p))
        shortest, found = next(beyond, None), find_pattern_beyond(one, other)
        if found is None:
            implied += 1
            assert shortest is None
        else:
            assert allows(one, found)
            assert not allows(other, found)
            assert allows(other, found[:-1])
            assert len(found) > longest if shortest is None else len(found) == len(shortest)
    assert 5 < implied < 55


def test_windows_against_the_closed_form() -> None:
    """At most m in K allow at most m ⌊k/K⌋ + min(m, k mod K) losses in k packets."""
    for (window, other), losses in product(product(range(2, 6), range(1, 10)), range(3)):
        most = losses * (other // window) + min(losses, other % window)
        for limit in range(other):
            one = guarantee(LossesInWindow(losses, window))
            implied = find_pattern_beyond(one, guarantee(LossesInWindow(limit, other))) is None
            assert implied == (limit >= min(most, other)) or losses >= window
