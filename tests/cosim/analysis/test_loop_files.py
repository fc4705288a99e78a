"""``noack certify --document --proof``, ``noack check --document`` and ``noack-check DOCUMENT PROOF``."""

import json
from pathlib import Path

import pytest

from cosim.analysis.loop_files import loop_files
from cosim.analysis.witness_store import INDEX, SHIPPED
from cosim.analysis.witnesses import find_witnesses
from cosim.shipped_files import shipped_names
from netem.core.errors import ExitStatus
from noack.scenario.resolution import ResolvedRun
from noack_verify.__main__ import main
from tests.helpers.command_line import invoke
from tests.helpers.shipped import shipped

OF_ANOTHER = "the proof is one of another document: it names another SHA-256"


def noack_check(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str]:
    """Run noack-check; return its exit status and output."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["noack-check", *map(str, words)])
        with pytest.raises(SystemExit) as stop:
            main()
    captured = capsys.readouterr()
    return int(stop.value.code or 0), captured.out + captured.err


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("files")
    loop, proof = folder / "loop.json", folder / "proof.json"
    result = invoke("certify", "unstable_pendulum", "--no-search", "--document", loop, "--proof", proof)
    assert result.exit_code == ExitStatus.OK, result.output
    assert f"noack-check {loop} {proof} verifies them" in result.stderr
    return loop, proof


def test_noack_check_proves_the_bounds_that_certify_prints(
    files: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    status, output = noack_check(capsys, *files)
    assert status == ExitStatus.OK
    printed = " ".join(invoke("certify", "unstable_pendulum", "--no-search").output.split())
    assert "PROVED |angle| ≤ 0.23597" in output
    assert "in which a fact is 'silent': no event: the comparison is at most the threshold" in output
    assert "|angle| ≤ 0.236 e^(−0.3t)" in printed
    assert (
        "for each run of the loop document 'unstable_pendulum: all plants of its uncertainty under its "
        "schedule'" in output
    )


def test_noack_check_rejects_a_lower_bound(
    files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    proof = json.loads(files[1].read_text())
    proof["bounds"][0]["levels"][0] *= 0.99
    (changed := tmp_path / "proof.json").write_text(json.dumps(proof))
    status, output = noack_check(capsys, files[0], changed)
    assert (status, output.splitlines()[0][:50]) == (1, "REJECTED all states: not proven at output/0 lost/0")


def test_noack_check_rejects_the_document_of_another_loop(
    files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (changed := tmp_path / "loop.json").write_text(files[0].read_text().replace("unstable", "stable"))
    status, output = noack_check(capsys, changed, files[1])
    assert (status, output) == (1, f"REJECTED {OF_ANOTHER}\n")


def test_noack_check_needs_both_files_in_their_order(
    files: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    status, output = noack_check(capsys, files[0])
    assert (status, output.splitlines()[-1].split(": ")[-1]) == (2, "proof")
    status, output = noack_check(capsys, files[1], files[0])
    assert (status, output[:8]) == (1, "REJECTED")
    assert output.endswith("the order is: noack-check DOCUMENT PROOF\n")


def test_files_that_cannot_be_read_are_named(
    files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    none = tmp_path / "none.json"
    assert noack_check(capsys, none, files[1]) == (2, f"noack-check: {none}: No such file or directory\n")
    assert noack_check(capsys, tmp_path, files[1]) == (2, f"noack-check: {tmp_path}: not a regular file\n")


def test_the_document_in_words_has_all_that_is_in_the_file(files: tuple[Path, Path]) -> None:
    words = invoke("check", "unstable_pendulum", "--document").output
    table = json.loads(files[0].read_text())
    assert all(
        f"- corner {k} as corner 1, but d/dt" in words for k in range(2, len(table["motions"]["driven"]) + 1)
    )
    for key in ("coordinates", "locations", "edges", "outputs"):
        assert all(entry["name"] in words for entry in table[key])
    assert all(name in words for name in table["facts"])
    assert json.loads(invoke("check", "unstable_pendulum", "--document", "--json").output) == table


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("certify", "unstable_pendulum", "--document", "a.json"), "noack-check needs both files"),
        (("check", "lane_acknowledged", "--document"), "there is no proof: "),
    ],
)
def test_what_has_no_document_is_said_in_one_line(words: tuple[str, ...], line: str) -> None:
    result = invoke(*words)
    assert (result.exit_code, line in result.stderr) == (ExitStatus.CALLER, True), result.stderr


def test_noack_check_proves_bounds_by_gains(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of a loop that has no forms the second verifier reads both files."""
    loop, proof = tmp_path / "loop.json", tmp_path / "proof.json"
    result = invoke("certify", "lane_5g_urban", "--no-search", "--document", loop, "--proof", proof)
    assert result.exit_code == ExitStatus.OK, result.output
    status, output = noack_check(capsys, loop, proof)
    assert status == ExitStatus.OK
    assert "PROVED |lateral offset| ≤ 222.541 e^(−0.25 t) m at all times" in output
    assert "where an update that is not lost acts within 144 ms; the first input within 144 ms" in output
    assert "by small gains, which" in output
    words = invoke("check", "lane_5g_urban", "--document").output
    assert "at most 0 updates in a row are lost" in words
    assert json.loads(invoke("check", "lane_5g_urban", "--document", "--json").output)["losses"] == 0
    loop.write_text(loop.read_text().replace('"losses":0', '"losses":1'))
    assert noack_check(capsys, loop, proof) == (1, f"REJECTED {OF_ANOTHER}\n")


