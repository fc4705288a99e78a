"""``noack design``: the chosen design meets the limits, and is written as a valid scenario."""

import json
import math
import re
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result

from cosim.analysis.scenario_certificates import quick_certificate
from cosim.simulation.continuous import run_continuous
from cosim.simulation.exact_simulation import run_batch, setting_of
from cosim.studies.campaign.random_draws import box_of
from cosim.studies.design.design_search import DesignLimits, DesignResult, design, measure
from cosim.studies.design.design_space import families_of, lqr_gain
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import dumps, load
from tests.cosim.studies.design.conftest import LIMITS
from tests.helpers.approved import compare_lines
from tests.helpers.command_line import invoke

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
def scalar_file(tmp_path: Path) -> Path:
    path = tmp_path / "one.toml"
    path.write_text(ONE)
    return path


@pytest.fixture
def run_design(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Design:
    """Runs the command with few draws and rounds; its page is ``p.html``; words replace these."""
    monkeypatch.setattr("cosim.studies.design.design_search._MOST_ROUNDS", 3)

    def run(scenario: Path, *words: str) -> Result:
        defaults = {"--settling": "9", "--quantile": "0.5", "--draws": "20", "--weights": "identity",
                    "--page": str(tmp_path / "p.html")}  # fmt: skip
        left = [word for option, value in defaults.items() if option not in words for word in (option, value)]
        return invoke("design", scenario, *left, *words)

    return run


def paper_certificate(path: Path) -> dict[str, Any]:
    result = invoke("certify", path, "--no-search", "--json")
    assert result.exit_code == 0
    certificates = json.loads(result.stdout)["certificates"]
    return [certificate for certificate in certificates if certificate["under"] == "paper"][-1]


@pytest.mark.usefixtures("no_drawing")
def test_check_and_certify_accept_the_written_scenario(
    mass: Path, tmp_path: Path, run_design: Design
) -> None:
    out = tmp_path / "chosen.toml"
    result = run_design(
        mass, "--quantile", "0.8", "--draws", "80", "--gain", "lqr", "--R", "[2.0]",
        "--out", str(out), "--json",
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    document = json.loads(result.stdout)
    best = document["best"]
    assert document["confirmed"]
    assert document["files"] == [str(tmp_path / "p.html"), str(out)]
    scale = float(best["gain"].rpartition(" ")[2])
    A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    K = lqr_gain(A, B, np.eye(2), np.array([[2.0 * scale]]))
    np.testing.assert_array_equal(best["K"], K)
    checked = invoke("check", out, "--json")
    assert checked.exit_code == 0
    scenario = json.loads(checked.stdout)
    assert scenario["model"]["gain"] == best["K"]
    assert scenario["trigger"]["beta"] == best["beta"]
    assert scenario["trigger"]["alpha_per_s"] == best["alpha_per_s"]
    certificate = paper_certificate(out)
    assert "box" in certificate["scope"]
    assert sum(certificate["proven"]["bounds"]["x"].values()) == pytest.approx(best["bounds"]["state"])


@pytest.mark.usefixtures("no_drawing")
def test_a_chosen_norm_is_certified_as_written(scalar_file: Path, tmp_path: Path, run_design: Design) -> None:
    out = tmp_path / "chosen.toml"
    result = run_design(
        scalar_file, "--settling", "4", "--quantile", "0.7", "--draws", "40", "--weights", "input",
        "--bound", "error=0.3", "--bound", "state=2",
        "--out", str(out), "--json",
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    best = json.loads(result.stdout)["best"]
    assert best["weight"] == "input"
    assert best["W"] == [list(row) for row in load(out).decaying.weight or ()]
    error = sum(paper_certificate(out)["proven"]["bounds"]["e_c"].values())
    assert best["bounds"]["error"] == pytest.approx(error / abs(best["W"][0][0]))
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
    message = result.stderr.splitlines()[-1]  # there is progress on a slow machine
    assert message.startswith("noack: no design meets the limits; the closest has a settling")
    assert result.stderr.count("no design meets") == 1
    assert ("trade-off" in result.stdout) == table
    html = (tmp_path / "p.html").read_text()
    assert "<svg" in html
    assert not re.findall(r"<script|<link|(?:src|href)=\"(?!#|data:)", html)
    assert "with the trigger that comes closest to this: 50 % of draws settle within" in html


def test_the_lines_about_mistakes_are_those_that_were_approved(
    mass: Path, scalar_file: Path, run_design: Design
) -> None:
    def mistake(line: str) -> list[str]:
        name, *words = shlex.split(line)
        path = {"mass": mass, "one": scalar_file}[name]
        result = run_design(path, *words)
        assert result.exit_code == 2, result.stderr
        assert result.stderr.count("\n") == 1
        return [result.stderr.strip().replace(str(path), "FILE")]

    compare_lines(Path(__file__).with_name("mistakes.txt"), mistake)


def test_the_chosen_design_settles_in_time_on_draws_of_another_seed(result: DesignResult) -> None:
    assert result.feasible
    assert result.confirmed
    setting = replace(setting_of(resolve(result.scenario)), settle=LIMITS.settle)
    rows = run_batch(setting, box_of(result.scenario).population(99, range(2000)))
    share = float(np.mean(rows["settling_s"] <= LIMITS.settling_s))
    assert share >= LIMITS.quantile
    # 4 standard deviations of the difference of two means
    spread = 4 * np.hypot(result.fresh.halfwidth, 0.12) / 1.96
    assert abs(rows["transmissions"].mean() - result.fresh.transmissions) < spread


def test_the_chosen_design_is_certified_as_required(result: DesignResult, tmp_path: Path) -> None:
    path = tmp_path / "chosen.toml"
    path.write_text(dumps(result.scenario))
    resolved = resolve(load(path))
    certificate = quick_certificate(resolved, "box", ideal=True)
    weight = resolved.decaying.weight
    smallest = 1.0 if weight is None else np.linalg.svd(np.array(weight), compute_uv=False)[-1]
    bound = float(certificate.controller_error(np.zeros(1))[0]) / smallest
    assert bound <= LIMITS.bounds["error"]
    # The bound is the active limit: without it a cheaper design exists.
    assert result.bounds is not None
    assert result.bounds["error"] == pytest.approx(bound)


def test_no_candidate_meets_the_limits_with_fewer_transmissions(result: DesignResult) -> None:
    best = result.best.measured
    assert result.best.full
    assert best.settling_high_s <= LIMITS.settling_s
    cheaper = [t for t in result.trials if t.measured.transmissions < best.transmissions]
    assert len(cheaper) > 10
    for trial in cheaper:
        m = trial.measured
        late = (m.settling_high_s if trial.full else m.settling_s) > LIMITS.settling_s
        assert late or trial.bounds["error"] > LIMITS.bounds["error"], trial


def test_screening_excludes_no_design_that_all_draws_would_choose(result: DesignResult) -> None:
    """Every grid candidate that was only screened out is measured on all draws here."""
    best = result.best.measured
    population = box_of(result.scenario).population(result.seed, range(best.draws))
    rescued = 0
    for trial in result.trials:
        if trial.full or trial.measured.transmissions > best.transmissions:
            continue
        scenario = result.space.families[trial.candidate.family].with_trigger(trial.candidate)
        rescued += measure(scenario, LIMITS, population).settling_high_s <= LIMITS.settling_s
    assert rescued == 0


def test_the_trade_off_curve_contains_the_nondominated_candidates(result: DesignResult) -> None:
    assert len(result.front) > 3
    points = [(t.measured.transmissions, t.measured.settling_s) for t in result.front]
    assert points == sorted(points)
    assert sorted((s for _, s in points), reverse=True) == [s for _, s in points]
    for trial in result.front:
        assert trial.full
        assert trial.bounds["error"] <= LIMITS.bounds["error"]
    for trial in result.trials:
        if trial.bounds.get("error", 0.0) <= LIMITS.bounds["error"]:
            sent, settling_s = trial.measured.transmissions, trial.measured.settling_s
            assert not any(sent < a and settling_s < b for a, b in points)
            better = any(a <= sent and b <= settling_s for a, b in points)
            assert better or trial in result.front or settling_s == math.inf


def test_without_randomness_every_draw_is_the_exact_run(scalar_file: Path) -> None:
    families = families_of(load(scalar_file), ("identity",), None)
    result = design(families, DesignLimits(4.0, 0.5, 0.02, {}), draws=20, seed=0)
    assert result.confirmed
    assert result.fresh.halfwidth == 0
    assert result.fresh.settling_high_s == result.fresh.settling_s
    exact = run_continuous(resolve(result.scenario))
    assert result.fresh.transmissions == len(exact.event_s)
    x = exact.at([result.fresh.settling_s]).x
    assert abs(float(x[0, 0])) == pytest.approx(0.02, rel=1e-6)
