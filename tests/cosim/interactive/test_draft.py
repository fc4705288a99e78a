"""The edited scenario: comments are kept, mistakes have their key, the address repeats it."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.interactive.controls import chosen, controls_of, dragged
from cosim.interactive.draft import Draft, DraftError, draft_of_query, known_scenarios, open_draft
from cosim.interactive.form import Field, by_field, filled, form_of
from cosim.shipped_files import shipped_names
from noack.core.errors import CallerError
from noack.scenario import toml_file
from noack.scenario.scenario_file import put

LANE = {"lane_following": "lane_following"}


def test_the_model_error_multiplies_both_boxes() -> None:
    draft = open_draft("lane_following")
    (slider,) = [one for one in controls_of(draft).sliders if one.scaled]
    assert slider.value == 1.0
    wide = dragged(dragged(draft, slider, 3.0), slider, 12.0)
    assert "# M - 1: at most four consecutive losses" in wide.text
    assert wide.value("plant.uncertainty_A")[0] == [1.2, 1.2, 0.0, 0.0]
    assert wide.value("plant.uncertainty_B")[1] == [0.0, 0.6]
    assert [one.value for one in controls_of(wide).sliders if one.scaled] == [12.0]
    assert dragged(wide, slider, 1.0).text.count("0.1, 0.1") == 2
    nominal = draft.with_value("plant.draw", "nominal")
    assert not any(one.scaled for one in controls_of(nominal).sliders)


@given(value=st.one_of(st.floats(0.01, 1.0), st.integers(0, 10**6), st.booleans(), st.text()))
@pytest.mark.parametrize("key", ["a", "t.a", "t.inner.b", "t.new", "new.table.c"])
def test_any_value_at_any_place_is_read_back(key: str, value: object) -> None:
    text = 'a = 1 # "a" = 2\n[t]\na = "x # y" # a = 3\ninner = { a = [1, 2], b = 2.5 }\n'
    draft = Draft("a", Path(), text, text)
    content = toml_file.parsed(text, "")
    put(content, key, value, key)
    changed = draft.with_value(key, value)
    assert toml_file.parsed(changed.text, "") == changed.content == content
    assert (changed.text.count("#") >= 2) or "new" in key
    assert toml_file.parsed(changed.without(key).text, "") == changed.without(key).content


def test_mistakes_are_shown_at_their_keys() -> None:
    draft = open_draft("lane_following")
    wrong = draft.with_value("network.loss.probability", 2.0).with_value("trigger.beta", -1.0)
    with pytest.raises(DraftError) as error:
        _ = wrong.scenario
    assert [one.key for one in error.value.mistakes] == ["trigger.beta", "network.loss.probability"]
    with pytest.raises(DraftError) as error:
        _ = draft.with_text("name = ").scenario
    assert error.value.mistakes[0].key == ""
    assert "not valid TOML" in error.value.mistakes[0].text


@pytest.mark.parametrize("name", shipped_names("scenarios"))
def test_every_scenario_has_controls_and_an_address(name: str) -> None:
    draft = open_draft(name)
    controls = controls_of(draft)
    assert draft.query() == f"scenario={name}"
    for slider in controls.sliders:
        low, high = slider.ends
        assert low <= slider.position <= high
        for share in (0.0, 0.77, 1.0):
            moved = dragged(draft, slider, slider.value_at(low + share * (high - low)))
            again = draft_of_query(moved.query(), name, {name: name})
            assert again.content == moved.content
            assert again.scenario == moved.scenario  # it is valid


def test_an_address_cannot_name_code_or_foreign_files(tmp_path: Path) -> None:
    code = quote('{ kind = "python", file = "evil.py", name = "Evil" }')
    for query, why in (
        (f"plant.system={code}", "files to execute"),
        ("scenario=/etc/passwd", "opens shipped scenarios"),
        ("a=" + "1" * 20_000, "too long"),
        ("a.b=[", "TOML"),
    ):
        with pytest.raises(CallerError, match=why):
            draft_of_query(query, "lane_following", LANE)
    assert draft_of_query("", "lane_following", LANE).base == "lane_following"


SCHEMA = json.loads((Path(__file__).parents[3] / "docs/scenario.schema.json").read_text(encoding="utf-8"))


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


def test_a_wrong_text_stays_as_it_is_typed_and_is_named_at_its_field() -> None:
    draft = filled(open_draft("lane_following"), field("trigger.beta"), "about 1: or 2")
    assert field("trigger.beta").text(draft) == "about 1: or 2"
    draft = filled(draft, field("plant.initial_state"), '[1.0, "a", 0, 0]')
    draft = filled(draft, field("network.mansd"), "-3")
    with pytest.raises(DraftError) as caught:
        _ = draft.scenario
    assert by_field(form_of(draft), caught.value.mistakes) == {
        "trigger.beta": "expected a number",
        "plant.initial_state": "expected a number",
        "network.mansd": "expected at least 0",
    }


def test_every_choice_gives_a_valid_scenario() -> None:
    draft = open_draft("lane_following")
    for choice in controls_of(draft).choices:
        for value in choice.options:
            other = chosen(draft, choice.key, value)
            assert {one.key: one.value for one in controls_of(other).choices}[choice.key] == value
            assert draft_of_query(other.query(), "lane_following", LANE).scenario == other.scenario
            for slider in controls_of(other).sliders:
                for place in slider.ends:
                    if slider.key != "network.loss.mean_loss":  # limited by the mean burst
                        assert dragged(other, slider, slider.value_at(place)).scenario


def test_another_kind_keeps_what_both_kinds_have() -> None:
    draft, choice = open_draft("lane_following"), field("controller.kind")
    python = filled(draft, choice, "python")
    assert python.value("controller") == {"rate_hz": 500.0, "kind": "python"}
    with pytest.raises(DraftError) as caught:
        _ = python.scenario
    assert by_field(form_of(python), caught.value.mistakes)["controller.name"]
    assert filled(python, choice, "").value("controller") is None
    policy = field("trigger.policy")
    for kind in policy.options:
        assert filled(draft, policy, kind).value("trigger.policy") in (kind, None)


def test_the_scenarios_of_a_folder_are_offered(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(open_draft("lane_following").text)
    (tmp_path / "other.toml").write_text("a = 1")
    (tmp_path / "broken.toml").write_text("a = ")
    known = known_scenarios(tmp_path, "lane_following")
    assert "mine.toml" in known
    assert not {"other.toml", "broken.toml"} & known.keys()
    assert open_draft(known["mine.toml"]).scenario.name == "lane_following"
