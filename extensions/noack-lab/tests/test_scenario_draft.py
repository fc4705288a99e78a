"""The edited text: changes keep comments, any value is read back, sliders and choices are valid."""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import noack
from noack_lab.scenario_draft import Draft, DraftError, draft_of, open_draft, setting
from noack_lab.sliders import LOSSES, MODEL_ERROR, POLICIES, Slider, choose, drag, sliders

TEXTS = st.text(st.characters(codec="utf-8", exclude_characters="\x7f", exclude_categories=["Cc", "Cs"]))
LANE = open_draft("lane_following")


@given(value=st.one_of(st.floats(0.01, 1.0), st.integers(0, 10**6), st.booleans(), TEXTS))
@pytest.mark.parametrize("key", ["a", "t.a", "t.inner.b", "t.new", "new.table.c"])
def test_any_value_at_any_place_is_read_back(key: str, value: object) -> None:
    text = 'a = 1 # "a" = 2\n[t]\na = "x # y" # a = 3\ninner = { a = [1, 2], b = 2.5 }\n'
    draft = Draft("a", text).with_value(key, value)
    assert draft.value(key) == value
    assert tomllib.loads(draft.text) == draft.content
    assert draft.with_value(key, None).value(key) is None


def test_a_change_keeps_the_comments_and_a_mistake_is_said_with_its_key() -> None:
    draft = LANE.with_value("trigger.beta", 0.125).with_value("network.mansd", 2)
    assert "# at most four" in draft.text
    assert (draft.scenario.trigger.beta, draft.scenario.network.mansd) == (0.125, 2)
    with pytest.raises(noack.NoackError, match=r"trigger\.beta = -1"):
        _ = draft.with_value("trigger.beta", -1.0).scenario
    with pytest.raises(DraftError, match="not TOML"):
        _ = Draft("a", "a = ").scenario
    assert draft_of(draft.scenario).scenario == draft.scenario


def test_a_word_of_set_is_a_key_and_a_value() -> None:
    words = ["trigger.beta=0.3", "mode=zoh", "network.constraints=[]"]
    assert [*map(setting, words)] == [("trigger.beta", 0.3), ("mode", "zoh"), ("network.constraints", [])]
    with pytest.raises(DraftError, match="expected KEY=VALUE"):
        setting("beta")


def test_a_file_is_opened_and_one_that_is_missing_is_said(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(LANE.with_value("trigger.beta", 0.25).text)
    assert open_draft(str(path)).scenario.trigger.beta == 0.25
    with pytest.raises(noack.NoackError, match=r"none\.toml"):
        open_draft(str(tmp_path / "none.toml"))


@pytest.mark.parametrize("name", sorted(noack.scenarios()))
def test_every_scenario_of_one_loop_has_sliders_within_its_ends(name: str) -> None:
    draft = open_draft(name)
    try:
        scenario = draft.scenario
    except noack.NoackError as error:
        assert "needs" in str(error)  # noqa: PT017  # an extension that is not installed
        return
    if scenario.loops:
        return
    for slider in sliders(draft, draft):
        assert slider.low <= slider.value <= slider.high, slider
        for value in (slider.low, slider.high):
            try:
                sliders(drag(draft, draft, slider.key, slider.value_at(slider.position_of(value))), draft)
            except noack.NoackError as error:  # some ends contradict other settings
                assert slider.key.rpartition(".")[2] in str(error) or "horizon" in str(error)  # noqa: PT017


def test_every_choice_gives_a_valid_scenario_with_sliders() -> None:
    for key, names in (("trigger", POLICIES), ("network.loss", LOSSES)):
        for name in names:
            draft = choose(LANE, key, name)
            assert name in draft.text
            assert len(sliders(draft, LANE)) > 4


def test_the_model_error_multiplies_both_boxes_and_ranges_stay_put() -> None:
    draft = drag(LANE, LANE, MODEL_ERROR, 3.0)
    for name in ("uncertainty_A", "uncertainty_B"):
        before, after = (getattr(part.scenario.plant, name) for part in (LANE, draft))
        assert np.array(after) == pytest.approx(3 * np.array(before))
    (slider,) = [part for part in sliders(draft, LANE) if part.key == MODEL_ERROR]
    assert slider.value == 3.0
    moved = drag(LANE, LANE, "trigger.beta", 4.0)
    ends = [[(s.key, s.low, s.high) for s in sliders(part, LANE)] for part in (LANE, moved)]
    assert ends[0] == ends[1]


SLIDERS: list[Any] = [
    *sliders(LANE, LANE),
    Slider("trigger.period_s", 0.1, 0.01, 1.0, 0.01, logarithmic=True, multiple_of=0.002),
]


@given(share=st.floats(0.0, 1.0))
@pytest.mark.parametrize("slider", SLIDERS, ids=lambda slider: slider.label)
def test_value_and_position_are_inverses(slider: Slider, share: float) -> None:
    low, high = slider.position_of(slider.low), slider.position_of(slider.high)
    value = slider.value_at(low + share * (high - low))
    assert slider.value_at(slider.position_of(value)) == pytest.approx(value, rel=0.01)
    assert slider.low * 0.99 <= value <= slider.high * 1.01
