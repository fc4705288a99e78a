"""The link decides the example of docs/mansd.md as documented."""

from pathlib import Path

import pytest

from netem.tc_words import settings_of
from noack.impairments.link_settings import NEVER_NS, RecordedDecision
from noack.protocol.record_tables import Fate
from tests.oracles.link import Link

PAGE = (Path(__file__).parents[2] / "docs/mansd.md").read_text()
NEVER = "–"


def ns(text: str) -> int:
    return NEVER_NS if text == NEVER else int(text) * 1_000_000


@pytest.mark.parametrize(("words", "column"), [("mansd 1", 3), ("mansd 1 first", 5)])
def test_the_link_decides_the_example_as_documented(words: str, column: int) -> None:
    lines = PAGE.partition("## An example")[2].partition("## Proof")[0].splitlines()
    cells = [line.strip("| ").split(" | ") for line in lines if "|" in line]
    rows = [[cell.strip() for cell in row] for row in cells[2:]]
    assert [int(row[0]) for row in rows] == list(range(6))
    decisions = []
    for k, comes, wish, *_ in rows:
        fate = Fate.DROPPED if k in ("3", "4") else Fate.DELIVERED  # as the text states
        delay_ns = NEVER_NS if wish == NEVER else ns(wish) - ns(comes)
        decisions.append(RecordedDecision(fate, delay_ns, -1, -1, -1))
    link = Link(settings_of(words), 0, "test", decisions=[decisions])
    for row in rows:
        decision = link.decide(0, 100, ns(row[1]))
        assert decision.release_ns == ns(row[column])
        if column == 3:
            assert (decision.hold_back_ns > 0) == ("held back" in row[4])
            assert (decision.fate == Fate.FORCED) == ("forced" in row[4])
