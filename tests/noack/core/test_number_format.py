import math

import pytest

from noack.core.number_format import byte_size, duration, plus_minus


@pytest.mark.parametrize(
    ("mean", "halfwidth", "written"),
    [
        (36.0, 16.2, "36 ± 16"),
        (0.15941, 0.0163, "0.159 ± 0.016"),
        (512.3, 142.0, "510 ± 140"),
        (-0.2496, 3.4, "−0.2 ± 3.4"),
        (-0.01, 3.4, "0.0 ± 3.4"),
        (15.94, 0.0995, "15.94 ± 0.10"),
        (9.97, 0.996, "10.0 ± 1.0"),
        (0.0, 0.5, "0.00 ± 0.50"),
        (123_456.0, 0.25, "123456.00 ± 0.25"),
        (1.23456e9, 2.34e7, "1.235e+09 ± 2.3e+07"),
        (1.2e-9, 2e-10, "1.2e−09 ± 2e−10"),
        (3.14159, 0.0, "3.142"),
        (3.14159, math.inf, "3.142"),
        (math.nan, 1.0, "nan"),
    ],
)
def test_a_mean_has_as_many_digits_as_its_interval_supports(
    mean: float, halfwidth: float, written: str
) -> None:
    assert plus_minus(mean, halfwidth) == written


@pytest.mark.parametrize(
    ("value_s", "text"),
    [(0.0, "0 ns"), (999.6e-9, "1 µs"), (0.004, "4 ms"), (-0.0125, "-12.5 ms"), (61.0, "61 s"),
     (1234.0, "1234 s")],
)  # fmt: skip
def test_a_duration_has_a_unit_and_no_zeros_at_its_end(value_s: float, text: str) -> None:
    assert duration(value_s) == text


def test_a_size_has_a_unit() -> None:
    assert [byte_size(size) for size in (12, 999_600, 1.5e9)] == ["12 bytes", "1 MB", "1.5 GB"]
