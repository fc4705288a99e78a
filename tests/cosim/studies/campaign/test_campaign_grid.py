"""Campaign files: their grid of points, and one clear line for every mistake."""

import copy
import json
import tomllib
from pathlib import Path
from typing import Any

import pytest

from cosim.studies.campaign.campaign_file import json_schema, load
from cosim.studies.campaign.campaign_grid import grid
from netem.core.errors import CallerError
from tests.cosim.studies.campaign.conftest import Write, few_of
from tests.helpers.approved import compare_lines, lines_of_error

ROOT = Path(__file__).parents[4]
SHIPPED = sorted((ROOT / "campaigns").glob("*.toml"))
ALONE: dict[str, Any] = {"compare": None, "figures": []}
"""Other axes need neither the comparison nor the figures."""


def test_the_grid_is_all_combinations_and_the_last_axis_varies_fastest(
    write: Write, plan: dict[str, Any]
) -> None:
    _, points = few_of(write(plan))
    assert [tuple(point.labels.values()) for point in points] == [
        ("MB", "0.1"), ("MB", "0.3"), ("ZOH", "0.1"), ("ZOH", "0.3")
    ]  # fmt: skip
    assert [point.scenario.mode for point in points] == ["model", "model", "zoh", "zoh"]
    assert [point.scenario.trigger.beta for point in points] == [0.1, 0.3, 0.1, 0.3]
    assert all(point.scenario.decaying.beta == point.values["beta"] for point in points)
    assert points[0].scenario.plant.initial_state_halfwidth == (0.5, 0.5)


def test_an_axis_of_a_table_is_applied_before_an_axis_of_its_keys(write: Write, plan: dict[str, Any]) -> None:
    variants = {"t": {"trigger": {"beta": 2.0, "alpha_per_s": 1.0}}, "f": {"trigger.floor": 0.1}}
    tables = {"name": "trigger", "variants": variants}
    key = {"name": "beta", "key": "trigger.beta", "values": [0.1, 0.1234567, 0.1234568]}
    campaign, points = few_of(write(plan, axes=[tables, key], **ALONE))
    assert [point.scenario.trigger.beta for point in points] == 2 * key["values"]
    assert campaign.axes[1].labels == ["0.1", "0.1234567", "0.1234568"]
    with pytest.raises(CallerError, match="an axis that sets a whole table comes first"):
        load(write(plan, axes=[key, tables], **ALONE))


@pytest.mark.parametrize(("time", "chunk"), [("continuous", 2000), ("sampled", 20)])
def test_a_file_of_results_takes_seconds(write: Write, plan: dict[str, Any], time: str, chunk: int) -> None:
    del plan["chunk"]
    assert load(write(plan, time=time)).chunk == chunk


def test_a_mistake_gives_the_approved_line(write: Write, plan: dict[str, Any]) -> None:
    def mistake(line: str) -> list[str]:
        spoilt: Any = copy.deepcopy(plan)
        key, _, value = line.partition(" = ")
        *path, last = (int(part) if part.isdigit() else part for part in key.split("."))
        table = spoilt
        for part in path:
            table = table[part]
        if value == "null":
            del table[last]
        else:
            table[last] = json.loads(value)
        file = write(spoilt)
        return lines_of_error(lambda: load(file), FILE=file)

    compare_lines(Path(__file__).with_name("mistakes.txt"), mistake)


def test_a_grid_has_at_most_10000_points(write: Write, plan: dict[str, Any]) -> None:
    plan["axes"][1]["values"] = list(range(1, 6000))
    with pytest.raises(CallerError, match=r"few\.toml: .*the grid has 11998 points; at most 10000"):
        load(write(plan))


def test_an_invalid_scenario_at_a_point_is_reported_with_the_point(
    write: Write, plan: dict[str, Any]
) -> None:
    def mistake(changed: str) -> list[str]:
        path = write(plan, **(ALONE | json.loads(changed)))
        return lines_of_error(lambda: few_of(path), FOLDER=path.parent)

    compare_lines(Path(__file__).with_name("point_mistakes.txt"), mistake)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_campaigns_are_valid_and_named_after_their_file(path: Path) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    jsonschema.Draft202012Validator(json_schema()).validate(tomllib.loads(path.read_text()))
    loaded = load(path)
    assert loaded.name == path.stem
    points = grid(loaded, path)
    assert len({point.scenario.model_dump_json() for point in points}) == len(points)


def test_the_published_campaign_schema_is_up_to_date() -> None:
    """``make schema`` updates it."""
    published = (ROOT / "docs" / "campaign.schema.json").read_text(encoding="utf-8")
    assert json.loads(published) == json_schema()


def test_too_many_curves_for_one_figure_are_refused_with_a_remedy(write: Write, plan: dict[str, Any]) -> None:
    plan["axes"][1]["values"] = [i / 10 for i in range(1, 8)]
    with pytest.raises(CallerError, match=r"14 series are too many.* where = "):
        load(write(plan, figures=[{"kind": "distribution", "metric": "cost"}]))
