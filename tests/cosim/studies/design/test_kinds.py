"""Other kinds of design: a hold, the schedule, a single state, the worst-case losses."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cosim.simulation.batch.batch_interface import run_batch, setting_of
from cosim.simulation.continuous.continuous_loop import continuous_loop_of
from cosim.simulation.continuous.continuous_run import simulate_continuous
from cosim.simulation.continuous.network_fates import network_fates
from cosim.studies.campaign.random_draws import box_of
from cosim.studies.design.candidate_measures import DesignLimits, certificate_of
from cosim.studies.design.design_search import design
from cosim.studies.design.loop_families import families_of
from noack.config.resolution import resolve
from noack.config.scenario import Scenario
from noack.config.scenario_file import load
from tests.cosim.studies.design.conftest import designed
from tests.cosim.studies.design.test_command import run

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


@pytest.fixture
def one(tmp_path: Path) -> Path:
    path = tmp_path / "one.toml"
    path.write_text(ONE)
    return path


def largest_errors(scenario: Scenario, seeds: range) -> list[float]:
    """sup‖e_c‖ over 2,000 times of exact runs, with the scenario's own plants and losses."""
    found = []
    for seed in seeds:
        drawn = scenario.seeds.model_copy(update={"plant": seed, "loss": seed})
        resolved = resolve(scenario.model_copy(update={"seeds": drawn}))
        exact = simulate_continuous(
            continuous_loop_of(resolved), horizon_s=10.0,
            delivered=network_fates(resolved), known_start=False,
        )  # fmt: skip
        samples = exact.at(np.linspace(0.0, 10.0, 2000))
        found.append(float(np.linalg.norm(samples.e_c, axis=1).max()))
    return found


def test_a_hold_is_designed_like_a_model(mass: Path) -> None:
    limits = DesignLimits(9.0, 0.8, 0.02, {"error": 0.3})
    scenario = load(mass, ['mode="zoh"'])
    found = design(families_of(scenario, ("identity",), None), limits, draws=60, seed=3)
    assert found.feasible
    assert found.bounds is not None
    assert found.scenario.mode == "zoh"
    rows = run_batch(
        replace(setting_of(resolve(found.scenario)), settle=0.02),
        box_of(scenario).population(99, range(400)),
    )
    assert np.mean(rows["settling_s"] <= 9.0) >= 0.8
    assert max(largest_errors(found.scenario, range(5))) <= found.bounds["error"] <= 0.3


def test_a_bound_under_the_schedule_is_that_of_the_scheduled_certificate(
    scenario: Scenario,
) -> None:
    """A real loop samples, holds and delays, so its certified bound is never smaller."""
    limits = DesignLimits(9.0, 0.8, 0.02, {"error": 0.2}, schedule=True)
    found = designed(scenario, limits, draws=60)
    assert found.feasible
    scheduled, ideal = (
        certificate_of(found.scenario, replace(limits, schedule=schedule)).constants
        for schedule in (True, False)
    )
    assert scheduled is not None
    assert ideal is not None
    assert scheduled.state > ideal.state
    assert found.bounds is not None
    assert found.bounds["state"] == pytest.approx(scheduled.state)
    assert found.document()["limits"]["under"] == "schedule"


def test_a_chosen_norm_and_gain_are_certified_as_written(one: Path, tmp_path: Path) -> None:
    out = tmp_path / "chosen.toml"
    status, stdout, stderr = run(
        "design", str(one), "--settling", "4", "--quantile", "0.7", "--draws", "40",
        "--gain", "lqr", "--weights", "chosen", "--bound", "error=0.3", "--bound", "state=2",
        "--out", str(out), "--page", str(tmp_path / "p.html"), "--json",
    )  # fmt: skip
    assert status == 0, stderr
    best = json.loads(stdout)["best"]
    assert best["weight"] == "chosen"
    assert best["W"] == [list(row) for row in load(out).decaying.weight or ()]
    (certificate,) = (
        found for found in json.loads(run("certify", str(out), "--json")[1])["certificates"]
        if found["under"] == "paper"
    )  # fmt: skip
    bound = certificate["constants"]["delta"] * best["beta"] / abs(best["W"][0][0])
    assert best["bounds"]["error"] == pytest.approx(bound)
    assert best["bounds"]["error"] <= 0.3
    assert best["bounds"]["state"] <= 2


