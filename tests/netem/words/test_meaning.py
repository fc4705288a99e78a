"""The explanations of words."""

import re
from typing import Any

import numpy as np
import pytest

from netem.tc_words import settings_of

DRAWS = 20_000


@pytest.mark.parametrize(
    "words",
    [
        "delay 10ms 20ms",
        "delay 10ms 50ms 30%",
        "delay 0 1ms",
        "delay 5ms 5ms distribution normal",
        "delay 1ms 10ms distribution pareto",
        "delay 1ms 2ms distribution paretonormal",
        "delay 0 samples -5ms,-1ms,3ms",
    ],
)
def test_the_share_of_delays_cut_at_zero_is_shown(decide: Any, words: str) -> None:
    (delay,) = settings_of(words).impairments
    note = re.search(r"negative delays become 0 \((.*)% of the draws\)", delay.meaning())
    assert note is not None
    share = float(note[1]) / 100
    # One draw per flow: draws are independent even with a correlation.
    cut = np.mean(decide(words, DRAWS, flows=np.arange(DRAWS)).delays_ns == 0)
    error = np.sqrt(share * (1 - share) / DRAWS)
    assert cut == pytest.approx(share, abs=5 * error + 0.05 * share)
