"""Sliders: positions and values, and ranges that stay put while dragging."""

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.interactive.scenario_draft import Draft, DraftError, open_draft
from cosim.interactive.sliders import Slider, choose, controls_of, drag

SLIDERS = [
    Slider("share", "linear", 0.3, 0.0, 1.0, 0.01),
    Slider("rate", "logarithmic", 2.0, 0.02, 200.0, 0.02, logarithmic=True),
    Slider("number", "whole", 4, 0, 20, 1, whole=True),
    Slider("count", "whole and logarithmic", 30, 3, 300, 0.01, whole=True, logarithmic=True),
    Slider("period", "a multiple", 0.1, 0.01, 1.0, 0.01, multiple_of=0.02, logarithmic=True),
]


def draft_with(name: str, **choices: str) -> Draft:
    draft = open_draft(name)
    for key, value in choices.items():
        draft = choose(draft, key.replace("__", "."), value)
    return draft


@given(share=st.floats(0.0, 1.0))
@pytest.mark.parametrize("slider", SLIDERS, ids=lambda slider: slider.label)
def test_value_and_position_are_inverses(slider: Slider, share: float) -> None:
    low, high = slider.ends
    position = low + share * (high - low)
    value = slider.value_at(position)
    exact = 10.0**position if slider.logarithmic else position
    rounding = slider.multiple_of or (1.0 if slider.whole else 0.01 * exact)
    assert value == pytest.approx(exact, abs=0.5 * rounding + 1e-12)
    assert slider.value_at(slider.position_of(value)) == value


@pytest.mark.parametrize("slider", SLIDERS, ids=lambda slider: slider.label)
def test_values_beyond_the_ends_are_at_the_ends(slider: Slider) -> None:
    low, high = slider.ends
    assert slider.value_at(low - 1.0) == slider.value_at(low)
    assert slider.value_at(high + 1.0) == slider.value_at(high)
    assert (slider.position_of(-1.0), slider.position_of(1e9)) == (low, high)


@pytest.mark.parametrize(
    "draft",
    [
        draft_with("lane_following"),
        draft_with("lane_following", network__loss="gilbert_elliott", network__constraints="at_most"),
        draft_with("shared_channel"),
        draft_with("lane_periodic"),
        draft_with("lane_following", trigger="dwell"),
    ],
    ids=["lane", "bursts and a window", "bursts of the scenario", "period", "another policy"],
)
def test_a_range_stays_put_while_its_slider_is_dragged(draft: Draft) -> None:
    sliders = controls_of(draft).sliders
    assert len(sliders) > 5
    for slider in sliders:
        low, high = slider.ends
        dragged = draft
        for share in (0.7, 1.0, 0.1, 0.5):
            value = slider.value_at(low + share * (high - low))
            with suppress(DraftError):  # the value may contradict another one
                moved = drag(dragged, slider, value)
                controls_after = {control.key: control for control in controls_of(moved).sliders}
                assert controls_after[slider.key].ends == pytest.approx(slider.ends), slider.key
                dragged = moved
