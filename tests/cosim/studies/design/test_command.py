"""``noack design``: it writes a valid scenario; mistakes give one line."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cosim.cli import app
from cosim.studies.design.design_page import page
from cosim.studies.design.design_result import DesignResult
from cosim.studies.design.loop_families import lqr_gain


def run(*words: str) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, words)
    return result.exit_code, result.stdout, result.stderr


def test_check_and_certify_accept_the_written_scenario(mass: Path, tmp_path: Path) -> None:
    out, html = tmp_path / "chosen.toml", tmp_path / "chosen.html"
    status, stdout, stderr = run(
        "design", str(mass), "--settling", "9", "--quantile", "0.8", "--draws", "80",
        "--weights", "identity", "--gain", "lqr", "--R", "[2.0]", "--out", str(out),
        "--page", str(html), "--json",
    )  # fmt: skip
    assert status == 0, stderr
    found = json.loads(stdout)
    assert found["confirmed"]
    assert found["files"] == [str(html), str(out)]
    scale = float(found["best"]["gain"].rpartition(" ")[2])
    A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    K = lqr_gain(A, B, np.eye(2), np.array([[2.0 * scale]]))
    np.testing.assert_array_equal(found["best"]["K"], K)

    status, stdout, _ = run("check", str(out), "--json")
    assert status == 0
    checked = json.loads(stdout)
    assert checked["model"]["gain"] == found["best"]["K"]
    assert checked["trigger"]["beta"] == found["best"]["beta"]
    assert checked["trigger"]["alpha_per_s"] == found["best"]["alpha_per_s"]

    status, stdout, _ = run("certify", str(out), "--json")
    (certificate,) = (
        one for one in json.loads(stdout)["certificates"]
        if one["under"] == "paper" and "box" in one["scope"]
    )  # fmt: skip
    assert status == 0
    assert certificate["constants"]["state"] == pytest.approx(found["best"]["bounds"]["state"])


def test_limits_that_cannot_be_met_write_no_scenario(mass: Path, tmp_path: Path) -> None:
    out = tmp_path / "chosen.toml"
    status, stdout, stderr = run(
        "design", str(mass), "--settling", "1", "--draws", "40", "--quantile", "0.5",
        "--weights", "identity", "--out", str(out), "--page", str(tmp_path / "p.html"),
    )  # fmt: skip
    assert status == 1
    assert not out.exists()
    assert stderr.startswith("noack: no design meets the limits; the closest has ")
    assert stderr.count("\n") == 1
    assert "trade-off" in stdout


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--settling", "30"], "beyond horizon_s = 20"),
        (["--settling", "-1"], "--settling: must be positive"),
        (["--settling", "9", "--quantile", "1"], "between 0 and 1"),
        (["--settling", "9", "--bound", "gain=3"], "write it as state=X or error=X"),
        (["--settling", "9", "--bound", "state=x"], "write it as state=X or error=X"),
        (["--settling", "9", "--weights", "best"], "identity, given, chosen"),
        (["--settling", "9", "--Q", "[1, 1]"], "for --gain lqr only"),
        (["--settling", "9", "--gain", "lqr", "--Q", "[1]"], "2 x 2 numbers by rows"),
        (["--settling", "9", "--draws", "20"], "are too few for the quantile 0.95"),
        (["--settling", "9", "--set", "model.gain=[[1.0, 1.0]]"], "u = -K x does: give -K"),
        (["--settling", "9", "--set", "plant.initial_state=[0.0, 0.0]"], "initial_state: is 0"),
        (["--settling", "9", "--set", 'trigger={policy="absolute", delta=1.0}'], "trigger.policy"),
        (["--settling", "9", "--out", "no/such/folder/x.toml"], "there is no folder"),
    ],
)
def test_mistakes_are_one_line(mass: Path, words: list[str], said: str) -> None:
    if "--weights" not in words:
        words = [*words, "--weights", "identity"]
    status, _, stderr = run("design", str(mass), *words)
    assert status == 2, stderr
    assert stderr.count("\n") == 1
    assert said in stderr


def test_the_page_is_self_contained(found: DesignResult) -> None:
    html = page(found)
    assert "<svg" in html
    assert found.verdict() in html
    assert not re.findall(r"<script|<link|(?:src|href)=\"(?!#|data:)", html)
    assert html.count("<tr>") == len(found.front) + 1
