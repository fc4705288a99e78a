"""``noack conform``, from the command line."""

import json
from pathlib import Path

import pytest

from cosim.analysis.conformance import run_conformance
from cosim.analysis.conformance.verdicts import (
    Conformance,
    EdgeKind,
    Failed,
    Failure,
    Place,
    Transition,
    Unknown,
)
from netem.core.errors import ExitStatus
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


def test_a_run_that_is_refuted_is_an_exit_status_and_a_reason(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unknown = Unknown(Transition("3 lost", EdgeKind.EVENT, Place(False, False, 4)), 3)
    failure = Failure(1.5, Failed.EDGE, "3 lost", unknown=unknown)
    refuted = Conformance("a loop", 1.5, failure, {"sent": 3}, {"0 lost": 1.5})
    monkeypatch.setattr(run_conformance, "conformance_of", lambda *_: refuted)
    result = invoke("conform", "--runs", runs / "unstable_pendulum")
    assert result.exit_code == ExitStatus.FAILED
    text = "until 1.5 s only: 4 packets were lost in a row, at most 3 are allowed"
    assert text in " ".join(result.output.split())


def test_a_run_without_a_document_is_refused_in_one_line(runs: Path) -> None:
    result = invoke("conform", "--runs", runs / "lane_acknowledged")
    assert result.exit_code == ExitStatus.CALLER
    assert "nothing is proved of the loop, so there is no loop document to compare" in result.stderr
