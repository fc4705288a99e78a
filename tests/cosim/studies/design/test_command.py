"""``noack design``: it writes a valid scenario; mistakes give one line."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result
from typer.testing import CliRunner

from cosim.cli import app
from cosim.studies.design.design_space import lqr_gain
from noack.scenario.scenario_file import load

ONE = """
name = "one"
horizon_s = 10.0
[model]
A = [[1.0]]
B = [[1.0]]
gain = [[-3.0]]
[plant]
initial_state = [1.0]
[trigger]
beta = 0.5
alpha_per_s = 0.25
[network]
mansd = 2
loss = { model = "worst_case" }
"""
Design = Callable[..., Result]


@pytest.fixture
def one(tmp_path: Path) -> Path:
    path = tmp_path / "one.toml"
    path.write_text(ONE)
    return path


@pytest.fixture
def run_design(tmp_path: Path) -> Design:
    """Runs the command with few draws; its page is ``p.html``."""

    def run(scenario: Path, *words: str) -> Result:
        defaults = ("--settling", "9", "--quantile", "0.5", "--draws", "20", "--weights",
                    "identity", "--page", str(tmp_path / "p.html"))  # fmt: skip
        return CliRunner().invoke(app, ["design", str(scenario), *defaults, *words])

    return run


def paper_certificate(path: Path) -> dict[str, Any]:
    result = CliRunner().invoke(app, ["certify", str(path), "--json"])
    assert result.exit_code == 0
    found = json.loads(result.stdout)["certificates"]
    return [one for one in found if one["under"] == "paper"][-1]


def test_check_and_certify_accept_the_written_scenario(
    mass: Path, tmp_path: Path, run_design: Design
) -> None:
    out = tmp_path / "chosen.toml"
    result = run_design(
        mass, "--quantile", "0.8", "--draws", "80", "--gain", "lqr", "--R", "[2.0]",
        "--out", str(out), "--json",
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    found = json.loads(result.stdout)
    best = found["best"]
    assert found["confirmed"]
    assert found["files"] == [str(tmp_path / "p.html"), str(out)]
    scale = float(best["gain"].rpartition(" ")[2])
    A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    K = lqr_gain(A, B, np.eye(2), np.array([[2.0 * scale]]))
    np.testing.assert_array_equal(best["K"], K)
    checked = CliRunner().invoke(app, ["check", str(out), "--json"])
    assert checked.exit_code == 0
    scenario = json.loads(checked.stdout)
    assert scenario["model"]["gain"] == best["K"]
    assert scenario["trigger"]["beta"] == best["beta"]
    assert scenario["trigger"]["alpha_per_s"] == best["alpha_per_s"]
    certificate = paper_certificate(out)
    assert "box" in certificate["scope"]
    assert certificate["constants"]["state"] == pytest.approx(best["bounds"]["state"])


def test_a_chosen_norm_and_gain_are_certified_as_written(
    one: Path, tmp_path: Path, run_design: Design
) -> None:
    out = tmp_path / "chosen.toml"
    result = run_design(
        one, "--settling", "4", "--quantile", "0.7", "--draws", "40", "--gain", "lqr",
        "--weights", "chosen", "--bound", "error=0.3", "--bound", "state=2",
        "--out", str(out), "--json",
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    best = json.loads(result.stdout)["best"]
    assert best["weight"] == "chosen"
    assert best["W"] == [list(row) for row in load(out).decaying.weight or ()]
    delta = paper_certificate(out)["constants"]["delta"]
    assert best["bounds"]["error"] == pytest.approx(delta * best["beta"] / abs(best["W"][0][0]))
    assert best["bounds"]["error"] <= 0.3
    assert best["bounds"]["state"] <= 2


@pytest.mark.parametrize(
    ("words", "table"),
    [
        (["--settling", "1"], True),
        (["--settle", "1e-9"], False),  # no run settles
        (["--set", "plant.initial_state=[1e300, 0.0]"], False),  # beyond 1e100: diverged
    ],
)
def test_limits_that_cannot_be_met_give_a_page_and_one_line(
    mass: Path, tmp_path: Path, run_design: Design, words: list[str], table: bool
) -> None:
    out = tmp_path / "chosen.toml"
    result = run_design(mass, *words, "--out", str(out))
    assert result.exit_code == 1
    assert not out.exists()
    assert result.stderr.startswith("noack: no design meets the limits; the closest has a settling")
    assert result.stderr.count("\n") == 1
    assert ("trade-off" in result.stdout) == table
    html = (tmp_path / "p.html").read_text()
    assert "<svg" in html
    assert not re.findall(r"<script|<link|(?:src|href)=\"(?!#|data:)", html)


UNSTABLE = ["--set", "model.gain=[[-0.5]]", "--set", "model.allow_unstable=true"]


@pytest.mark.parametrize(
    ("scenario", "words", "expected"),
    [
        ("mass", ["--settling", "30"], "beyond horizon_s = 20"),
        ("mass", ["--settling", "-1"], "--settling: must be positive"),
        ("mass", ["--quantile", "1"], "between 0 and 1"),
        ("mass", ["--settle", "1"], "--settle: must be between 0 and 1"),
        ("mass", ["--under", "theory"], "--under: paper or schedule"),
        ("mass", ["--bound", "gain=3"], "write it as state=X or error=X"),
        ("mass", ["--bound", "state=x"], "write it as state=X or error=X"),
        ("mass", ["--bound", "error=1", "--bound", "error=2"], "error is given twice"),
        ("mass", ["--weights", "best"], "identity, given, chosen"),
        ("mass", ["--weights", ""], "name one at least of identity"),
        ("mass", ["--Q", "[1, 1]"], "for --gain lqr only"),
        ("mass", ["--gain", "lqr", "--Q", "[1]"], "2 x 2 numbers by rows"),
        ("mass", ["--quantile", "0.95"], "are too few for the quantile 0.95"),
        ("mass", ["--set", "model.gain=[[1.0, 1.0]]"], "u = -K x does: give -K"),
        ("mass", ["--set", "plant.initial_state=[0.0, 0.0]"], "initial_state: is 0"),
        ("mass", ["--set", 'trigger={policy="absolute", delta=1.0}'], "trigger.policy"),
        (
            "mass",
            ["--set", "plant.initial_state_halfwidth=[0.1, 0.1]", "--bound", "error=1"],
            "initial_state_halfwidth",
        ),
        ("mass", ["--out", "no/such/folder/x.toml"], "there is no folder"),
        ("one", ["--set", "trigger.floor=3"], "trigger.floor = 3: must be less than the largest β"),
        ("one", ["--set", 'mode="zoh"', "--weights", "chosen"], "models that hold do not decay"),
        ("one", UNSTABLE, "not stable; --gain lqr chooses another"),
        ("one", [*UNSTABLE, "--weights", "chosen"], "--gain lqr chooses another"),
        ("one", ["--set", 'network.protocol="ack"'], "network.protocol"),
        ("one", ["--weights", "given"], "the scenario has no trigger.weight"),
    ],
)
def test_mistakes_are_one_line(
    request: pytest.FixtureRequest, run_design: Design, scenario: str, words: list[str],
    expected: str,
) -> None:  # fmt: skip
    result = run_design(request.getfixturevalue(scenario), *words)
    assert result.exit_code == 2, result.stderr
    assert result.stderr.count("\n") == 1
    assert expected in result.stderr


def test_a_loop_without_a_certificate_is_reported(one: Path, run_design: Design) -> None:
    result = run_design(
        one, "--settling", "4", "--bound", "error=1", "--under", "schedule",
        "--set", "plant.rate_hz=2", "--set", "controller.rate_hz=2",
    )  # fmt: skip
    assert result.exit_code == 1
    assert "no certified bound of sup‖e_c‖ (1 allowed)" in result.stderr
