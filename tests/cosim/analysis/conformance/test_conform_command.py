"""``noack conform``, from the command line."""

import json
from pathlib import Path

import pytest

from noack.core.errors import ExitStatus
from tests.helpers.command_line import invoke


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    for name in ("unstable_pendulum", "lane_acknowledged"):
        words = ("--no-report", "--set", "horizon_s=2", "--runs", folder / name)
        assert invoke("simulate", name, *words).exit_code == ExitStatus.OK
    return folder


def test_a_run_conforms(runs: Path) -> None:
    result = invoke("conform", "--runs", runs / "unstable_pendulum", "--json")
    found = json.loads(result.stdout)
    assert (result.exit_code, found["conforms"], found["reason"]) == (ExitStatus.OK, True, "")
    assert found["transitions"]["0 lost, silent"] > 100
    printed = " ".join(invoke("conform", "--runs", runs / "unstable_pendulum").output.split())
    document = "'unstable_pendulum: all plants of its uncertainty under its schedule'"
    assert f"the run is a run of the loop document {document}, so" in printed


def test_the_document_may_be_that_of_the_plant_itself(runs: Path) -> None:
    assert (
        invoke("conform", "--runs", runs / "unstable_pendulum", "--plants", "own").exit_code == ExitStatus.OK
    )


def test_the_document_of_a_plant_given_by_equations_needs_no_option(tmp_path: Path) -> None:
    words = ("--no-report", "--set", "horizon_s=1", "--runs", tmp_path)
    assert invoke("simulate", "friction_servo", *words).exit_code == ExitStatus.OK
    found = json.loads(invoke("conform", "--runs", tmp_path, "--json").stdout)
    assert (found["conforms"], found["document"]) == (
        True,
        "friction_servo: the plant's equations under its schedule",
    )


def test_a_run_that_another_loop_made_is_refuted(runs: Path) -> None:
    """The scenario of the record is changed: its document has another threshold."""
    (path,) = (runs / "unstable_pendulum").glob("2*/scenario.toml")
    text = path.read_text()
    try:
        path.write_text(text.replace("beta = 0.02", "beta = 0.0199"))
        result = invoke("conform", path.parent, "--json")
    finally:
        path.write_text(text)
    if result.exit_code == ExitStatus.CALLER:  # no proof of the other loop is known
        assert "there is no" in result.stderr
        return
    assert (result.exit_code, json.loads(result.stdout)["conforms"]) == (ExitStatus.FAILED, False)


def test_a_run_without_a_document_is_refused_in_one_line(runs: Path) -> None:
    result = invoke("conform", "--runs", runs / "lane_acknowledged")
    assert result.exit_code == ExitStatus.CALLER
    assert "nothing is proved of the loop, so there is no loop document to compare" in result.stderr
