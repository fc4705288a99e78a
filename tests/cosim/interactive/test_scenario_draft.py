"""The edited scenario: comments are kept, mistakes have their key, the address repeats it."""

from pathlib import Path
from urllib.parse import quote

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.interactive.scenario_draft import Draft, DraftError, draft_of_query, known_scenarios, open_draft
from cosim.interactive.sliders import controls_of, drag
from cosim.shipped_files import shipped_names
from noack.core.errors import CallerError
from noack.scenario import toml_file
from noack.scenario.scenario_file import put

LANE = {"lane_following": "lane_following"}
TEXTS = st.text(st.characters(exclude_categories=["Cs"]))  # without surrogates


def test_the_model_error_multiplies_both_boxes() -> None:
    draft = open_draft("lane_following")
    (slider,) = [part for part in controls_of(draft).sliders if part.scaled]
    assert slider.value == 1.0
    dragged = drag(drag(draft, slider, 3.0), slider, 12.0)
    assert "# M - 1: at most four consecutive losses" in dragged.text
    assert dragged.value("plant.uncertainty_A")[0] == [1.2, 1.2, 0.0, 0.0]
    assert dragged.value("plant.uncertainty_B")[1] == [0.0, 0.6]
    assert [part.value for part in controls_of(dragged).sliders if part.scaled] == [12.0]
    assert drag(dragged, slider, 1.0).text.count("0.1, 0.1") == 2
    nominal = draft.with_value("plant.draw", "nominal")
    assert not any(part.scaled for part in controls_of(nominal).sliders)


@given(value=st.one_of(st.floats(0.01, 1.0), st.integers(0, 10**6), st.booleans(), TEXTS))
@pytest.mark.parametrize("key", ["a", "t.a", "t.inner.b", "t.new", "new.table.c"])
def test_any_value_at_any_place_is_read_back(key: str, value: object) -> None:
    text = 'a = 1 # "a" = 2\n[t]\na = "x # y" # a = 3\ninner = { a = [1, 2], b = 2.5 }\n'
    draft = Draft("a", Path(), text, text)
    content = toml_file.parsed(text, "")
    put(content, key, value, key)
    other_draft = draft.with_value(key, value)
    assert toml_file.parsed(other_draft.text, "") == other_draft.content == content
    assert (other_draft.text.count("#") >= 2) or "new" in key
    assert toml_file.parsed(other_draft.without(key).text, "") == other_draft.without(key).content


def test_mistakes_are_shown_at_their_keys() -> None:
    draft = open_draft("lane_following")
    wrong = draft.with_value("network.loss.probability", 2.0).with_value("trigger.beta", -1.0)
    with pytest.raises(DraftError) as error:
        _ = wrong.scenario
    assert [mistake.key for mistake in error.value.mistakes] == ["trigger.beta", "network.loss.probability"]
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
            dragged = drag(draft, slider, slider.value_at(low + share * (high - low)))
            reopened = draft_of_query(dragged.query(), name, {name: name})
            assert reopened.content == dragged.content
            assert dragged.scenario  # it is valid


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


def test_the_scenarios_of_a_folder_are_offered(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(open_draft("lane_following").text)
    (tmp_path / "other.toml").write_text("a = 1")
    (tmp_path / "broken.toml").write_text("a = ")
    known = known_scenarios(tmp_path, "lane_following")
    assert "mine.toml" in known
    assert not {"other.toml", "broken.toml"} & known.keys()
    assert open_draft(known["mine.toml"]).scenario.name == "lane_following"