def test_without_randomness_every_draw_is_the_exact_run(one: Path) -> None:
    found = design(
        families_of(load(one), ("identity",), None),
        DesignLimits(4.0, 0.5, 0.02, {}),
        draws=20,
        seed=0,
    )
    assert found.confirmed
    assert found.fresh.halfwidth == 0
    assert found.fresh.settling_high_s == found.fresh.settling_s
    resolved = resolve(found.scenario)
    exact = simulate_continuous(
        continuous_loop_of(resolved), horizon_s=10.0, delivered=network_fates(resolved),
        known_start=False,
    )  # fmt: skip
    assert found.fresh.transmissions == len(exact.event_s)
    x = exact.at([found.fresh.settling_s]).x
    assert abs(float(x[0, 0])) == pytest.approx(0.02, rel=1e-6)


def test_a_small_quantile_has_the_lower_limit_zero(mass: Path) -> None:
    found = designed(load(mass), DesignLimits(9.0, 0.02, 0.02, {}), draws=20)
    assert found.fresh.settling_low_s == 0
    assert 0 < found.fresh.settling_s <= found.fresh.settling_high_s < math.inf


def test_a_loop_that_never_settles_has_a_page_and_one_line(one: Path, tmp_path: Path) -> None:
    html = tmp_path / "p.html"
    status, stdout, stderr = run(
        "design", str(one), "--settling", "4", "--settle", "1e-9", "--draws", "20",
        "--quantile", "0.5", "--weights", "identity", "--page", str(html),
    )  # fmt: skip
    assert status == 1
    assert stderr.count("\n") == 1
    assert stderr.startswith(
        "noack: no design meets the limits; the closest has a settling time of"
    )
    assert "trade-off" not in stdout
    assert "<svg" in html.read_text()


def test_a_loop_without_a_certificate_is_reported(one: Path, tmp_path: Path) -> None:
    status, stdout, stderr = run(
        "design", str(one), "--settling", "4", "--draws", "20", "--quantile", "0.5",
        "--weights", "identity", "--bound", "error=1", "--page", str(tmp_path / "p.html"),
        "--under", "schedule", "--set", "plant.rate_hz=2", "--set", "controller.rate_hz=2",
    )  # fmt: skip
    assert status == 1
    assert "no certified bound of sup‖e_c‖ (1 allowed)" in stderr
    assert "no certified bound of sup‖x‖" in stdout


def test_no_number_is_cut_off_in_80_columns(
    mass: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    _, stdout, _ = run(
        "design", str(mass), "--settling", "9", "--quantile", "0.7", "--draws", "20",
        "--weights", "identity", "--gain", "lqr", "--page", str(tmp_path / "p.html"),
    )  # fmt: skip
    table = stdout.splitlines()[:10]
    assert any("lqr R × 0.1" in line for line in table)
    assert "…" not in stdout
    assert max(map(len, table)) <= 80


UNSTABLE = ["--set", "model.gain=[[-0.5]]", "--set", "model.allow_unstable=true"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--set", "trigger.floor=3"], "trigger.floor = 3: must be less than the largest β"),
        (["--set", 'mode="zoh"', "--weights", "chosen"], "models that hold do not decay"),
        (UNSTABLE, "not stable; --gain lqr chooses another"),
        ([*UNSTABLE, "--weights", "chosen"], "--gain lqr chooses another"),
        (["--set", 'network.protocol="ack"'], "network.protocol"),
        (["--weights", "given"], "the scenario has no trigger.weight"),
        (["--bound", "error=1", "--bound", "error=2"], "error is given twice"),
        (["--quantile", "nan"], "--quantile: must be between 0 and 1"),
        (["--settle", "1"], "--settle: must be between 0 and 1"),
        (["--under", "theory"], "--under: paper or schedule"),
    ],
)
def test_mistakes_are_one_line(one: Path, words: list[str], said: str) -> None:
    if "--weights" not in words:
        words = [*words, "--weights", "identity"]
    status, _, stderr = run("design", str(one), "--settling", "4", *words)
    assert status == 2, stderr
    assert stderr.count("\n") == 1
    assert said in stderr
