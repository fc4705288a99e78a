"""The short run: what is kept, and what lies near it; the long one is ``make fuzz``."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fuzz.harness import NAMES, from_line, harness, kept, to_line
from tests.fuzz.long import fuzz

EXAMPLES = {"record": 30, "telemetry": 50}
"""Of parsers that take long; a hundred of the others."""

places = st.integers(0, 2**16)
changes = st.lists(
    st.tuples(st.sampled_from(["set", "insert", "delete", "cut", "join"]), places, st.binary()),
    max_size=6,
)


@pytest.mark.parametrize("name", NAMES)
def test_every_kept_input_is_read_or_refused_in_one_line(name: str) -> None:
    under_test = harness(name)
    inputs = [*under_test.seeds, *kept(name)]
    assert len(inputs) > 3
    for data in inputs:
        under_test.run(data)


@pytest.mark.parametrize("name", NAMES)
def test_so_is_what_lies_near_them(name: str) -> None:
    under_test = harness(name)
    inputs = st.sampled_from([*under_test.seeds, *kept(name)])

    @settings(max_examples=EXAMPLES.get(name, 100), database=None)
    @given(inputs, inputs, changes)
    def check(data: bytes, other: bytes, these: list[tuple[str, int, bytes]]) -> None:
        under_test.run(changed(data, other, these))

    check()


def changed(data: bytes, other: bytes, these: list[tuple[str, int, bytes]]) -> bytes:
    """An input with some changes; one joins a piece of another to it."""
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


def test_the_fuzzer_finds_what_lies_behind_branches(tmp_path: Path) -> None:
    pytest.importorskip("atheris", reason="the fuzzer has no wheel for this system")
    result = fuzz("tests.fuzz.planted", "-runs=200000", tmp_path)
    assert result.failed is None
    assert result.executions == 200_000
    (finding,) = result.findings
    assert finding.read_bytes()[:4] == b"odd!"
    assert "planted" in finding.with_suffix(".txt").read_text()
