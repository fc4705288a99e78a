"""Witnesses that were found earlier: used, proven again each time, and ignored where they are damaged."""

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from cosim.analysis.witness_store import INDEX, SHIPPED
from cosim.analysis.witnesses import WitnessedStatement, find_statement
from noack.proof.elaborate.loop import Loop
from noack.theory.witnesses.documents import Witness, witness_by_gains
from noack.theory.witnesses.effort import NoWitnessError
from tests.checker.proofs import proved
from tests.helpers.shipped import resolved


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("cosim.analysis.witness_store.SHIPPED", tmp_path / "none")
    return tmp_path / "noack" / "witnesses"


@pytest.fixture(scope="module")
def witness() -> Witness:
    """What is found of the loop below."""
    found = proved("of_scenario")
    return Witness(found.document, found.proof)


@pytest.fixture
def searches(witness: Witness, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The limits of the searches that were made; the loop need not be that of the witness."""
    made = list[float]()

    def search(*given: Any, most_work: float, **options: Any) -> Witness:
        made.append(most_work)
        if most_work < 1:
            raise NoWitnessError("the limit of work")
        return witness

    monkeypatch.setattr("cosim.analysis.witnesses.find_witness", search)
    return made


def found(*settings: str, most_work: float = 20.0) -> WitnessedStatement:
    scenario = resolved("double_integrator", *settings)
    return find_statement(scenario, "own", "schedule", most_work=most_work)


def test_a_witness_is_found_once_for_the_same_numbers(folder: Path, searches: list[float]) -> None:
    first = found()
    assert first.proof is not None
    assert found("horizon_s=3", "seeds.loss=7").document == first.document
    assert len(searches) == 1
    (file,) = folder.iterdir()
    assert file.stat().st_mode & 0o777 == 0o600
    assert folder.stat().st_mode & 0o777 == 0o700
    found("trigger.beta=0.06")
    assert len(searches) == 2


def _with_smaller_bounds(content: dict[str, Any]) -> str:
    for bound in content["document"]["bounds"]:
        bound["numbers"]["level 1"] *= 0.5
    return json.dumps(content)


@pytest.mark.parametrize(
    "change",
    [
        _with_smaller_bounds,
        lambda content: json.dumps(content)[:1000],
        lambda content: "[" * 100_000,
        lambda content: json.dumps([content]),
        lambda content: json.dumps({**content, "document": {"rate": "fast"}}),
    ],
)  # fmt: skip
def test_a_document_that_was_changed_is_not_used(
    folder: Path, searches: list[float], change: Callable[[dict[str, Any]], str]
) -> None:
    first = found()
    (file,) = folder.iterdir()
    file.write_text(change(json.loads(file.read_text())))
    assert found().document == first.document
    assert len(searches) == 2
    assert found().document == first.document
    assert len(searches) == 2  # it has been replaced


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="needs root")
def test_a_file_of_another_user_is_not_used(folder: Path, searches: list[float]) -> None:
    found()
    (file,) = folder.iterdir()
    os.chown(file, 65534, 65534)
    found()
    assert len(searches) == 2


def test_a_search_that_found_nothing_is_not_repeated_unless_it_may_be_longer(
    folder: Path, searches: list[float]
) -> None:
    first = found(most_work=0.2)
    assert "limit of work" in first.reason
    assert found(most_work=0.1) == first
    assert searches == [0.2]
    assert found().proof is not None
    assert len(searches) == 2


def test_a_short_search_does_not_count_for_a_longer_one(folder: Path, searches: list[float]) -> None:
    """That of a run may find larger bounds, even where it finds all."""
    for most_work in (2.0, 20.0, 2.0):
        assert found(most_work=most_work).proof is not None
    assert searches == [2.0, 20.0]


def test_bounds_by_gains_alone_are_searched_again_if_the_search_may_be_longer(
    folder: Path, witness: Witness, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = list[float]()

    def search(loop: Loop, outputs: Sequence[str], *, most_work: float, **options: Any) -> Witness:
        made.append(most_work)
        return witness if most_work > 1 else witness_by_gains(loop, outputs)

    monkeypatch.setattr("cosim.analysis.witnesses.find_witness", search)
    for most_work, is_by_gains in ((0.0, True), (0.2, True), (0.1, True), (20.0, False), (0.0, False)):
        document = found(most_work=most_work).document
        assert document is not None
        assert ("bounds" not in document) == is_by_gains
    assert made == [0.2, 20.0]


def test_a_folder_that_cannot_be_written_costs_nothing_but_time(
    tmp_path: Path, searches: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert found().proof is not None


def test_a_proof_of_the_package_is_used_without_a_search(
    folder: Path, searches: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cosim.analysis.witness_store.SHIPPED", SHIPPED)
    shipped = found()
    assert shipped.proof is not None
    assert (searches, folder.exists()) == ([], False)
    assert found("trigger.beta=0.07").proof is None or searches  # another loop is searched


@pytest.mark.parametrize("index", ["", "[]", "{", '{"a": "b"}'])
def test_a_damaged_index_of_the_package_counts_as_missing(
    folder: Path, searches: list[float], index: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / INDEX).write_text(index)
    monkeypatch.setattr("cosim.analysis.witness_store.SHIPPED", tmp_path)
    assert found().proof is not None
    assert searches == [20.0]
    assert folder.exists()
