"""Campaign files: their grid of points, and one clear line for every mistake."""

import copy
import json
import tomllib
from pathlib import Path
from typing import Any

import pytest

from cosim.studies.campaign.campaign_file import json_schema, load
from cosim.studies.campaign.campaign_grid import grid
from noack.core.errors import CallerError
from tests.cosim.studies.campaign.conftest import Write, few_of

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


def test_an_axis_of_a_table_is_applied_before_an_axis_of_its_keys(
    write: Write, plan: dict[str, Any]
) -> None:
    variants = {"t": {"trigger": {"beta": 2.0, "alpha_per_s": 1.0}}, "f": {"trigger.floor": 0.1}}
    tables = {"name": "trigger", "variants": variants}
    key = {"name": "beta", "key": "trigger.beta", "values": [0.1, 0.1234567, 0.1234568]}
    campaign, points = few_of(write(plan, axes=[tables, key], **ALONE))
    assert [point.scenario.trigger.beta for point in points] == 2 * key["values"]
    assert campaign.axes[1].labels == ["0.1", "0.1234567", "0.1234568"]
    with pytest.raises(CallerError, match="an axis that sets a whole table comes first"):
        load(write(plan, axes=[key, tables], **ALONE))


MISTAKES: list[tuple[str, Any, str]] = [
    ("drws", 5, "drws = 5: unknown key; did you mean draws?"),
    ("name", "two words", 'name = "two words": use letters'),
    ("axes", [], "axes = []: needs at least one entry"),
    ("axes.0.name", "cost", 'axes.0.name = "cost": cost is a column already'),
    ("axes.0.name", "beta", 'axes.1.name = "beta": another axis has this name'),
    ("axes.1.key", None, "key: missing; an axis needs both key and values"),
    ("axes.1.variants", {"a": {"mode": "zoh"}}, 'axes.1.key = "trigger.beta": give key and'),
    ("axes.1.values", [1, 1.0], "1 is given twice"),
    ("axes.1.values", [[[1.0]]], "axes.1.values.0 = [[1.0]]: should be a number, a text, true or"),
    ("axes.1.values", list(range(1, 6000)), "the grid has 11998 points; at most 10000"),
    ("axes.1.key", "mode", 'axes.1.name = "beta": mode would replace mode of axis policy'),
    ("axes.0.variants.ZOH", {"mode": "zoh", "trigger.beta": 0.1},
     'axes.1.name = "beta": trigger.beta would replace trigger.beta of axis policy'),
    ("axes.0.variants.ZOH", {"mode": "zoh", "trigger.floor": 0.1, "trigger": {}},
     ": trigger replaces trigger.floor, which is given before it"),
    ("settings", {"plant.draw": "nominal", "plant": {}},
     "plant replaces plant.draw, which is given"),
    ("compare.axis", "polic", 'compare.axis = "polic": no such axis; the axes are policy, beta'),
    ("compare.reference", "PB", 'compare.reference = "PB": no such value; policy has MB, ZOH'),
    ("figures.0.series", "p", 'figures.0.series = "p": no such axis'),
    ("figures.1.metric", "costs", 'figures.1.metric = "costs": should be'),
    ("figures.2.y", "beta", 'figures.2.y = "beta": a map needs two different axes'),
    ("figures.3.where", {"beta": 0.2}, "no such value; beta has 0.1, 0.3"),
]  # fmt: skip


@pytest.mark.parametrize(("key", "value", "expected"), MISTAKES, ids=lambda v: str(v)[:30])
def test_a_mistake_is_one_line_with_file_key_and_remedy(
    write: Write, plan: dict[str, Any], key: str, value: Any, expected: str
) -> None:
    spoilt: Any = copy.deepcopy(plan)
    *path, last = (int(part) if part.isdigit() else part for part in key.split("."))
    table = spoilt
    for part in path:
        table = table[part]
    if value is None:
        del table[last]
    else:
        table[last] = value
    file = write(spoilt)
    with pytest.raises(CallerError) as found:
        load(file)
    assert "\n" not in str(found.value)
    assert str(found.value).startswith(f"{file}: ")
    assert expected in str(found.value)


def one_axis(key: str, *values: float) -> dict[str, Any]:
    return {"axes": [{"name": "a", "key": key, "values": values}]}


AT = "at policy = MB, beta = 0.1: network."


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"scenario": "lane_folowing"}, "lane_folowing: no such file, nor a shipped scenario"),
        ({"scenario": "none.toml"}, 'scenario = "none.toml": no such file'),
        (one_axis("network.mansd", 1, -1), "few.toml: at a = -1: network.mansd = -1: should be"),
        (one_axis("plant.rate_hz", 100.0, 200.0),
         "axes.0: a = 100 and a = 200 are the same runs: plant.rate_hz has no effect on them"),
        ({"time": "sampled", **one_axis("speed", 1.0, 2.0)}, "speed has no effect on them"),
        ({"settings": {"horizon_s.x": 1.0}}, "settings.horizon_s.x: horizon_s is not a table"),
        ({"settings": {"network.impairments": [{"kind": "delay", "delay_s": 0.1}]}},
         f'{AT}impairments: delay: in continuous time the network has no delay; leave it out, '
         'e.g. settings = { "network.impairments" = [] }, or use time = "sampled"'),
        ({"settings": {"network.protocol": "ack"}},
         f'{AT}protocol: continuous time needs the loop without acknowledgements, "none"; '
         'time = "sampled" takes both'),
        ({"metrics": {"Q": [[1.0, 2.0], [0.0, 1.0]]}}, "metrics.Q: must be symmetric"),
        ({"metrics": {"R": [[1.0, 2.0]]}}, "metrics.R: expected 1 x 1 (one row per input)"),
    ],
)  # fmt: skip
def test_an_invalid_scenario_at_a_point_is_reported_with_the_point(
    write: Write, plan: dict[str, Any], changed: dict[str, Any], expected: str
) -> None:
    path = write(plan, **ALONE, **changed)
    with pytest.raises(CallerError) as found:
        few_of(path)
    assert "\n" not in str(found.value)
    assert expected in str(found.value)


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


def test_too_many_curves_for_one_figure_are_refused_with_a_remedy(
    write: Write, plan: dict[str, Any]
) -> None:
    plan["axes"][1]["values"] = [i / 10 for i in range(1, 8)]
    with pytest.raises(CallerError, match=r"14 series are too many.* where = "):
        load(write(plan, figures=[{"kind": "distribution", "metric": "cost"}]))
