"""Bursts beyond M − 1 in campaigns, against the closed form for one packet in sequence."""

from pathlib import Path

import numpy as np
import pytest

from cosim.studies.campaign.metrics import burst_frequency
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load

LANE = Path(__file__).parents[4] / "scenarios" / "lane_following.toml"


def scenario(*settings: str) -> Scenario:
    loss = 'network.loss={model="bernoulli", probability=0.3}'
    return load(LANE, ("network.mansd=0", loss, *settings))


def test_the_share_of_runs_is_compared_with_the_probability_for_the_most_packets() -> None:
    bursts = np.array([0.0, 1.0, 0.0, 3.0, np.inf])
    found = burst_frequency(
        scenario("network.enforce_mansd=false"),
        {"longest_loss_burst": bursts, "transmissions": np.array([2.0, 3.0, 4.0, 5.0, np.inf])},
    )
    assert found is not None
    assert (found.longer, found.runs, found.packets) == (2, 4, 5)
    assert found.predicted == pytest.approx(1 - 0.7**4)  # the first packet is delivered
    assert found.low < 0.5 < found.high
