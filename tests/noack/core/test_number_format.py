import math

import pytest

from noack.core.number_format import plus_minus


@pytest.mark.parametrize(
    ("mean", "halfwidth", "written"),
    [
        (36.0, 16.2, "36 ± 16"),
        (-0.2496, 3.4, "−0.2 ± 3.4"),
        (9.97, 0.996, "10.0 ± 1.0"),
        (1.23456e9, 2.34e7, "1.235e+09 ± 2.3e+07"),
        (3.14159, math.inf, "3.142"),
        (math.nan, 1.0, "nan"),
    ],
)
def test_a_mean_has_as_many_digits_as_its_interval_supports(
    mean: float, halfwidth: float, written: str
) -> None:
    assert plus_minus(mean, halfwidth) == written
