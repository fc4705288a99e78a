"""Against the definition, to the nanosecond: begin ≤ t < end."""

from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from netem.rule_program import program_of
from netem.rules.blackout import dark
from noack.config.impairments import Blackout, LinkSettings

NS = 10**9


@given(st.sets(st.integers(0, 50), min_size=2), st.none() | st.integers(0, 30))
def test_it_is_dark_from_begin_until_just_before_end(borders: set[int], extra: int | None) -> None:
    ends = sorted(borders)[: len(borders) // 2 * 2]
    intervals = list(zip(ends[::2], ends[1::2], strict=True))
    period = None if extra is None else ends[-1] + extra
    blackout = Blackout(
        intervals_s=tuple((a * 1e-6, b * 1e-6) for a, b in intervals),
        every_s=None if period is None else period * 1e-6,
    )
    first = Blackout(intervals_s=((0.0, 1.0),))  # so that the tables do not begin at 0
    program = program_of(LinkSettings(impairments=(first, blackout)), 0, "a")
    borders_ns = [1000 * t for t in range(200)]
    for t_ns in sorted({*borders_ns, *(t - 1 for t in borders_ns[1:])}):
        place = t_ns if period is None else t_ns % (1000 * period)
        expected = any(1000 * a <= place < 1000 * b for a, b in intervals)
        assert dark(program.darknesses[1], program.integers, t_ns) is expected


def test_nothing_comes_through_but_what_must(decide: Any) -> None:
    blackout = Blackout(intervals_s=((0.1, 0.3),), every_s=0.5)
    arrivals = np.arange(1000) * NS // 1000
    is_dark = (arrivals % (NS // 2) >= NS // 10) & (arrivals % (NS // 2) < 3 * NS // 10)
    freely = decide([blackout], 1000, arrivals_ns=arrivals)
    np.testing.assert_array_equal(freely.fates, np.where(is_dark, 5, 0))
    capped = decide(LinkSettings(impairments=(blackout,), mansd=3), 1000, arrivals_ns=arrivals)
    np.testing.assert_array_equal(capped.fates != 0, is_dark)
    for begin in (100, 600):  # 200 in a row
        assert capped.fates[begin : begin + 200].tolist() == [5, 5, 5, 2] * 50
