"""Test each parser on its corpus and on similar inputs; the long run is ``make fuzz``."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fuzz.harness import kept_inputs, parsers

EXAMPLES = {"record": 10, "telemetry": 15, "campaign": 15}
"""Number of examples for slow parsers; 25 for the others. The long run is `make fuzz`."""

OF_THE_CORE = ("wire", "link_numbers")
NAMES = [pytest.param(name, marks=[pytest.mark.sanitized] * (name in OF_THE_CORE)) for name in parsers()]

splices = st.lists(
    st.tuples(st.integers(0, 2**16), st.integers(0, 2**16), st.none() | st.binary()), max_size=6
)
"""Begin and end of replaced bytes, and the new bytes; None: the other input up to its end."""


@pytest.mark.parametrize("name", NAMES)
def test_every_input_of_the_corpus_is_read_or_refused_in_one_line(name: str) -> None:
    under_test = parsers()[name]
    inputs = [*under_test.seeds, *kept_inputs(name)]
    assert len(inputs) > 3
    for data in inputs:
        under_test.run(data)


@pytest.mark.parametrize("name", NAMES)
def test_inputs_near_the_corpus_are_read_or_refused_in_one_line(name: str) -> None:
    under_test = parsers()[name]
    inputs = st.sampled_from([*under_test.seeds, *kept_inputs(name)])

    @settings(max_examples=EXAMPLES.get(name, 25), database=None)
    @given(inputs, inputs, splices)
    def check(data: bytes, other: bytes, these: list[tuple[int, int, bytes | None]]) -> None:
        under_test.run(spliced(data, other, these))

    check()


def spliced(data: bytes, other: bytes, these: list[tuple[int, int, bytes | None]]) -> bytes:
    for first, last, new in these:
        begin, end = sorted((first % (len(data) + 1), last % (len(data) + 1)))
        if new is None:
            data = data[:begin] + other[last % (len(other) + 1) :]
        else:
            data = data[:begin] + new + data[end:]
    return data
