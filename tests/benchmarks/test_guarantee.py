"""The benchmark of the guarantee, with fewer decisions, and its check by hand-made outcomes."""

import numpy as np
import pytest

from benchmarks.guarantees import (
    CAP,
    COMBINATIONS,
    REORDERING,
    Decider,
    check_row,
    network_rows,
)
from tests.oracles.receiver import Limits, outcomes_of, violations


@pytest.mark.parametrize("words", COMBINATIONS)
def test_no_combination_is_violated_and_each_would_be_without_it(words: str) -> None:
    for before in ("loss 50%", f"loss 30% {REORDERING}"):
        row = check_row(f"{before} {words}", COMBINATIONS[words], 1_000_000)
        assert row.value == 0
        free = outcomes_of(Decider(f"{before} limit 1000000").decide())
        assert violations(free, COMBINATIONS[words]) > 1000


def test_the_check_counts_windows_and_gaps() -> None:
    lost = np.array([1, 1, 0, 1, 0, 0, 1, 0, 0, 0], bool)
    assert violations(lost, Limits(((1, 2),))) == 1
    assert violations(lost, Limits(((2, 4),))) == 1  # of the first four, three are lost
    assert violations(lost, Limits((), 2)) == 1
    assert violations(lost, Limits(((2, 3),), 1)) == 0


def test_only_the_guarantee_limits_what_the_receiver_misses() -> None:
    longest = [row.value or 0 for row in network_rows() if "longest" in row.name]
    assert longest[2] == CAP < min(longest[:2])
