"""The command that searches the stored proofs again."""

import json
from pathlib import Path

import pytest
from flint import arb

from noack.core.balls import number
from noack.proof.search.results import FoundBound, Proof
from tests.checker import write_witnesses
from tests.checker.proofs import FOLDER, SEARCHES
from tests.checker.write_witnesses import grown, write

NAME = "a_drift"
"""A short search."""


def test_each_stored_proof_has_a_file_and_each_file_a_proof() -> None:
    assert {path.stem for path in FOLDER.glob("*.json")} == SEARCHES.keys()


BEFORE = Proof(
    arb(0), (FoundBound("x", arb(3), arb(4), True), FoundBound("x", arb(9), arb(1), False)), None, None, True
)


@pytest.mark.parametrize(("factor", "is_too_much"), [(0.5, False), (1.0, False), (1.02, False), (1.04, True)])
def test_a_bound_may_grow_by_three_percent(factor: float, is_too_much: bool) -> None:
    from_start, in_the_limit = BEFORE.bounds
    larger = from_start._replace(decaying=3 * number(factor), constant=4 * number(factor))
    later = in_the_limit._replace(constant=number(factor))
    for bounds in ((larger, in_the_limit), (from_start, later)):
        assert bool(grown(BEFORE, BEFORE._replace(bounds=bounds))) is is_too_much


def test_of_a_bound_in_the_limit_the_part_that_decays_does_not_count() -> None:
    from_start, in_the_limit = BEFORE.bounds
    later = in_the_limit._replace(decaying=arb(90))
    assert grown(BEFORE, BEFORE._replace(bounds=(from_start, later))) == []


def test_a_bound_that_is_missing_is_said() -> None:
    assert grown(BEFORE, BEFORE._replace(bounds=BEFORE.bounds[:1])) == ["x in the limit: 1 -> inf"]


def test_a_file_is_written_unless_a_bound_grew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(write_witnesses, "FOLDER", tmp_path)
    assert write(NAME) == []
    assert json.loads((tmp_path / f"{NAME}.json").read_text())["bounds"]
    (tmp_path / f"{NAME}.json").write_text("of before")
    monkeypatch.setattr(write_witnesses, "MOST_GROWTH", 0.5)
    assert write(NAME)
    assert (tmp_path / f"{NAME}.json").read_text() == "of before"
