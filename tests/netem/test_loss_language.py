"""Exactly the sequences of outcomes that the guarantee allows can occur.

All sequences of losses are scripted, one after the other, with deliveries between them.
"""

import itertools
from typing import Any

import numpy as np
import pytest

from netem.tc_words import settings_of
from noack.impairments.kinds.loss import LossOf
from noack.impairments.loss_models.scripted import ScriptedLoss
from noack.protocol.record_tables import Fate
from tests.netem.loss_language import allowed_rows, is_allowed

LENGTH = 12
"""More than the longest window, and than a burst with the deliveries that must follow it."""
APART = 9
WISHES = np.array(list(itertools.product([False, True], repeat=LENGTH)))
LOST = np.flatnonzero(np.pad(WISHES, ((0, 0), (0, APART)))).tolist()
SCRIPT = (LossOf(loss=ScriptedLoss(lost=tuple(LOST))),)
PAIRS = [(m, k) for k in range(1, 9) for m in range(k)]


def outcomes_of(decide: Any, words: str) -> Any:
    settings = settings_of(words).model_copy(update={"impairments": SCRIPT})
    fates = decide(settings, len(WISHES) * (LENGTH + APART)).fates
    lost = ~np.isin(fates, (Fate.DELIVERED, Fate.FORCED))
    return lost.reshape(len(WISHES), LENGTH + APART)[:, :LENGTH]


@pytest.mark.parametrize(("m", "k"), PAIRS)
def test_exactly_the_allowed_sequences_occur(decide: Any, m: int, k: int) -> None:
    """For each pair (m, K) with K ≤ 8: alone, with a cap, with recovery, and with both."""
    for cap, recovery in itertools.product(["", "mansd 2"], ["", 3]):
        words = f"atmost {m} in {k} {cap} {f'recover {recovery}' if recovery else ''}"
        occurred, allowed = outcomes_of(decide, words), allowed_rows(WISHES, settings_of(words))
        assert allowed_rows(occurred, settings_of(words)).all()
        # What is allowed occurs, what is not does not; and nothing is changed before it must be.
        assert (allowed == (occurred == WISHES).all(axis=1)).all()
        first = np.argmax(occurred != WISHES, axis=1)
        for row in range(5, len(WISHES), 512):
            wish, outcome, at = WISHES[row], occurred[row], first[row]
            assert is_allowed(wish, settings_of(words)) == (wish == outcome).all()
            if (wish != outcome).any():
                assert not is_allowed(wish[: at + 1], settings_of(words))
                assert (wish[at], outcome[at]) == (True, False)


def test_two_windows_apply_together(decide: Any) -> None:
    words = "atmost 2 in 4 atmost 3 in 8 recover 2"
    occurred, allowed = outcomes_of(decide, words), allowed_rows(WISHES, settings_of(words))
    assert (allowed == (occurred == WISHES).all(axis=1)).all()
    assert 0 < allowed.sum() < len(WISHES)
