"""The form: a field for every key, and mistakes at their fields."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cosim.interactive.scenario_draft import DraftError, draft_of_query, open_draft
from cosim.interactive.settings_form import Field, by_field, fill_in, form_of
from cosim.interactive.sliders import choose, controls_of, drag
from cosim.shipped_files import shipped_names

SCHEMA = json.loads((Path(__file__).parents[3] / "docs/scenario.schema.json").read_text(encoding="utf-8"))


def field(key: str, scenario: str = "lane_following") -> Field:
    (match,) = [entry for entry in form_of(open_draft(scenario)).all_fields() if entry.key == key]
    return match


def leaves(content: Any, key: str = "") -> Iterator[str]:
    if isinstance(content, dict) and content:
        for name, inner in content.items():
            yield from leaves(inner, f"{key}.{name}".removeprefix("."))
    else:
        yield key


def test_every_key_of_the_schema_has_a_field() -> None:
    keys = {entry.key for entry in form_of(open_draft("lane_following")).all_fields()}
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
    fields = {entry.key: entry for entry in form.all_fields()}
    for key in leaves(draft.content):
        parts = key.split(".")
        known = [".".join(parts[:i]) for i in range(1, len(parts) + 1)]
        assert set(known) & fields.keys(), key
    for entry in fields.values():
        if text := entry.text(draft):
            assert entry.value(text) == draft.value(entry.key)
            assert not entry.options or text in entry.options, entry.key


def test_a_wrong_text_stays_as_it_is_typed_and_is_named_at_its_field() -> None:
    draft = fill_in(open_draft("lane_following"), field("trigger.beta"), "about 1: or 2")
    assert field("trigger.beta").text(draft) == "about 1: or 2"
    draft = fill_in(draft, field("plant.initial_state"), '[1.0, "a", 0, 0]')
    draft = fill_in(draft, field("network.mansd"), "-3")
    with pytest.raises(DraftError) as error:
        _ = draft.scenario
    assert by_field(form_of(draft), error.value.mistakes) == {
        "trigger.beta": "expected a number",
        "plant.initial_state": "expected a number",
        "network.mansd": "expected at least 0",
    }


def test_every_choice_gives_a_valid_scenario() -> None:
    draft = open_draft("lane_following")
    for choice in controls_of(draft).choices:
        for value in choice.options:
            other = choose(draft, choice.key, value)
            values = {control.key: control.value for control in controls_of(other).choices}
            assert values[choice.key] == value
            assert (
                draft_of_query(other.query(), "lane_following", {"lane_following": "lane_following"}).scenario
                == other.scenario
            )
            for slider in controls_of(other).sliders:
                for place in slider.ends:
                    if slider.key != "network.loss.mean_loss":  # limited by the mean burst
                        assert drag(other, slider, slider.value_at(place)).scenario


def test_another_kind_keeps_what_both_kinds_have() -> None:
    draft, choice = open_draft("lane_following"), field("controller.kind")
    python = fill_in(draft, choice, "python")
    assert python.value("controller") == {"rate_hz": 500.0, "kind": "python"}
    with pytest.raises(DraftError) as error:
        _ = python.scenario
    assert by_field(form_of(python), error.value.mistakes)["controller.name"]
    assert fill_in(python, choice, "").value("controller") is None
    policy = field("trigger.policy")
    for kind in policy.options:
        assert fill_in(draft, policy, kind).value("trigger.policy") in (kind, None)
