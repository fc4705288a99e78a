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
def found() -> noack.CampaignResult:
    return noack.campaign(PLAN, workers=1)


def test_the_estimates_are_those_of_the_draws(found: noack.CampaignResult) -> None:
    rows = found.estimates().to_pylist()
    (row,) = (
        one for one in rows
        if (one["mode"], one["loss"], one["metric"]) == ("hold", "0.8", "transmissions")
    )  # fmt: skip
    values = found.draws(mode="hold", loss=0.8)["transmissions"].to_numpy()
    assert (row["draws"], row["finite"]) == (30, 30)
    assert row["mean"] == pytest.approx(values.mean())
    assert row["largest"] == values.max()
    others = found.draws(mode="model", loss=0.8)["transmissions"].to_numpy()
    (compared,) = (
        one for one in found.differences().to_pylist()
        if (one["mode"], one["loss"], one["metric"]) == ("model", "0.8", "transmissions")
    )  # fmt: skip
    assert compared["mean"] == pytest.approx(np.mean(others - values))
    assert found.breaches == 0


def test_the_page_the_summary_and_the_figures_are_there(found: noack.CampaignResult) -> None:
    assert found.report().is_file()
    written = json.loads((found.folder / "summary.json").read_text())
    assert [one["axes"] for one in written["points"]] == [one["axes"] for one in found.summary["points"]]
    assert found.plot().axes
    assert "0.8" in repr(found)
    assert "<table>" in found._repr_html_()


def test_what_is_not_there_is_named(found: noack.CampaignResult) -> None:
    with pytest.raises(noack.NoackError, match=r"loss is one of 0\.2, 0\.8"):
        found.draws(mode="model", loss=0.3)
    with pytest.raises(noack.NoackError, match="it has curve-1"):
        found.plot("curve-2")
    with pytest.raises(noack.NoackError, match="campaign: axes"):
        noack.campaign({**PLAN, "axes": []})


def test_a_system_is_certified(scenario: noack.Scenario) -> None:
    found = noack.certify(scenario)
    assert pickle.loads(pickle.dumps(found)).to_json() == found.to_json()
    assert found.schedule.constants is not None
    assert json.loads(json.dumps(found.to_json()))["scenario"] == "own_system"


def test_the_box_is_certified_and_shown(scenario: noack.Scenario) -> None:
    box = {"plant.uncertainty_A": [[0.0, 0.0], [0.3, 0.1]]}
    found = noack.certify(noack.with_settings(scenario, box), late=0)
    assert found.paper_box is not None
    assert found.schedule_box is not None
    assert found.paper_box.constants is not None
    for shown in (repr(found), found._repr_html_()):
        assert "schedule, box" in shown
        assert f"{found.paper_box.constants.delta:.4g}" in shown
