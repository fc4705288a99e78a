"""JSON of others is read, or refused by one error."""

import json

import pytest

from netem.core.json_text import parse_json


@pytest.mark.parametrize("content", [{"a": [1, -2.5, None, True, "x"]}, [2**63 - 1, -(2**63)], 1e308, "NaN"])
def test_what_json_can_hold_is_read(content: object) -> None:
    assert parse_json(json.dumps(content)) == content


@pytest.mark.parametrize(
    "text",
    [
        "NaN", "[Infinity]", '{"a": -Infinity}', "1e999", "-1e999", str(2**63), str(-(2**63) - 1),
        "9" * 5000, "[" * 100_000, "", "{", "\ud800", b"\xff",
    ],
    ids=range(13),
)  # fmt: skip
def test_everything_else_is_refused(text: str | bytes) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 # JSON's own, too
        parse_json(text)