def test_bounds_that_are_smaller_by_gains_have_files_of_their_own(
    files: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    """|W e_c| of the pendulum is at most 0.1310 by gains, and 0.1436 by forms."""
    pair = [path.with_suffix(".gains.json") for path in files]
    status, output = noack_check(capsys, *pair)
    assert status == ExitStatus.OK
    assert "PROVED |error of the controller's model| ≤ " in output
    assert "by small gains, which" in output
    loop = json.loads(pair[0].read_text())
    assert loop["name"] == json.loads(files[0].read_text())["name"]


def test_noack_check_proves_what_a_plants_equations_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both programs are named; without the equations the statement is about the document only."""
    loop, proof, equations = (tmp_path / name for name in ("loop.json", "proof.json", "equations.txt"))
    options = ("--no-search", "--document", loop, "--proof", proof, "--equations", equations)
    result = invoke("certify", "sine_pendulum", *options)
    assert result.exit_code == ExitStatus.OK, result.output
    assert f"noack-check {loop} {proof} --equations {equations} verifies them" in result.stderr
    status, output = noack_check(capsys, loop, proof, "--equations", equations)
    assert status == ExitStatus.OK
    assert "PROVED |angle| ≤ 0.519534" in output
    assert "PROVED the document allows all that the equations with the SHA-256" in output
    assert "lines of Python verified" in output
    assert "further lines verified" in output
    status, output = noack_check(capsys, loop, proof)
    assert status == ExitStatus.OK
    assert "This is about the document only." in output
    assert "d/dt rate = 9.569 angle − 0.1 rate + u0" in invoke("check", "sine_pendulum", "--document").output
    equations.write_text(equations.read_text().replace("9.81", "9.82"))
    status, output = noack_check(capsys, loop, proof, "--equations", equations)
    assert status == 1
    assert output.splitlines()[-1].startswith("REJECTED the document is about equations with the SHA-256")


def test_equations_are_written_beside_a_document_only(tmp_path: Path) -> None:
    result = invoke("certify", "sine_pendulum", "--no-search", "--equations", tmp_path / "equations.txt")
    assert result.exit_code == ExitStatus.CALLER
    assert "add --document FILE and --proof FILE" in result.stderr


def test_each_shipped_proof_has_its_file() -> None:
    index = json.loads((SHIPPED / INDEX).read_text())
    assert {path.name for path in SHIPPED.glob("*.json")} == {INDEX, *index.values()}


@pytest.mark.deep
@pytest.mark.parametrize("name", shipped_names("scenarios"))
def test_the_kernel_accepts_all_documents_of_a_shipped_scenario(name: str) -> None:
    """Its levels are those that the checker has proven, which are printed."""
    for loop in ResolvedRun(shipped(name)).loops:
        for statement in find_witnesses(loop, most_work=0.0).statements:
            if statement.document is None or not statement.document.get("bounds"):
                continue
            if loop.trigger.policy == "dynamic":
                continue
            proven = {(s.output, s.from_start): s for s in loop_files(loop, statement).verify().bounds}
            assert proven
