"""Four tanks, two of which drain into the others: the levels of plant and models."""

from collections.abc import Mapping

import numpy as np

from cosim.output.viewer.pictures import picture as draw
from cosim.record.align import Reals

_WIDTH, _HEIGHT = 1.0, 1.6  # of a tank
_PLACES = ((-0.9, 0.0), (0.9, 0.0), (-0.9, 2.3), (0.9, 2.3))
"""Lower left corners of the tanks 1 to 4; the upper two are 3 and 4."""
_HATCH_LINES, _TALLEST_CM = 7, 20.0
"""Lines of a hatched tank, and the level at which it is full."""
_STYLES: Mapping[str, tuple[float, float]] = {
    "plant": (0.07, 2.0),
    "sensor": (0.06, 4.0),
    "controller": (0.09, 3.0),
}


class TanksPicture(draw.Picture):
    """Levels as bars; each model's level is a line, which protrudes from the tank on one side."""

    kinds = ("four_tank",)
    title = "The tanks"
    rate_hz = 10.0

    @classmethod
    def of(cls, plant: draw.DrawnPlant) -> "TanksPicture | None":
        return cls() if plant.scenario.plant.system.kind in cls.kinds else None

    def bounds(self) -> tuple[float, float, float, float]:
        return -3.6, 2.6, -0.35, 4.25

    def scenery(self) -> Mapping[str, draw.Shape]:
        walls = [
            [(left, low + _HEIGHT), (left, low), (left + _WIDTH, low), (left + _WIDTH, low + _HEIGHT)]
            for left, low in _PLACES
        ]
        spouts = [[(left + _WIDTH / 2, low), (left + _WIDTH / 2, low - 0.3)] for left, low in _PLACES]
        shapes: dict[str, draw.Shape] = {
            "walls": draw.lines(walls, draw.STILL, 0.06),
            "spouts": draw.lines(spouts, draw.STILL, 0.06),
        }
        for i, (left, low) in enumerate(_PLACES):
            for who, (width, order) in _STYLES.items():
                shapes[f"{who}/{i + 1}"] = draw.style(draw.WHO[who], width, order=order)
            shapes[f"number/{i + 1}"] = draw.label(
                f"tank {i + 1}", (left + _WIDTH / 2, low + _HEIGHT), draw.STILL
            )
        return shapes | draw.legend(-2.6, 4.1, 0.45)

    def frames(self, frames: draw.Frames) -> Mapping[str, draw.Columns]:
        columns: dict[str, draw.Columns] = {}
        if frames.z is None:
            return columns
        # x is the deviation of the levels z from the operating point, in cm.
        at_rest = frames.z - frames.x
        for who in draw.WHO:
            levels_cm = frames.of(who) + at_rest
            for i, (left, low) in enumerate(_PLACES):
                height = low + np.maximum(levels_cm[:, i], 0.0) / _TALLEST_CM * _HEIGHT
                columns[f"{who}/{i + 1}"] = draw.strips(_level(who, left, low, height))
        return columns


def _level(who: str, left: float, low: float, height: Reals) -> Reals:
    """Return the line of a level (k, p, 2): a hatched bar, or a stroke."""
    k = len(height)
    if who == "plant":
        across = np.repeat(np.linspace(left + 0.09, left + _WIDTH - 0.09, _HATCH_LINES), 2)
        points = np.empty((k, 2 * _HATCH_LINES, 2))
        points[:, :, 0] = across
        up = np.tile([True, False, False, True], _HATCH_LINES)[: 2 * _HATCH_LINES]
        points[:, :, 1] = np.where(up, height[:, None], low + 0.09)
        return points
    ends = (left - 0.22, left + 0.6) if who == "sensor" else (left + 0.4, left + _WIDTH + 0.22)
    points = np.empty((k, 2, 2))
    points[:, :, 0] = ends
    points[:, :, 1] = height[:, None]
    return points
