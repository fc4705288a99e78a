"""Each parser reads an input or refuses it in one line; the long run is ``make fuzz``."""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz.edits import Choices
from tests.fuzz.harness import parsers, run

SLOW = ("record", "telemetry", "campaign")
"""Parsers with half as many examples."""
OF_THE_CORE = ("wire", "link_numbers")
NAMES = [pytest.param(name, marks=[pytest.mark.sanitized] * (name in OF_THE_CORE)) for name in parsers()]


@pytest.mark.parametrize("name", NAMES)
def test_every_input_is_read_or_refused_in_one_line(name: str) -> None:
    @settings(
        max_examples=settings().max_examples // (2 if name in SLOW else 1),
        database=None,
        suppress_health_check=[*HealthCheck],  # inputs are large, and files are read
    )
    @given(st.data())
    def check(data: st.DataObject) -> None:
        run(parsers()[name], Choices(data))

    check()
