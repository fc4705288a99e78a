"""Compare blackouts with their definition, to the nanosecond: begin ≤ t < end."""

from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from netem.link_machine import Link
from noack.impairments.kinds.blackout import Blackout
from noack.impairments.link_settings import LinkSettings

NS = 10**9


@given(st.sets(st.integers(0, 50), min_size=2), st.none() | st.integers(0, 30))
def test_every_packet_is_lost_from_begin_until_just_before_end(
    borders: set[int], extra: int | None
) -> None:
    ends = sorted(borders)[: len(borders) // 2 * 2]
    intervals = list(zip(ends[::2], ends[1::2], strict=True))
    period = None if extra is None else ends[-1] + extra
    blackout = Blackout(
        intervals_s=tuple((a * 1e-6, b * 1e-6) for a, b in intervals),
        every_s=None if period is None else period * 1e-6,
    )
    other = Blackout(intervals_s=((10.0, 11.0),))  # so that the interval's table offset is not 0
    link = Link(LinkSettings(impairments=(other, blackout)), 0, "a")
    borders_ns = [1000 * t for t in range(200)]
    for t_ns in sorted({*borders_ns, *(t - 1 for t in borders_ns[1:])}):
        place = t_ns if period is None else t_ns % (1000 * period)
        expected = any(1000 * a <= place < 1000 * b for a, b in intervals)
        assert link.decide(0, 1, t_ns).fate == (5 if expected else 0)


def test_only_packets_that_must_pass_are_delivered(decide: Any) -> None:
    blackout = Blackout(intervals_s=((0.1, 0.3),), every_s=0.5)
    arrivals = np.arange(1000) * NS // 1000
    in_blackout = (arrivals % (NS // 2) >= NS // 10) & (arrivals % (NS // 2) < 3 * NS // 10)
    freely = decide([blackout], 1000, arrivals_ns=arrivals)
    np.testing.assert_array_equal(freely.fates, np.where(in_blackout, 5, 0))
    capped = decide(LinkSettings(impairments=(blackout,), mansd=3), 1000, arrivals_ns=arrivals)
    np.testing.assert_array_equal(capped.fates != 0, in_blackout)
    for begin in (100, 600):  # 200 consecutive packets
        assert capped.fates[begin : begin + 200].tolist() == [5, 5, 5, 2] * 50
