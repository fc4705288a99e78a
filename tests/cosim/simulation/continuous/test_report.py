"""``noack simulate --trigger continuous``: the output agrees with the run."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from cosim.cli import app
from cosim.simulation.continuous import POINTS, document, network_fates, run_continuous
from cosim.simulation.virtual_time import simulate
from noack.protocol.record_tables import NETEM_PACKET, Fate
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load

SCENARIOS = Path(__file__).parents[4] / "scenarios"


def noack(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments))


@pytest.fixture(scope="module")
def resolved() -> Scenario:
    return resolve(load(SCENARIOS / "lane_following.toml", ["plant.rate_hz=50", "horizon_s=10"]))


def test_the_fates_are_those_of_the_simulated_network(resolved: Scenario) -> None:
    packets = simulate(resolved)[NETEM_PACKET]
    fates = network_fates(resolved)
    later_first = [fates(i) for i in reversed(range(len(packets)))][::-1]
    assert later_first == (packets["fate"] != Fate.DROPPED).tolist()
    assert fates(0)


def test_the_json_document_agrees_with_the_run(resolved: Scenario) -> None:
    run = run_continuous(resolved)
    found = json.loads(json.dumps(document(run, resolved), allow_nan=False))
    summary, events, samples = found["summary"], found["events"], found["samples"]
    assert summary["events"] == len(events) == len(run.before) > 5
    assert summary["deliveries"] == sum(event["delivered"] for event in events)
    assert summary["drops"] == summary["events"] - summary["deliveries"]
    assert summary["longest_loss_burst"] <= resolved.network.mansd
    lost = "".join("." if event["delivered"] else "x" for event in events)
    assert summary["longest_loss_burst"] == max(map(len, lost.split(".")))
    times = [event["t_s"] for event in events]
    assert summary["inter_event_min_s"] == pytest.approx(np.diff(times).min())
    assert len(samples["t_s"]) == len(samples["x"]) == len(samples["x_c"]) == POINTS
    assert np.max(np.array(samples["e_s_norm"]) / samples["threshold"]) <= 1 + 1e-12
    errors = np.array(samples["x_c"]) - np.array(samples["x"])
    np.testing.assert_allclose(np.linalg.norm(errors, axis=1), samples["e_c_norm"], atol=1e-12)


def test_long_lists_of_events_are_shortened() -> None:
    done = noack("simulate", str(SCENARIOS / "lane_following.toml"), "--trigger", "continuous",
                 "--set", 'mode="zoh"')  # fmt: skip
    assert "more events: --json" in done.stdout
