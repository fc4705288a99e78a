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
from tests.oracles.loss_language import allowed_rows

LENGTH = 12
"""More than the longest window, and than a burst with the deliveries that must follow it."""
APART = 9
WISHES = np.array(list(itertools.product([False, True], repeat=LENGTH)))
LOST = np.flatnonzero(np.pad(WISHES, ((0, 0), (0, APART)))).tolist()
SCRIPT = (LossOf(loss=ScriptedLoss(lost=tuple(LOST))),)
WINDOWS = [f"atmost {m} in {k}" for k in range(1, 9) for m in range(k)]


@pytest.mark.parametrize("window", [*WINDOWS, "atmost 2 in 4 atmost 3 in 8"])
def test_exactly_the_allowed_sequences_occur(decide: Any, window: str) -> None:
    """For each pair (m, K) with K ≤ 8, and two: alone, with a cap, with recovery, and with both."""
    for cap, recovery in itertools.product(["", "mansd 2"], ["", "recover 3"]):
        own = settings_of(f"{window} {cap} {recovery}")
        scripted = own.model_copy(update={"impairments": SCRIPT})
        fates = decide(scripted, len(WISHES) * (LENGTH + APART)).fates
        lost = ~np.isin(fates, (Fate.DELIVERED, Fate.FORCED))
        occurred = lost.reshape(len(WISHES), LENGTH + APART)[:, :LENGTH]
        allowed, is_wish = allowed_rows(WISHES, own), (occurred == WISHES).all(axis=1)
        assert allowed_rows(occurred, own).all()
        # What is allowed occurs, what is not does not; and nothing is changed before it must be.
        assert (allowed == is_wish).all()
        first = np.argmax(occurred != WISHES, axis=1)[:, None]
        assert np.take_along_axis(WISHES, first, axis=1)[~is_wish].all()
        begun = WISHES & (np.arange(LENGTH) <= first)
        assert not allowed_rows(begun[~is_wish], own).any()
