"""``noack adversary``: the search that a policy gets, and a bound of zero."""

import json
from pathlib import Path

import pytest

from netem.core.errors import ExitStatus
from tests.helpers.command_line import invoke

pytestmark = pytest.mark.usefixtures("no_searches")

SCENARIO = Path(__file__).parents[4] / "scenarios" / "lane_following.toml"


def run(*arguments: str) -> tuple[int, str, str]:
    result = invoke("adversary", SCENARIO, "--horizon", "6", *arguments)
    return result.exit_code, result.stdout, result.stderr


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
    words = [word for setting in settings if not setting.endswith("=") for word in ("--set", setting)]
    arguments = ["adversary", "double_integrator", "--horizon", "0.5", "--nodes", "100"]
    result = invoke(*arguments, *words, "--json")
    assert result.exit_code == ExitStatus.OK, result.output
    for worst in json.loads(result.stdout)["worst"].values():
        assert worst["tightness"] is None or worst["tightness"] <= 1 + 1e-9
