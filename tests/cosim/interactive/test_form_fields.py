"""The form: a field for every key of the schema, mistakes at their fields, other kinds."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cosim.interactive.controls import Field, by_field, filled, form_of
from cosim.interactive.draft import DraftError, open_draft
from cosim.shipped_files import shipped_names
from noack.scenario import toml_file
from noack.scenario.scenario_file import completed

SCHEMA = json.loads(
    (Path(__file__).parents[3] / "docs/scenario.schema.json").read_text(encoding="utf-8")
)


def field(key: str, scenario: str = "lane_following") -> Field:
    (found,) = [one for one in form_of(open_draft(scenario)).all_fields() if one.key == key]
    return found


def leaves(content: Any, key: str = "") -> Iterator[str]:
    if isinstance(content, dict) and content:
        for name, inner in content.items():
            yield from leaves(inner, f"{key}.{name}".removeprefix("."))
    else:
        yield key


def test_every_key_of_the_schema_has_a_field() -> None:
    keys = {one.key for one in form_of(open_draft("lane_following")).all_fields()}
    top = {key.partition(".")[0] for key in keys}
    assert top == set(SCHEMA["properties"])
    for section in ("NetworkSection", "PlantSection", "ModelSection", "DecayingSettings",
                    "BernoulliLoss", "SeedsSection", "RealtimeSection"):  # fmt: skip
        for name in SCHEMA["$defs"][section]["properties"]:
            assert any(f".{name}" in key for key in keys), name


@pytest.mark.parametrize("name", shipped_names("scenarios"))
def test_every_value_of_a_shipped_scenario_is_in_its_form(name: str) -> None:
    draft = open_draft(name)
    form = form_of(draft)
    shown = {one.key: one for one in form.all_fields()}
    for key in leaves(draft.content):
        parts = key.split(".")
        known = [".".join(parts[:i]) for i in range(1, len(parts) + 1)]
        assert set(known) & shown.keys(), key
    for one in shown.values():
        if text := one.text(draft):
            assert one.value(text) == draft.value(one.key)
            assert not one.options or text in one.options, one.key


def test_a_field_changes_the_text_and_an_empty_one_restores_the_default() -> None:
    draft = open_draft("lane_following")
    changed = filled(draft, field("plant.rate_hz"), "250")
    assert changed.value("plant.rate_hz") == 250
    assert "# M - 1: at most four consecutive losses" in changed.text
    without = filled(changed, field("plant.rate_hz"), "")
    assert without.value("plant.rate_hz") is None
    assert without.scenario.plant.rate_hz == 500.0
    assert "# M - 1: at most four consecutive losses" in without.text
    assert toml_file.parsed(without.text, "") == without.content


def test_a_wrong_text_stays_as_it_is_typed_and_is_named_at_its_field() -> None:
    draft = filled(open_draft("lane_following"), field("trigger.beta"), "about 1: or 2")
    assert field("trigger.beta").text(draft) == "about 1: or 2"
    draft = filled(draft, field("plant.initial_state"), '[1.0, "a", 0, 0]')
    draft = filled(draft, field("network.mansd"), "-3")
    with pytest.raises(DraftError) as caught:
        _ = draft.scenario
    assert by_field(form_of(draft), caught.value.mistakes) == {
        "trigger.beta": "should be a valid number",
        "plant.initial_state": "should be a valid number",
        "network.mansd": "should be greater than or equal to 0",
    }


@pytest.mark.parametrize("kind", field("trigger.policy").options)
def test_every_trigger_policy_has_its_own_fields(kind: str) -> None:
    draft = filled(open_draft("lane_following"), field("trigger.policy"), kind)
    form = form_of(draft)
    keys = {one.key for one in (*form.all_fields(), *form.all_groups())}
    assert {f"trigger.{name}" for name in draft.value("trigger")} <= keys
    assert "trigger.alpha_per_s" in keys or kind != "decaying"


def test_another_kind_keeps_what_both_kinds_have() -> None:
    draft = open_draft("lane_following")
    choice = field("controller.kind")
    python = filled(draft, choice, "python")
    assert python.value("controller") == {"rate_hz": 500.0, "kind": "python"}
    with pytest.raises(DraftError) as caught:
        _ = python.scenario
    assert by_field(form_of(python), caught.value.mistakes)["controller.name"]
    assert filled(python, choice, "").value("controller") is None
    linear = filled(python, choice, "linear")
    assert completed(linear.content, Path("scenario.toml")) == linear.scenario
