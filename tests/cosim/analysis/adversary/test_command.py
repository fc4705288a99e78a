"""The output and the exit status of ``noack adversary``."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cosim.cli import app
from noack.core.errors import ExitStatus

SCENARIO = Path(__file__).parents[4] / "scenarios" / "lane_following.toml"


def run(*arguments: str) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, ["adversary", str(SCENARIO), "--horizon", "6", *arguments])
    return result.exit_code, result.stdout, result.stderr


def test_json_contains_all_results() -> None:
    status, stdout, stderr = run("--json", "--trigger", "continuous")
    assert status == ExitStatus.OK, stderr
    document = json.loads(stdout)
    assert document["horizon_s"] == 6.0
    assert set(document["worst"]) == {"error", "state", "cost", "inter-event"}
    for worst in document["worst"].values():
        assert worst["exact"]
        assert len(worst["pattern"]) == len(worst["event_s"])
        assert worst["delivered"] == [i for i, fate in enumerate(worst["pattern"]) if fate == "D"]
        assert worst["delivered"][0] == 0
        assert 0 < worst["tightness"] <= 1 + 1e-9
    error = document["worst"]["error"]
    assert error["lossless"] < error["value"] <= error["certified"]
    assert document["certificate"]["conditions"]["sampling_s"] == 0


def test_a_policy_is_searched_in_the_sampled_loop() -> None:
    """Without losses x_c differs from x by more than δ only where a test comes too late."""
    trigger = 'trigger={policy="absolute", delta=0.1}'
    arguments = ("--objective", "error", "--set", trigger, "--set", "network.mansd=0")
    status, stdout, _ = run(*arguments, "--json")
    document = json.loads(stdout)
    worst = document["worst"]["error"]
    assert status == ExitStatus.OK
    assert (document["policy"], document["trigger"]) == ("absolute", "sampled")
    assert document["certificate"]["conditions"]["sampling_s"] == 0.002
    assert worst["exact"]
    assert worst["runs"] == 1
    assert 0.1 < worst["value"] < 0.105
    assert "‖e_c‖, scaled" in run(*arguments)[1]


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("start", ["[0.0, 0.0]", "[1e-3, 0.0]"])
def test_a_bound_of_zero_is_searched(start: str) -> None:
    """Plant and model agree and nothing disturbs them: e_c is 0 after the first update."""
    settings = [
        "plant.draw=nominal", "plant.uncertainty_A=", "plant.uncertainty_B=",
        'trigger={policy="periodic", period_s=0.1}', f"plant.initial_state={start}",
    ]  # fmt: skip
    words = [word for one in settings if not one.endswith("=") for word in ("--set", one)]
    arguments = ["adversary", "double_integrator", "--horizon", "0.5", "--nodes", "100"]
    done = CliRunner().invoke(app, [*arguments, *words, "--json"])
    assert done.exit_code == ExitStatus.OK, done.output
    for worst in json.loads(done.stdout)["worst"].values():
        assert worst["tightness"] is None or worst["tightness"] <= 1 + 1e-9


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["lane_following", "--horizon", "-1"], "horizon_s"),
        (["lane_periodic", "--trigger", "continuous"], "--trigger continuous"),
        (["lane_crosswind", "--trigger", "continuous"], "--trigger continuous"),
    ],
)
def test_what_cannot_be_searched_is_refused_in_one_line(words: list[str], expected: str) -> None:
    done = CliRunner().invoke(app, ["adversary", *words])
    assert (done.exit_code, len(done.stderr.splitlines())) == (ExitStatus.CALLER, 1)
    assert expected in done.stderr
