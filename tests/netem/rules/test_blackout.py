"""Compare blackouts with their definition, to the nanosecond: begin ≤ t < end."""

from pathlib import Path

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


def test_outages_of_a_file_are_a_blackout_of_these_intervals(tmp_path: Path) -> None:
    (tmp_path / "outages.txt").write_text("# from a log\n3ms 0.005s\n\n9ms 10ms\n")
    link = Link(read_files(settings_of("outages outages.txt"), tmp_path), 0, "a")
    lost = [t_ms for t_ms in range(20) if link.decide(0, 1, t_ms * 10**6).fate == 5]
    assert lost == [3, 4, 9]
