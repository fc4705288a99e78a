import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem.control.statistics_view import (
    bar,
    bits_text,
    elapsed_text,
    percent_text,
    rate_text,
    sparkline,
    time_text,
)


@pytest.mark.parametrize(
    ("bits_per_s", "text"),
    [(0, "0 bit/s"), (999.4, "999 bit/s"), (999.6, "1.00 kbit/s"), (12_345, "12.3 kbit/s"),
     (999_949, "1.00 Mbit/s"), (6_543_210, "6.54 Mbit/s"), (123.4e9, "123 Gbit/s")],
)  # fmt: skip
def test_bits(bits_per_s: float, text: str) -> None:
    assert bits_text(bits_per_s) == text


@pytest.mark.parametrize(
    ("t_ns", "text"),
    [(None, "–"), (0, "0 ns"), (31, "31 ns"), (9_995, "10.0 µs"), (12_345_678, "12.3 ms"),
     (999_960, "1.00 ms"), (61e9, "61.0 s")],
)  # fmt: skip
def test_times(t_ns: float | None, text: str) -> None:
    assert time_text(t_ns) == text


@pytest.mark.parametrize(
    ("share", "text"),
    [(None, "–"), (0, "0 %"), (1, "100 %"), (0.5, "50.0 %"), (0.0998, "9.98 %"),
     (0.099951, "10.0 %"), (0.001, "0.10 %"), (0.000012, "0.0012 %"), (0.99996, "100 %")],
)  # fmt: skip
def test_percents(share: float | None, text: str) -> None:
    assert percent_text(share) == text


def test_rates_and_elapsed_times() -> None:
    assert [rate_text(rate) for rate in (0, 0.25, 9.94, 12_345.6)] == [
        "0/s", "0.25/s", "9.9/s", "12,346/s",
    ]  # fmt: skip
    assert [elapsed_text(t_s) for t_s in (0.9, 61, 3661)] == ["0:00", "1:01", "1:01:01"]


def test_a_sparkline_uses_the_whole_height() -> None:
    assert sparkline([None, 0, 5, 10, 20], 10) == " ▁▅██"
    assert sparkline([0, None], 0) == "▁ "


@given(st.floats(-1, 2), st.integers(0, 50))
def test_a_bar_has_its_width_and_share(share: float, width: int) -> None:
    filled, rest = bar(share, width)
    assert len(filled + rest) == width
    assert abs(len(filled) - min(max(share, 0), 1) * width) <= 0.5
