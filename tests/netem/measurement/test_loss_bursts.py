"""Effective packets, bursts of losses, and M of a share: against their definitions."""

import math
from itertools import groupby

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem.measurement.loss_bursts import burst_quantile, histogram, loss_bursts, most_losses, outcomes
from netem.traces.packet_trace import packet_trace

flags = st.lists(st.booleans(), min_size=1, max_size=60)


@given(st.lists(st.one_of(st.none(), st.integers(0, 9)), min_size=1, max_size=12), st.integers(0, 9))
def test_a_packet_is_effective_if_it_arrives_in_time_before_every_later_one(
    delays: list[int | None], deadline: int
) -> None:
    """The definition of docs/mansd.md, by a receiver that keeps only what is newer."""
    sent = 2 * np.arange(len(delays))
    arrivals = [(2 * k + d, k) for k, d in enumerate(delays) if d is not None]
    effective, newest = set(), -1
    for arrival, k in sorted(arrivals):
        if arrival - 2 * k <= deadline and k > newest:
            effective.add(k)
            newest = k
    lost = np.array([d is None for d in delays])
    received = sent + np.array([d or 0 for d in delays])
    packets = outcomes(packet_trace(sent, received, lost), deadline)
    assert set(np.flatnonzero(packets.effective).tolist()) == effective
    groups = np.array([packets.lost, packets.out_of_order, packets.late, packets.effective])
    assert (groups.sum(axis=0) == 1).all()


@given(flags)
def test_bursts_are_the_groups_of_consecutive_losses(effective: list[bool]) -> None:
    bursts = loss_bursts(np.array(effective))
    lengths = [len(list(group)) for ok, group in groupby(effective) if not ok]
    assert bursts.length.tolist() == lengths
    assert histogram(bursts) == {n: lengths.count(n) for n in sorted(set(lengths))}
    assert bursts.deliveries().sum() == sum(effective)
    assert bursts.complete.tolist() == [
        first > 0 and end < len(effective) for first, end in zip(bursts.first, bursts.end, strict=True)
    ]


@given(flags, st.sampled_from([0.1, 0.5, 0.75, 0.9, 1.0]))
def test_the_losses_of_a_share_are_the_fewest_that_cover_it(effective: list[bool], share: float) -> None:
    bursts = loss_bursts(np.array(effective))
    counts, count = [], 0
    for ok in effective:
        count = 0 if ok else count + 1
        counts.append(count)
    quantile = burst_quantile(bursts, share)
    values_of = {quantile.packets: counts, quantile.bursts: bursts.length.tolist()}
    for most, values in values_of.items():
        for smaller, covered in ((most, True), (most - 1, False)):
            within = sum(value <= smaller for value in values)
            assert (smaller < 1) or (within >= share * len(values) - 1e-9) is (covered or not values)


@given(flags, st.data())
def test_most_losses_are_those_of_the_worst_window(effective: list[bool], data: st.DataObject) -> None:
    bursts = loss_bursts(np.array(effective))
    chosen = data.draw(st.lists(st.booleans(), min_size=len(bursts.length), max_size=len(bursts.length)))
    left_out = np.array(chosen, bool)
    skipped = np.zeros(len(effective), bool)
    for first, end in zip(bursts.first[left_out], bursts.end[left_out], strict=True):
        skipped[first:end] = True
    windows = range(1, len(effective) + 3)
    expected = {}
    for window in windows:
        starts = range(len(effective) - window + 1)
        worst = [window - sum(effective[i : i + window]) for i in starts if not skipped[i : i + window].any()]
        if worst:
            expected[window] = max(worst)
    assert most_losses(bursts, windows, left_out) == expected


@pytest.mark.parametrize(("share", "fewest"), [(0.9, 29), (0.99, 299)])
def test_confidence_needs_as_many_bursts_as_wilks_says(share: float, fewest: int) -> None:
    """ln 0.05 / ln share, rounded up: then the longest burst is the limit."""
    assert fewest == math.ceil(math.log(0.05) / math.log(share))
    for count in (fewest - 1, fewest):
        effective = np.tile([True, False], count)
        confident = burst_quantile(loss_bursts(effective), share).bursts_confident
        assert (confident is None) == (count < fewest)
    rng = np.random.default_rng(1)
    covered = [
        burst_quantile(loss_bursts(_bursts(rng.geometric(0.3, 400))), share).bursts_confident
        for _ in range(400)
    ]
    truth = math.ceil(math.log(1 - share) / math.log(0.7))
    assert np.mean([m is not None and m >= truth for m in covered]) >= 0.93


def _bursts(lengths: np.ndarray) -> np.ndarray:
    steps = np.zeros(int(lengths.sum()) + len(lengths), bool)
    steps[np.cumsum(lengths + 1) - 1] = True
    return steps
