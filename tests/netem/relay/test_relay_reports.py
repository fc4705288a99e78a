"""Histograms of times."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem.core.core_library import core
from netem.relay.relay_reports import bucket_start_ns, coarse_histogram, quantile_ns


@given(st.integers(0, 2**44 - 1))
def test_a_bucket_holds_its_times_to_three_percent(t_ns: int) -> None:
    bucket = core.noack_bucket_of(t_ns)
    assert bucket_start_ns(bucket) <= t_ns < bucket_start_ns(bucket + 1)
    assert bucket_start_ns(bucket + 1) - bucket_start_ns(bucket) <= max(1, bucket_start_ns(bucket) / 32)
    assert core.noack_bucket_of(-1 - t_ns) == 0
    assert core.noack_bucket_of(2**60) == core.NOACK_BUCKETS - 1


@given(st.lists(st.integers(0, 2**43), min_size=1, max_size=200))
def test_quantiles_and_the_coarse_histogram_are_those_of_the_times(times_ns: list[int]) -> None:
    counts = np.bincount([core.noack_bucket_of(t_ns) for t_ns in times_ns], minlength=core.NOACK_BUCKETS)
    for share in (0.5, 0.99, 1.0):
        exact = float(np.quantile(times_ns, share, method="inverted_cdf"))
        assert quantile_ns(counts, share) == pytest.approx(exact, rel=1 / 32, abs=1)
    steps = coarse_histogram(counts)
    begins = [begin for begin, _ in steps]
    assert begins == sorted(begins)
    assert sum(n for _, n in steps) == len(times_ns)
    for begin, n in steps:
        # Four buckets per doubling; below 32 ns, each bucket is 8 ns wide.
        width = 8 if begin < 32 else 1 << (begin.bit_length() - 3)
        assert n == sum(begin <= t_ns < begin + width for t_ns in times_ns)
