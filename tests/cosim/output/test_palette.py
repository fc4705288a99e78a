"""The palette's colours differ from their backgrounds, and from each other for everyone.

Colour-blindness is simulated after Machado, Oliveira and Fernandes, "A Physiologically-based Model
for Simulation of Color Vision Deficiency", 2009, at full severity; colours are compared in Oklab
(Ottosson, 2020), in which a distance of 0.01 to 0.02 is just noticeable.
"""

from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray

from cosim.output import palette

BACKGROUNDS = {"rerun, dark": (13, 16, 17), "report, dark": (20, 24, 29), "light": (255, 255, 255)}
VISIONS = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    "deuteranopia": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
    "tritanopia": np.array(
        [
            [1.255528, -0.076749, -0.178779],
            [-0.078411, 0.930809, 0.147602],
            [0.004733, 0.691367, 0.303900],
        ]
    ),
}
TO_CONES = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
TO_OKLAB = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)
BODIES = (palette.PLANT, palette.SENSOR, palette.CONTROLLER)
"""Colours that are drawn on each other in every picture and plot of states."""
PANELS: dict[str, tuple[palette.Colour, ...]] = {
    "states": BODIES,
    "errors": (
        palette.SENSOR, palette.CONTROLLER, palette.THRESHOLD, palette.CERTIFIED, palette.IDENTITY,
        palette.PRINTED,
    ),
    "norm of the state": (palette.PLANT, palette.CERTIFIED, palette.PRINTED),
    "broadcasts": (palette.SENSOR, palette.LOST, palette.CERTIFIED, palette.PRINTED),
    "receptions": (palette.CONTROLLER, palette.FORCED, palette.LOST),
    "packets": (*BODIES, palette.NETWORK, palette.LOST, palette.FORCED),
    "lateness": tuple(palette.PROCESSES.values()),
    "series": palette.SERIES,
}  # fmt: skip
CONCEPTS = {colour for colours in PANELS.values() for colour in colours}


def linear(colour: palette.Colour) -> NDArray[np.float64]:
    c = np.array(colour) / 255
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def luminance(colour: palette.Colour) -> float:
    """Relative luminance by WCAG 2.2."""
    return float(linear(colour) @ [0.2126, 0.7152, 0.0722])


def distance(one: palette.Colour, other: palette.Colour, vision: NDArray[np.float64]) -> float:
    seen = [np.clip(vision @ linear(colour), 0, 1) for colour in (one, other)]
    first, second = (TO_OKLAB @ np.cbrt(TO_CONES @ colour) for colour in seen)
    return float(np.linalg.norm(first - second))


@pytest.mark.parametrize("background", BACKGROUNDS)
def test_every_colour_has_enough_contrast_to_its_background(background: str) -> None:
    """3 to 1, WCAG's minimum for graphics."""
    behind = luminance(BACKGROUNDS[background])
    for colour in CONCEPTS:
        low, high = sorted((luminance(colour), behind))
        assert (high + 0.05) / (low + 0.05) >= 3, colour


@pytest.mark.parametrize("vision", VISIONS)
@pytest.mark.parametrize("panel", PANELS)
def test_colours_of_one_panel_can_be_distinguished(panel: str, vision: str) -> None:
    least = 0.15 if panel == "states" else 0.09
    for one, other in combinations(PANELS[panel], 2):
        assert distance(one, other, VISIONS[vision]) > least, (one, other)


def test_all_concepts_can_be_distinguished_with_colour_blindness() -> None:
    for vision in VISIONS.values():
        for one, other in combinations(CONCEPTS, 2):
            assert distance(one, other, vision) > 0.05, (one, other)
