import math

import pytest

from noack.core.number_format import byte_size, plus_minus


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


def test_a_size_is_in_the_unit_that_it_is_rounded_to() -> None:
    assert [byte_size(size) for size in (999.4, 999.6, 123.4e9)] == [
        "999 bytes",
        "1.00 kB",
        "123 GB",
    ]
