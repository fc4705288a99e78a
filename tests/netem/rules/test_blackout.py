"""Compare blackouts with their definition, to the nanosecond: begin ≤ t < end."""

from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from netem.tc_words import settings_of
from noack.impairments.loss_prediction import read_files
from tests.oracles.link import Link


@given(st.sets(st.integers(0, 50), min_size=2), st.none() | st.integers(0, 30))
def test_every_packet_is_lost_from_begin_until_just_before_end(
    borders: set[int], extra: int | None
) -> None:
    ends = sorted(borders)[: len(borders) // 2 * 2]
    intervals = list(zip(ends[::2], ends[1::2], strict=True))
    period = None if extra is None else ends[-1] + extra
    words = "blackout " + ",".join(f"{a}us-{b}us" for a, b in intervals)
    if period is not None:
        words += f" every {period}us"
    # Another blackout comes first, so that the interval's table offset is not 0.
    link = Link(settings_of(f"blackout 10s-11s {words}"), 0, "a")
    borders_ns = [1000 * t for t in range(200)]
    for t_ns in sorted({*borders_ns, *(t - 1 for t in borders_ns[1:])}):
        place = t_ns if period is None else t_ns % (1000 * period)
        expected = any(1000 * a <= place < 1000 * b for a, b in intervals)
        assert link.decide(0, 1, t_ns).fate == (5 if expected else 0)


@given(st.lists(st.integers(1, 9), min_size=2, max_size=40), st.integers(0, 400))
def test_outages_of_a_file_are_a_blackout_of_these_intervals(
    tmp_path_factory: Any, gaps: list[int], t_ms: int
) -> None:
    ends = np.cumsum(gaps)[: len(gaps) // 2 * 2].reshape(-1, 2)
    file = tmp_path_factory.mktemp("outages") / "outages.txt"
    file.write_text("# from a log\n" + "".join(f"{a}ms {b / 1000}s\n\n" for a, b in ends))
    link = Link(read_files(settings_of(f"outages {file}"), file.parent), 0, "a")
    inside = bool(((ends[:, 0] <= t_ms) & (t_ms < ends[:, 1])).any())
    assert link.decide(0, 1, t_ms * 10**6).fate == (5 if inside else 0)
