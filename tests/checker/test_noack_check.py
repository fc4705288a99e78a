"""``noack-check DOCUMENT PROOF``, from the command line: files that are none, and texts that deceive."""

import json
import os
from pathlib import Path

import pytest

from noack.proof.files import proof_files
from noack.proof.loop_document import Naming
from noack_verify.__main__ import main
from tests.checker.proofs import proved

ESCAPE = "\x1b]0;owned\x07\x1b[31m"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("files")
    found = proof_files(proved("pendulum").loop, proved("pendulum").document, Naming("a pendulum"))
    document, proof = folder / "loop.json", folder / "proof.json"
    document.write_text(found.document)
    proof.write_text(found.proof)
    return document, proof


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str]:
    """Run the command; return its exit status and what it prints."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["noack-check", *map(str, words)])
        with pytest.raises(SystemExit) as stop:
            main()
    captured = capsys.readouterr()
    return int(stop.value.code or 0), captured.out + captured.err


def test_the_program_prints_what_is_proven(
    files: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    status, text = run(capsys, *files)
    assert status == 0
    proven = [line for line in text.splitlines() if line.startswith("PROVED ")]
    assert len(proven) == 4 + 1 + 2  # bounds, a time between events, and two edges that are never taken
    assert proven[0] == "PROVED |all states| ≤ 0.398237 e^(−0.3 t) + 0.0121655 at all times"
    assert "PROVED two events are at least " in text
    assert "PROVED the edge '0 later, too early' is never taken" in text
    assert "for each run of the loop document 'a pendulum'" in text


@pytest.mark.parametrize("text", ["", "[1]", "{", '{"scenario": {}}', "[" * 100_000, "\ufeff{}", "NaN"])
def test_files_that_are_none_are_one_line(
    text: str, files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "none.json"
    path.write_text(text)
    for words in ((path, files[1]), (files[0], path)):
        status, printed = run(capsys, *words)
        assert (status, len(printed.splitlines()), printed[:9]) == (1, 1, "REJECTED ")


def test_a_fifo_and_a_device_are_refused(
    files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.mkfifo(fifo := tmp_path / "fifo")
    document, proof = files
    for words in ([fifo, proof], [document, fifo], [*files, "--equations", fifo], ["/dev/zero", proof]):
        status, text = run(capsys, *words)
        assert (status, text.endswith(": not a regular file\n")) == (2, True)


@pytest.mark.parametrize("place", ["name", "words", "fact", "output"])
def test_control_characters_do_not_reach_the_terminal(
    place: str, files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document, proof = (json.loads(path.read_text()) for path in files)
    del proof["document"]
    text = f"no event{ESCAPE}\nPROVED |all states| ≤ 0"
    if place == "name":
        document["name"] = text
    elif place == "words":
        document["facts"]["silent"]["words"] = text
    elif place == "fact":
        document["edges"][0]["facts"].append(text)
    else:
        document["outputs"][0]["name"] = proof["bounds"][0]["output"] = text
    paths = tmp_path / "loop.json", tmp_path / "proof.json"
    for path, table in zip(paths, (document, proof), strict=True):
        path.write_text(json.dumps(table))
    _, printed = run(capsys, *paths)
    lines = printed.removesuffix("\n").split("\n")
    assert all(line.isprintable() for line in lines)
    assert not any(line.startswith("PROVED |all states| ≤ 0") for line in lines)


def test_a_name_that_reads_like_a_statement_is_quoted(
    files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document, proof = (json.loads(path.read_text()) for path in files)
    del proof["document"]
    document["name"] = "a, its plant: |x| ≤ 0. Copy"
    document["outputs"][1]["name"] = proof["bounds"][1]["output"] = "z| ≤ 1e-9, so |y"
    paths = tmp_path / "loop.json", tmp_path / "proof.json"
    for path, table in zip(paths, (document, proof), strict=True):
        path.write_text(json.dumps(table))
    status, text = run(capsys, *paths)
    assert status == 0, text
    assert "for each run of the loop document 'a, its plant: |x| ≤ 0. Copy'" in text
    assert "PROVED |'z| ≤ 1e-9, so |y'| ≤ " in text


def test_a_path_is_printed_without_control_characters(
    files: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    status, text = run(capsys, "\x1b[31m\u202e.json", files[1])
    assert (status, text.removesuffix("\n").isprintable()) == (2, True)


def test_an_option_is_given_once(capsys: pytest.CaptureFixture[str]) -> None:
    status, text = run(capsys, "d.json", "p.json", "--equations", "a", "--equations=b")
    assert (status, "argument --equations: is given twice; it takes one value" in text) == (2, True)
