from collections.abc import Callable
from typing import Any

import numpy as np

from noack.impairments.kinds.delay import Delay
from noack.impairments.kinds.duplicate import Duplicate
from noack.impairments.kinds.loss import LossOf
from noack.impairments.loss_models.bernoulli import BernoulliLoss


def test_a_share_is_sent_twice(decide: Any, share_is: Callable[..., None]) -> None:
    decided = decide([Duplicate(probability=0.2)], 200_000)
    copied = decided.verdicts["copy_ns"] >= 0
    share_is(copied, 0.2)
    assert (decided.fates == 0).all()
    assert (decided.verdicts["copy_ns"] == np.where(copied, decided.arrivals_ns, -1)).all()


def test_a_lost_packet_has_no_copy(decide: Any) -> None:
    loss = LossOf(loss=BernoulliLoss(probability=0.5))
    for order in ((loss, Duplicate(probability=1.0)), (Duplicate(probability=1.0), loss)):
        decided = decide(order, 1000)
        assert ((decided.verdicts["copy_ns"] >= 0) == (decided.fates == 0)).all()
        assert 0 < np.count_nonzero(decided.fates) < 1000


def test_the_earlier_of_original_and_copy_leaves_first(decide: Any) -> None:
    delay = Delay(delay_s=0.01, jitter_s=0.005)
    decided = decide([Duplicate(probability=1.0), delay], 100_000)
    first, second = decided.verdicts["release_ns"], decided.verdicts["copy_ns"]
    assert (first <= second).all()
    # The mean difference of two independent uniform delays is a third of their range.
    assert abs(np.mean(second - first) / 10_000_000 - 1 / 3) < 0.005
