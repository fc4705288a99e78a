"""A small campaign: the double integrator in a box, two modes, two thresholds."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from click.testing import Result

from cosim.studies.campaign.campaign_file import Campaign, load
from cosim.studies.campaign.campaign_grid import Point, grid
from cosim.studies.campaign.campaign_workers import run_in_process
from cosim.studies.campaign.chunk_store import Store, run_campaign
from tests.helpers.command_line import invoke

Write = Callable[..., Path]
Command = Callable[..., Result]
Few = tuple[Campaign, list[Point]]
HOSTILE = "</title></svg><script>alert('x')</script> & \"$\\frac{1}{2}$\""


@pytest.fixture
def plan() -> dict[str, Any]:
    """A valid campaign as parsed TOML."""
    return {
        "name": "few",
        "scenario": "small.toml",
        "draws": 7,
        "chunk": 3,
        "seed": 11,
        "settings": {
            "plant.draw": "uniform",
            "plant.uncertainty_A": [[0.0, 0.0], [0.2, 0.1]],
            "plant.initial_state_halfwidth": [0.5, 0.5],
        },
        "axes": [
            {"name": "policy", "variants": {"MB": {"mode": "model"}, "ZOH": {"mode": "zoh"}}},
            {"name": "beta", "title": "β", "key": "trigger.beta", "values": [0.1, 0.3]},
        ],
        "compare": {"axis": "policy", "reference": "ZOH"},
        "figures": [
            {"kind": "pareto", "series": "policy"},
            {"kind": "curve", "x": "beta", "metric": "transmissions"},
            {"kind": "heat_map", "x": "beta", "y": "policy", "metric": "cost"},
            {"kind": "distribution", "metric": "inter_event_min_s", "where": {"beta": 0.3}},
        ],
    }


@pytest.fixture
def write(tmp_path: Path, content: dict[str, Any]) -> Write:
    """Writes a campaign file and its scenario into one folder."""
    scenario = tmp_path / "small.toml"
    scenario.write_text(tomli_w.dumps(content))

    def written(plan: dict[str, Any], **changed: Any) -> Path:
        path = tmp_path / "few.toml"
        settings = {key: value for key, value in (plan | changed).items() if value is not None}
        path.write_text(tomli_w.dumps(settings))
        return path

    return written


@pytest.fixture
def campaign(write: Write, plan: dict[str, Any]) -> Few:
    return few_of(write(plan))


@pytest.fixture
def full(tmp_path: Path, campaign: Few) -> Store:
    """The folder of the campaign, with all runs."""
    settings, points = campaign
    store = Store(tmp_path / "out", points, settings.draws, settings.chunk)
    assert run_campaign(store, run_in_process) == 28
    return store


@pytest.fixture
def run_command(tmp_path: Path) -> Command:
    """Runs the command in this process; the campaign's folder is ``out``."""

    def run(path: Path, *words: str) -> Result:
        options = ("--workers", "1", "--out", str(tmp_path / "out"))
        return invoke("campaign", path, *options, *words)

    return run


def few_of(path: Path) -> Few:
    """Return a campaign and its grid points."""
    loaded = load(path)
    return loaded, grid(loaded, path)
