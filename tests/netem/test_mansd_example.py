"""The link decides the example of docs/mansd.md as documented."""

from pathlib import Path

import pytest

from netem.words.words_to_settings import settings_of
from noack.impairments.link_settings import NEVER_NS, RecordedDecision
from noack.protocol.record_tables import Fate
from tests.oracles.link import Link

PAGE = (Path(__file__).parents[2] / "docs/mansd.md").read_text()
NEVER = "–"
NS_PER_MS = 1_000_000


def table() -> list[list[str]]:
    lines = PAGE.partition("## An example")[2].partition("## Proof")[0].splitlines()
    rows = [
        [cell.strip() for cell in line.strip("| ").split(" | ")] for line in lines if "|" in line
    ]
    return rows[2:]


def ns(text: str) -> int:
    return NEVER_NS if text == NEVER else int(text) * NS_PER_MS


@pytest.mark.parametrize(("words", "column"), [("mansd 1", 3), ("mansd 1 first", 5)])
def test_the_link_decides_the_example_as_documented(words: str, column: int) -> None:
    rows = table()
    assert [int(row[0]) for row in rows] == list(range(6))
    decisions = []
    for k, comes, wish, *_ in rows:
        lost = k in ("3", "4")  # as the text states
        delay_ns = NEVER_NS if wish == NEVER else ns(wish) - ns(comes)
        decisions.append(
            RecordedDecision(Fate.DROPPED if lost else Fate.DELIVERED, delay_ns, -1, -1, -1)
        )
    link = Link(settings_of(words), 0, "test", decisions=[decisions])
    leaves_ns, held_back, forced = [], [], []
    for row in rows:
        decision = link.decide(0, 100, ns(row[1]))
        leaves_ns.append(decision.release_ns)
        held_back.append(decision.hold_back_ns > 0)
        forced.append(decision.fate == Fate.FORCED)
    assert leaves_ns == [ns(row[column]) for row in rows]
    if column == 3:
        assert held_back == ["held back" in row[4] for row in rows]
        assert forced == ["forced" in row[4] for row in rows]
