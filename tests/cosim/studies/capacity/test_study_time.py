"""The estimated time of a study, as text."""

import pytest

from cosim.studies.capacity.study_time import rough_time


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.2, "10 s"), (44.0, "40 s"), (89.0, "90 s"), (95.0, "2 min"), (3000.0, "50 min"), (9000.0, "2.5 h")],
)
def test_a_time_has_the_digits_that_an_estimate_can_have(seconds: float, text: str) -> None:
    assert rough_time(seconds) == text
