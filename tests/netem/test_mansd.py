"""The guarantee, over a million decisions for each loss model and cap."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from netem.loss import loss_model
from netem.mansd import MansdCap
from noack.records import Fate
from noack.rng import stream
from noack.scenario import Bernoulli, GilbertElliott, Loss, Lossless, WorstCase

DECISIONS = 1_000_000
CAPS = (0, 1, 4, 17)
LOSSES: list[Loss] = [
    Lossless(model="lossless"),
    Bernoulli(model="bernoulli", probability=0.05),
    Bernoulli(model="bernoulli", probability=0.5),
    Bernoulli(model="bernoulli", probability=0.95),
    GilbertElliott(
        model="gilbert_elliott",
        good_to_bad=0.05,
        bad_to_good=0.02,
        loss_in_good=0.1,
        loss_in_bad=0.97,
    ),
    WorstCase(model="worst_case"),
]

Flags = NDArray[np.bool_]
Fates = NDArray[np.int8]


def decide(lost: Flags, cap: MansdCap) -> Fates:
    decide = cap.decide
    return np.fromiter((decide(flag) for flag in lost.tolist()), np.int8, len(lost))


def longest_run(dropped: Flags) -> int:
    """Most successive drops, by the distances between deliveries."""
    passed = np.concatenate([[-1], np.flatnonzero(~dropped), [len(dropped)]])
    return int(np.diff(passed).max()) - 1


@pytest.fixture(scope="module", params=LOSSES, ids=lambda loss: loss.model)
def sequence(request: pytest.FixtureRequest) -> tuple[Loss, Flags]:
    """A loss model and what it says of a million datagrams."""
    lost = loss_model(request.param, stream(11, "test")).lost
    return request.param, np.fromiter((lost() for _ in range(DECISIONS)), bool, DECISIONS)


@pytest.mark.parametrize("mansd", CAPS)
def test_never_more_than_mansd_successive_drops(sequence: tuple[Loss, Flags], mansd: int) -> None:
    loss, lost = sequence
    fates = decide(lost, MansdCap(mansd))
    dropped = fates == Fate.DROPPED
    assert longest_run(dropped) <= mansd
    assert not dropped[0]
    assert longest_run(dropped) == min(mansd, longest_run(lost[1:]))  # all that may be lost is
    # Only what the model loses is dropped, and it is overruled only where the cap is reached.
    assert not dropped[~lost].any()
    assert ((fates == Fate.DELIVERED) == ~lost).all()
    forced = np.flatnonzero(fates == Fate.FORCED)
    if mansd:
        before = np.lib.stride_tricks.sliding_window_view(dropped, mansd)
        late = forced[forced > 0]  # the first may be forced for the paper's t_0
        assert before[late - mansd].all()
    if loss.model == "worst_case":
        assert np.flatnonzero(~dropped).tolist() == list(range(0, DECISIONS, mansd + 1))
    if loss.model == "bernoulli":
        assert_capped_rate(dropped, loss.probability, mansd)


def assert_capped_rate(dropped: Flags, p: float, m: int) -> None:
    """Loss under the cap is p(1 − p^m)/(1 − p^{m+1}).

    From delivery to delivery, D = min(Geometric, m) datagrams are dropped: E D = Σ_{k=1..m} p^k out
    of E D + 1. The standard error is that of 200 batch means; a batch holds hundreds of deliveries,
    each of which begins anew.
    """
    means = dropped.reshape(200, -1).mean(axis=1)
    error = means.std(ddof=1) / np.sqrt(len(means))
    expected = p * (1 - p**m) / (1 - p ** (m + 1))
    assert abs(means.mean() - expected) <= 5 * error
    assert error <= 1e-3  # a few hundred batches of 5000 fix the rate to three digits


def test_without_a_cap_the_loss_model_decides(sequence: tuple[Loss, Flags]) -> None:
    _, lost = sequence
    fates = decide(lost[:100_000], MansdCap(None, first_delivered=False))
    np.testing.assert_array_equal(fates, np.where(lost[:100_000], Fate.DROPPED, Fate.DELIVERED))


@given(st.lists(st.booleans(), max_size=60), st.integers(0, 5), st.booleans())
def test_the_cap_is_a_counter(lost: list[bool], mansd: int, first: bool) -> None:
    cap, run = MansdCap(mansd, first_delivered=first), mansd if first else 0
    for flag in lost:
        fate = cap.decide(flag)
        if not flag:
            assert fate is Fate.DELIVERED
        elif run < mansd:
            assert fate is Fate.DROPPED
        else:
            assert fate is Fate.FORCED
        run = run + 1 if fate is Fate.DROPPED else 0
        assert cap.run == run


@pytest.mark.parametrize("mansd", [1, 4])
def test_the_first_passes_when_asked(mansd: int) -> None:
    assert MansdCap(mansd).decide(True) is Fate.FORCED
    cap = MansdCap(mansd, first_delivered=False)
    assert [cap.decide(True) for _ in range(mansd + 1)] == [Fate.DROPPED] * mansd + [Fate.FORCED]
