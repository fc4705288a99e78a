"""Times that are read from the output of programs."""

import pytest

from benchmarks.programs import OutputLine, first_step_s


def test_the_first_step_is_bounded_by_the_progress_line_with_the_least_delay() -> None:
    began_s = 100.0
    lines = [
        OutputLine(100.4, "starting"),
        OutputLine(101.6, "1.0/20 s"),  # it may show 0.95 s
        OutputLine(102.9, "2.0/20 s"),
    ]
    assert first_step_s(began_s, lines) == pytest.approx(0.65)
    assert first_step_s(began_s, lines[:1]) is None
