"""Test each parser on its corpus and on similar inputs; the long run is ``make fuzz``."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fuzz.harness import NAMES, from_line, harness, kept, to_line

EXAMPLES = {"record": 10, "telemetry": 15, "campaign": 20}
"""Number of examples for slow parsers; 50 for the others. The long run is `make fuzz`."""

places = st.integers(0, 2**16)
changes = st.lists(
    st.tuples(st.sampled_from(["set", "insert", "delete", "cut", "join"]), places, st.binary()),
    max_size=6,
)


@pytest.mark.parametrize("name", NAMES)
def test_every_input_of_the_corpus_is_read_or_refused_in_one_line(name: str) -> None:
    under_test = harness(name)
    inputs = [*under_test.seeds, *kept(name)]
    assert len(inputs) > 3
    for data in inputs:
        under_test.run(data)


@pytest.mark.parametrize("name", NAMES)
def test_inputs_near_the_corpus_are_read_or_refused_in_one_line(name: str) -> None:
    under_test = harness(name)
    inputs = st.sampled_from([*under_test.seeds, *kept(name)])

    @settings(max_examples=EXAMPLES.get(name, 50), database=None)
    @given(inputs, inputs, changes)
    def check(data: bytes, other: bytes, these: list[tuple[str, int, bytes]]) -> None:
        under_test.run(changed(data, other, these))

    check()


def changed(data: bytes, other: bytes, these: list[tuple[str, int, bytes]]) -> bytes:
    """Return an input with some changes; one change appends a piece of another input."""
    for what, place, new in these:
        at = place % (len(data) + 1)
        match what:
            case "set":
                data = data[:at] + new + data[at + len(new) :]
            case "insert":
                data = data[:at] + new + data[at:]
            case "delete":
                data = data[:at] + data[at + 1 + len(new) :]
            case "cut":
                data = data[:at]
            case _:
                data = data[:at] + other[place % (len(other) + 1) :]
    return data


@given(st.binary())
def test_a_line_of_a_corpus_keeps_an_input(data: bytes) -> None:
    line = to_line(data)
    assert line.isascii()
    assert line.isprintable()
    assert not line.startswith("#")
    assert from_line(line) == data
