"""Campaigns and certificates of the library give what the commands write."""

import json
import pickle
from typing import Any

import numpy as np
import pytest

import noack

PLAN: dict[str, Any] = {
    "name": "two",
    "scenario": "double_integrator",
    "draws": 30,
    "settings": {"horizon_s": 5.0},
    "axes": [
        {"name": "mode", "variants": {"model": {"mode": "model"}, "hold": {"mode": "zoh"}}},
        {"name": "loss", "key": "network.loss.probability", "values": [0.2, 0.8]},
    ],
    "compare": {"axis": "mode", "reference": "hold"},
    "figures": [{"kind": "curve", "x": "loss", "metric": "transmissions"}],
}


@pytest.fixture(scope="module")
def result() -> noack.CampaignResult:
    return noack.campaign(PLAN, workers=1)


def test_the_estimates_are_those_of_the_draws(result: noack.CampaignResult) -> None:
    rows = result.estimates().to_pylist()
    (row,) = (
        row for row in rows
        if (row["mode"], row["loss"], row["metric"]) == ("hold", "0.8", "transmissions")
    )  # fmt: skip
    values = result.draws(mode="hold", loss=0.8)["transmissions"].to_numpy()
    assert (row["draws"], row["finite"]) == (30, 30)
    assert row["mean"] == pytest.approx(values.mean())
    assert row["largest"] == values.max()
    transmissions = result.draws(mode="model", loss=0.8)["transmissions"].to_numpy()
    (compared,) = (
        row for row in result.differences().to_pylist()
        if (row["mode"], row["loss"], row["metric"]) == ("model", "0.8", "transmissions")
    )  # fmt: skip
    assert compared["mean"] == pytest.approx(np.mean(transmissions - values))
    assert result.breaches == 0


def test_numbers_may_be_those_of_numpy(result: noack.CampaignResult) -> None:
    axes = [PLAN["axes"][0], PLAN["axes"][1] | {"values": np.array([0.2, 0.8])}]
    plan = PLAN | {"axes": axes, "settings": {"horizon_s": np.float32(5)}, "draws": np.int64(30)}
    repetition = noack.campaign(plan, draws=np.int64(30), workers=np.int64(1))
    assert repetition.summary == result.summary
    assert repetition.draws(mode="hold", loss=np.float64(0.8)).num_rows == 30
    first, same = (
        noack.margin("lane_periodic", most_mansd=mansd, accuracy=accuracy, period=False)
        .caps[-1]
        .stability.lower
        for mansd, accuracy in ((np.int64(1), np.float64(1e-3)), (1, 1e-3))
    )
    assert first == same


@pytest.mark.usefixtures("short_searches")
def test_a_system_is_certified(scenario: noack.Scenario) -> None:
    certificates = noack.certify(scenario)
    assert pickle.loads(pickle.dumps(certificates)).to_json() == certificates.to_json()
    assert certificates.schedule.exists
    assert json.loads(json.dumps(certificates.to_json()))["scenario"] == "own_system"
    assert noack.certify(scenario, search=False).schedule.has("x")
