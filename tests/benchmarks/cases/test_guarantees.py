"""The benchmark of the guarantees: what it counts as a violation."""

import numpy as np
import pytest

from benchmarks.cases import guarantees as bench
from netem.tc_words import settings_of
from tests.oracles.loss_language import is_allowed, outcomes_of


@pytest.mark.parametrize("words", bench.COMBINATIONS)
def test_no_combination_is_violated_and_each_would_be_without_it(
    words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench, "_FLOW_DECISIONS", 200_000)
    for before in ("loss 50%", f"loss 30% {bench.REORDERING}"):
        violations, *rates = bench.check_rows(before, words, 200_000)
        assert violations.value == 0
        assert all(rate.ratio == pytest.approx(1, abs=0.02) for rate in rates)
        free = outcomes_of(bench.decide(f"{before} limit 1000000"))
        assert not is_allowed(free, settings_of(words))


def test_the_check_examines_windows_and_gaps() -> None:
    lost = np.array([1, 1, 0, 1, 0, 0, 1, 0, 0, 0], bool)
    for words, allowed in (("mansd 1", False), ("atmost 2 in 4", False), ("mansd 2 recover 2", False),
                           ("mansd 2 recover 1", True)):  # fmt: skip
        assert is_allowed(lost, settings_of(words)) is allowed
